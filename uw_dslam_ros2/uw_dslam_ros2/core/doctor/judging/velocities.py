"""What is said of a DVL's axes by how the echoes move."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.doctor.examination import Examination, words_of
from uw_dslam_ros2.core.doctor.judging.scales import confidence_in
from uw_dslam_ros2.core.doctor.motions.fits import (
    SURE,
    VelocityFit,
    confidence_of_lead,
    fit_current,
)

__all__ = ["judge_current", "judge_offset", "say_in_world", "say_mirrored"]

FloatArray = NDArray[np.float64]

_MIN_OFFSET_RAD = math.radians(2.5)
_MIN_COARSE_OFFSET_RAD = math.radians(15.0)
"""Where the echoes' motions are far too short, they are only as good as that."""
_COARSE_SCALE = 0.2
_MIN_CURRENT_M_S = 0.1


def judge_offset(result: Examination, fit: VelocityFit, velocity_m_s: FloatArray) -> None:
    """Tell of a DVL or a sonar that is turned; ``velocity_m_s`` (V, 2) is the DVL's."""
    sigma = fit.factor_sigma / max(fit.scale, 1e-9)
    offset = fit.yaw_rad
    least = _MIN_COARSE_OFFSET_RAD if fit.scale < _COARSE_SCALE else _MIN_OFFSET_RAD
    if abs(offset) < max(least, 4.0 * sigma) or sigma > 0.2:
        return
    degrees = math.degrees(offset)
    mean = complex(*np.median(velocity_m_s, axis=0))
    # A vehicle goes ahead more often than not: who says so is right.
    by_velocity = abs(np.angle(mean)) + 0.05
    by_echoes = abs(np.angle(mean * np.exp(1j * offset)))
    if by_echoes > by_velocity:
        result.tell(
            "sonar_turned",
            "sonar",
            f"its echoes move as if it were mounted {-degrees:.0f} degrees from where tf says "
            f"(conventions.sonar_yaw_offset_rad: {-offset:.3f}), counter-clockwise",
            confidence_in(offset, sigma),
            sonar_yaw_offset_rad=round(-offset, 4),
        )
    elif abs(abs(degrees) - 180.0) < 15.0:
        result.tell(
            "dvl_sign",
            "velocity",
            "its velocity has the wrong sign: it is the bottom's against the vehicle "
            "(conventions.velocity_yaw_offset_rad: 3.1416)",
            confidence_in(offset, sigma),
            velocity_yaw_offset_rad=round(math.pi, 4),
        )
    else:
        result.tell(
            "dvl_turned",
            "velocity",
            f"its velocity is {-degrees:.0f} degrees off the sonar's motion: it is mounted "
            f"turned (conventions.velocity_yaw_offset_rad: {offset:.3f})",
            confidence_in(offset, sigma),
            velocity_yaw_offset_rad=round(offset, 4),
        )


def judge_current(result: Examination, fit: VelocityFit) -> bool:
    """Tell of a velocity that is measured against water that moves; whether it is."""
    current = fit_current(fit)
    sure = confidence_of_lead(current.lead, fit.repeats)
    is_much = current.lead > 0.4 * float(np.nansum(fit.cost))
    is_clear = current.m_s >= max(_MIN_CURRENT_M_S, 6.0 * current.sigma_m_s)
    if not (sure > SURE and is_much and is_clear):
        return False
    result.tell(
        "dvl_in_water",
        "velocity",
        f"a steady {current.m_s:.2f} m/s in one direction of the world is missing in it or is "
        "too much, by how the echoes move: it is measured against water that moves, not against "
        "the ground; set the dvl to bottom track",
        sure,
    )
    return True


def say_mirrored(result: Examination, fit: VelocityFit, confidence: float) -> None:
    """Tell of a velocity whose sideways axis has the wrong sign."""
    offset = fit.yaw_rad
    axes = "exchanged" if abs(abs(offset) - 0.5 * math.pi) < 0.3 else "mirrored"
    result.tell(
        "dvl_mirrored",
        "velocity",
        f"its sideways velocity is against the sonar's echoes: its axes are {axes} "
        f"(conventions.velocity_is_mirrored: true, conventions.velocity_yaw_offset_rad: "
        f"{offset:.2f}); or those of the imu and the sonar are, both",
        confidence,
        velocity_is_mirrored=True,
        velocity_yaw_offset_rad=round(offset, 4) if abs(offset) > _MIN_OFFSET_RAD else 0.0,
    )


def say_in_world(result: Examination, fit: VelocityFit | None, confidence: float) -> None:
    """Tell of a velocity along the world's axes; a `fit` mends it."""
    said = (
        "its velocity is along axes that do not turn with the vehicle (east and north, or "
        "those of its odometry), while its message says along its own"
    )
    if fit is None:
        said += ": have its driver give it in the vehicle's frame"
        result.tell("dvl_in_world", "velocity", said, confidence)
        return
    changes: dict[str, str | float | bool] = {
        "velocity_axes": "world",
        "velocity_yaw_offset_rad": round(fit.yaw_rad, 4),
    }
    if fit.is_mirrored:
        changes["velocity_is_mirrored"] = True
    result.tell(
        "dvl_in_world",
        "velocity",
        f"{said} ({words_of(changes)})",
        confidence,
        **changes,
    )
