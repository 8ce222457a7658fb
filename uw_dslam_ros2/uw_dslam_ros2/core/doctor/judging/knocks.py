"""Whether a sonar, or the DVL, was turned on its mounting in the middle of a recording."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from uw_dslam_ros2.core.doctor.examination import Examination
from uw_dslam_ros2.core.doctor.motions.fits import VelocityFit, confidence_of_lead
from uw_dslam_ros2.core.doctor.motions.ping_motion import PingMotions

__all__ = ["judge_knock"]

_MIN_MOTIONS = 15
_MIN_TURN_RAD = math.radians(8.0)
_NUM_SPLITS = 15
_BETTER = 0.8  # of the cost is what a mounting that changed costs at most, read as two


def judge_knock(
    result: Examination,
    motions: PingMotions,
    whole: VelocityFit,
    fit_of: Callable[[PingMotions], VelocityFit | None],
) -> None:
    """Tell of one direction of the velocity against the echoes before some time, another after.

    Parameters
    ----------
    whole : fit of all motions.
    fit_of : the same of some of them.
    """
    begin_s, end_s = float(motions.begin_s[0]), float(motions.end_s[-1])
    best: tuple[float, float, float] | None = None
    for at_s in np.linspace(begin_s, end_s, _NUM_SPLITS + 2)[1:-1]:
        parts = motions.between(begin_s, at_s), motions.between(at_s, end_s)
        if min(len(part) for part in parts) < _MIN_MOTIONS:
            continue
        before, after = (fit_of(part) for part in parts)
        if before is None or after is None:
            continue
        turn_rad = math.remainder(before.yaw_rad - after.yaw_rad, 2.0 * math.pi)
        sigma_rad = math.hypot(*(f.factor_sigma / max(f.scale, 1e-9) for f in (before, after)))
        cost = _total(before) + _total(after)
        is_turned = abs(turn_rad) > max(_MIN_TURN_RAD, 5.0 * sigma_rad)
        if is_turned and (best is None or cost < best[0]):
            best = cost, turn_rad, float(at_s)
    if best is None or best[0] > _BETTER * _total(whole):
        return
    cost, turn_rad, at_s = best
    result.tell(
        "sonar_knocked",
        "sonar",
        f"about {at_s:.0f} s into the recording it was turned by {math.degrees(turn_rad):.0f} "
        "degrees on its mounting (counter-clockwise), or the dvl the other way: map what is "
        "before and what is after as two recordings",
        confidence_of_lead(_total(whole) - cost, whole.repeats),
    )


def _total(fit: VelocityFit) -> float:
    return float(np.nansum(fit.cost))
