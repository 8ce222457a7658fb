"""How far, and how fast of its own, a heading turns where the sonar's echoes do not."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.doctor.motions.fits import TurnFit, fit_turns, turns_of
from uw_dslam_ros2.core.doctor.motions.ping_motion import PingMotions
from uw_dslam_ros2.core.se2 import wrap_angle

__all__ = ["TurnErrors", "fit_turn_errors", "fit_turn_scale"]

FloatArray = NDArray[np.float64]

_ITERATIONS = 12
_MIN_TURNS = 8
_SCALES = np.geomspace(0.5, 2.0, 29).tolist()


@dataclass(frozen=True, slots=True)
class TurnErrors:
    """By how much faster than the echoes a yaw turns of its own [rad/s], with its sigma.

    ``scale`` is how many times as far as the yaw the echoes turn, with its sigma.
    """

    bias_rad_s: float
    bias_sigma_rad_s: float
    scale: float
    scale_sigma: float


def fit_turn_errors(
    motions: PingMotions, imu_s: FloatArray, yaw_rad: FloatArray, fit: TurnFit
) -> TurnErrors:
    """What a yaw (K,), not wrapped, turns by where the echoes do not."""
    turns = fit.sign * turns_of(motions, imu_s, yaw_rad, fit.delay_s)
    error = wrap_angle(turns - motions.motion[:, 2])
    known = np.isfinite(error)
    seconds = motions.end_s - motions.begin_s
    design = np.column_stack([seconds, turns])[known]
    error = error[known]
    if len(error) < _MIN_TURNS:
        return TurnErrors(0.0, math.inf, 1.0, math.inf)
    found, trust, spread = np.zeros(2), np.ones(len(error)), 1.0
    for _ in range(_ITERATIONS):
        normal = (design * trust[:, None]).T @ design + 1e-12 * np.eye(2)
        found = np.linalg.solve(normal, design.T @ (trust * error))
        left = error - design @ found
        spread = max(1.48 * float(np.median(np.abs(left))), 1e-4)
        trust = 1.0 / (1.0 + np.square(left / spread) / 4.0)
    sigma = spread * np.sqrt(np.diag(np.linalg.inv(normal)) * motions.repeats)
    return TurnErrors(
        fit.sign * float(found[0]), float(sigma[0]), 1.0 - float(found[1]), float(sigma[1])
    )


def fit_turn_scale(
    motions: PingMotions, imu_s: FloatArray, yaw_rad: FloatArray
) -> tuple[float, list[TurnFit]]:
    """How many times as far as a yaw (K,), not wrapped, the echoes turn; the fits with that."""
    tried = [(s, fit_turns(motions, imu_s, s * yaw_rad)) for s in _SCALES]
    scale, fits = min(tried, key=lambda item: float(item[1][0].cost.sum()))
    for _ in range(2):
        scale *= fit_turn_errors(motions, imu_s, scale * yaw_rad, fits[0]).scale
        fits = fit_turns(motions, imu_s, scale * yaw_rad)
    return scale, fits
