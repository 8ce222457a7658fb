"""Which conventions the poses of a vehicle's own filter follow, by the sonar's echoes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.doctor.examination import Examination
from uw_dslam_ros2.core.doctor.judging.scales import confidence_in, is_scale_wrong, scale_of
from uw_dslam_ros2.core.doctor.motions.delays import late_in_words
from uw_dslam_ros2.core.doctor.motions.fits import (
    SURE,
    TurnFit,
    VelocityFit,
    believed,
    confidence_of,
    fit_turns,
    fit_velocity,
)
from uw_dslam_ros2.core.doctor.motions.ping_motion import PingMotions
from uw_dslam_ros2.core.doctor.samples.sample import NavigationSample
from uw_dslam_ros2.core.findings import Finding
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["OdometrySample", "examine_odometry", "say_mirrored"]

FloatArray = NDArray[np.float64]

_BELOW_M = 0.3
_MIN_DELAY_S = 0.08
_MIN_OFFSET_RAD = math.radians(4.0)
_MAX_SIGMA = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class OdometrySample:
    """Poses of the vehicle in a frame of its filter's.

    ``stamp_s`` (K,) rising, ``yaw_rad`` (K,), the velocity (V, 2) along base_link's axes that the
    poses make at ``velocity_s`` (V,), ``height_m`` (K,) as the messages have z, and whether the
    frame's name speaks of north, east, down.
    """

    stamp_s: FloatArray
    yaw_rad: FloatArray
    velocity_s: FloatArray
    velocity_m_s: FloatArray
    height_m: FloatArray
    is_named_ned: bool = False

    def yaw_rates(self) -> FloatArray:
        """Rates (K,) of yaw [rad/s]."""
        if len(self.yaw_rad) < 2:
            return np.full(len(self.yaw_rad), math.nan)
        rates = np.diff(np.unwrap(self.yaw_rad)) / np.maximum(np.diff(self.stamp_s), 1e-3)
        return np.append(rates, rates[-1])

    def as_navigation(self) -> NavigationSample:
        """The same as what an IMU without rates and a DVL would say."""
        unknown = np.full(len(self.yaw_rad), math.nan)
        return NavigationSample(
            self.stamp_s, self.yaw_rad, unknown, self.velocity_s, self.velocity_m_s
        )

    @property
    def is_z_down(self) -> bool | None:
        """Whether z grows downwards, since a vehicle is below the surface; None: not known."""
        known = self.height_m[np.isfinite(self.height_m)]
        middle = float(np.median(known)) if len(known) else 0.0
        return None if abs(middle) < _BELOW_M else middle > 0.0


def examine_odometry(
    result: Examination,
    odometry: OdometrySample,
    motions: PingMotions,
    T_base_sonar: SE2,
    *,
    is_alone: bool = True,
) -> None:
    """Add to an examination what the echoes' motions say of the poses.

    One that `is_alone` is all the navigation that there is; then the sonar's clock, direction and
    scale are judged by it, too.
    """
    _Judge(result, odometry, motions, T_base_sonar).run(is_alone=is_alone)


class _Judge:
    def __init__(
        self,
        result: Examination,
        odometry: OdometrySample,
        motions: PingMotions,
        T_base_sonar: SE2,
    ) -> None:
        self._result = result
        self._odometry = odometry
        self._motions = motions
        self._mount = T_base_sonar

    def run(self, *, is_alone: bool) -> None:
        yaw = np.unwrap(self._odometry.yaw_rad)
        turns = believed(fit_turns(self._motions, self._odometry.stamp_s, yaw))
        if turns is None:
            if self._odometry.is_named_ned:
                _say_ned(self._result, "its frame is named so", 1.0, "info")
            return
        sign, owner = turns[0].sign, ""
        if sign < 0:
            owner = say_mirrored(self._result, self._odometry, confidence_of(turns[0], turns[1]))
        if not is_alone:
            return
        self._judge_delay(turns)
        is_mirrored = owner == "sonar"
        side = np.array([1.0, sign if not is_mirrored else 1.0])
        fit = fit_velocity(
            self._motions,
            NavigationSample(
                self._odometry.stamp_s,
                yaw,
                np.full(len(yaw), math.nan),
                self._odometry.velocity_s,
                self._odometry.velocity_m_s * side,
            ),
            yaw if is_mirrored else sign * yaw,
            turns[0].delay_s,
            sonar=complex(self._mount.x, self._mount.y),
            sonar_yaw_rad=self._mount.yaw,
            is_sonar_mirrored=is_mirrored,
        )
        if fit is not None:
            self._result.is_velocity_judged = True
            self._judge_offset(fit)
            self._judge_scale(fit)

    def _judge_delay(self, turns: list[TurnFit]) -> None:
        delay_s, sure = turns[0].delay_s, confidence_of(turns[0], turns[2])
        if abs(delay_s) < _MIN_DELAY_S or sure < SURE:
            return
        self._result.tell(
            "sonar_delay",
            "sonar",
            f"its stamps are {late_in_words(delay_s)} than the odometry's, by how both turn "
            f"(conventions.sonar_delay_s: {delay_s:.2f})",
            sure,
            sonar_delay_s=round(delay_s, 3),
        )

    def _judge_offset(self, fit: VelocityFit) -> None:
        sigma, offset = fit.factor_sigma / max(fit.scale, 1e-9), fit.yaw_rad
        if abs(offset) < max(_MIN_OFFSET_RAD, 4.0 * sigma) or sigma > _MAX_SIGMA:
            return
        self._result.tell(
            "sonar_turned",
            "sonar",
            f"its echoes move as if it were mounted {-math.degrees(offset):.0f} degrees from "
            "where tf says, counter-clockwise, or the odometry's frame is turned against the "
            f"vehicle (conventions.sonar_yaw_offset_rad: {-offset:.3f})",
            confidence_in(offset, sigma),
            sonar_yaw_offset_rad=round(-offset, 4),
        )

    def _judge_scale(self, fit: VelocityFit) -> None:
        self._result.scale = scale_of(fit, "odometry")
        if not is_scale_wrong(fit):
            return
        self._result.tell(
            "sound_speed",
            "sonar",
            f"its echoes move {fit.scale:.3g} times as far as the odometry says: one of them is "
            "set for another speed of sound, or another unit "
            f"(conventions.sonar_range_scale: {1.0 / fit.scale:.3f} where it is the sonar)",
            confidence_in(fit.scale - 1.0, fit.factor_sigma),
            sonar_range_scale=round(1.0 / fit.scale, 4),
        )


def say_mirrored(
    result: Examination, odometry: OdometrySample, confidence: float
) -> Literal["odometry", "sonar"]:
    """Tell whether the odometry or the sonar is the wrong way round.

    A mirrored path and a mirrored sonar make the same map but for a mirror, so that echoes do
    not tell: the frame's name does, or on which side of the surface it has the vehicle.
    Without either the odometry is taken for NED, which is common, and the map may be mirrored.
    """
    is_z_down = odometry.is_z_down
    if odometry.is_named_ned:
        _say_ned(result, "its frame is named so, and the echoes agree", confidence, "info")
    elif is_z_down:
        _say_ned(
            result, "the sonar's echoes turn against it, and its z grows downwards", confidence
        )
    elif is_z_down is False:
        result.tell(
            "sonar_mirrored",
            "sonar",
            "its echoes turn against the odometry, whose z grows upwards as it should: port "
            "and starboard are exchanged, or it hangs upside down "
            "(conventions.sonar_is_mirrored: true)",
            confidence,
            sonar_is_mirrored=True,
        )
        return "sonar"
    else:
        result.tell(
            "handedness",
            "odometry",
            "the sonar's echoes turn against it: either it is north, east, down "
            "(conventions.odometry: ned), which is the likelier, or the sonar's port and "
            "starboard are exchanged (conventions.sonar_is_mirrored: true instead): then the "
            "map is mirrored",
            0.5,
            odometry="ned",
        )
    return "odometry"


def _say_ned(
    result: Examination,
    why: str,
    confidence: float,
    severity: Literal["info", "warning"] = "warning",
) -> None:
    finding = Finding(
        "odometry_ned",
        "odometry",
        f"its poses are north, east, down: {why} (conventions.odometry: ned)",
        confidence,
        severity,
        result.vehicle_id,
    )
    result.add(finding, odometry="ned")
