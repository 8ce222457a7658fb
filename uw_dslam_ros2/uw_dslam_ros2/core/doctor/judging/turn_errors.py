"""What is said of a heading that drifts, and of echoes that turn too far."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.doctor.examination import Examination, words_of
from uw_dslam_ros2.core.doctor.judging.imu import ImuState
from uw_dslam_ros2.core.doctor.judging.scales import confidence_in
from uw_dslam_ros2.core.doctor.motions.fits import (
    SURE,
    TurnFit,
    believed,
    confidence_of,
    fit_turns,
)
from uw_dslam_ros2.core.doctor.motions.ping_motion import PingMotions
from uw_dslam_ros2.core.doctor.motions.turn_errors import (
    TurnErrors,
    fit_turn_errors,
    fit_turn_scale,
)

__all__ = ["is_scale_of_turns_wrong", "judge_drift", "judge_scale_of_turns"]

FloatArray = NDArray[np.float64]

_MIN_DRIFT_RAD_S, _MAX_DRIFT_RAD_S = math.radians(0.05), 0.1
_STEADY = 0.3  # of a drift, by which halves of a recording may differ
_MIN_APERTURE_ERROR = 0.05
_MAX_COST, _BETTER = 2.5, 0.75


def judge_drift(
    result: Examination,
    motions: PingMotions,
    imu_s: FloatArray,
    yaw_rad: FloatArray,
    fit: TurnFit,
    errors: TurnErrors,
    apart_rad_s: float,
    start_s: float,
    yaw_sign: int = 1,
) -> None:
    """Tell of a heading that drifts; mend it where it does so steadily.

    Parameters
    ----------
    yaw_rad : (K,) at ``imu_s`` (K,), not wrapped, that turns as `fit` and `errors` say.
    apart_rad_s : by how much faster than the orientation it drifts.
    start_s : stamp that the times are counted from.
    yaw_sign : -1 where the yaw will be read the other way round, 0 where that is not known.
    """
    bias, sigma = errors.bias_rad_s, errors.bias_sigma_rad_s
    if abs(bias) < max(_MIN_DRIFT_RAD_S, 5.0 * sigma):
        return
    drift = bias - apart_rad_s
    if abs(drift) < 0.5 * abs(bias):
        return  # beside an orientation that holds, the mapper's filter finds the bias
    changes: dict[str, float] = {}
    mend = "let it settle before the dive, or calibrate it"
    is_plain = yaw_sign != 0 and abs(drift) < _MAX_DRIFT_RAD_S
    if is_plain and _is_steady(motions, imu_s, yaw_rad, fit, bias):
        changes = {
            "imu_drift_rad_s": float(f"{yaw_sign * drift:.3g}"),
            "imu_drift_since_s": round(start_s, 2),
        }
        mend += f" ({words_of(changes)})"
    result.tell(
        "imu_drift",
        "imu",
        f"it turns by {60.0 * abs(math.degrees(bias)):.1f} degrees a minute where the sonar's "
        f"echoes do not: its gyro has a bias; {mend}",
        confidence_in(bias, sigma),
        **changes,
    )


def _is_steady(
    motions: PingMotions, imu_s: FloatArray, yaw_rad: FloatArray, fit: TurnFit, bias_rad_s: float
) -> bool:
    """Whether a drift is the same in both halves of what was seen."""
    begin_s, end_s = float(motions.begin_s[0]), float(motions.end_s[-1])
    middle_s = 0.5 * (begin_s + end_s)
    tolerance = _STEADY * abs(bias_rad_s)
    for part in ((begin_s, middle_s), (middle_s, end_s)):
        half = fit_turn_errors(motions.between(*part), imu_s, yaw_rad, fit)
        if half.bias_sigma_rad_s > tolerance:
            return False
        if abs(half.bias_rad_s - bias_rad_s) > tolerance + 2.0 * half.bias_sigma_rad_s:
            return False
    return True


def is_scale_of_turns_wrong(errors: TurnErrors) -> bool:
    """Whether the echoes clearly do not turn as far as a yaw that fits otherwise."""
    return abs(errors.scale - 1.0) > max(_MIN_APERTURE_ERROR, 6.0 * errors.scale_sigma)


def judge_scale_of_turns(
    result: Examination, imu: ImuState, motions: PingMotions, imu_s: FloatArray
) -> bool:
    """Tell of echoes that turn with an IMU (K,), but farther or less far; whether they do."""
    yaw = imu.by_rates if imu.by_orientation is None else imu.by_orientation
    if yaw is None:
        return False
    plain = fit_turns(motions, imu_s, yaw)
    if imu.by_orientation is None:
        degrees = believed(fit_turns(motions, imu_s, math.radians(1.0) * yaw))
        sure = 0.0 if degrees is None else confidence_of(degrees[0], plain[0])
        if sure > SURE:
            result.tell(
                "imu_rates_in_degrees",
                "imu",
                "its rates are 57 times too fast for the sonar's echoes: they are in degrees per "
                "second (conventions.imu_rates_in_degrees: true)",
                sure,
                imu_rates_in_degrees=True,
            )
            return True
    scale, found = fit_turn_scale(motions, imu_s, yaw)
    sure = min(confidence_of(found[0], plain[0]), confidence_of(found[0], found[1]))
    if sure < SURE or abs(scale - 1.0) < _MIN_APERTURE_ERROR:
        return False
    # Ways are distorted by a wrong aperture, and with them the turns of a ping or other.
    cost, before = (float(np.mean(fits[0].cost)) for fits in (found, plain))
    if cost > _MAX_COST or cost > _BETTER * before:
        return False
    result.tell(
        "sonar_aperture",
        "sonar",
        f"its echoes turn {scale:.2f} times as far as the imu: its bearings are spread over "
        "another aperture than the sonar has, as with the table of beams of another model "
        f"(conventions.sonar_bearing_scale: {1.0 / scale:.3f})",
        sure,
        sonar_bearing_scale=round(1.0 / scale, 3),
    )
    return True
