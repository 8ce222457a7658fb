"""Whether a sonar, or the DVL, was turned on its mounting in the middle of a recording."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.doctor.examination import Examination
from uw_dslam_ros2.core.doctor.motions.fits import SURE, VelocityFit, confidence_of_lead
from uw_dslam_ros2.core.doctor.motions.ping_motion import PingMotions
from uw_dslam_ros2.core.doctor.samples.sample import NavigationSample

__all__ = ["judge_knock"]

FloatArray = NDArray[np.float64]

_MIN_MOTIONS = 15
_MIN_TURN_RAD = math.radians(8.0)
_NUM_SPLITS = 15
_FINER = (1.0, 0.125)  # of a step between splits, to find the moment to a second or two
_BETTER = 0.8  # of the cost is what a mounting that changed costs at most, read as two
_BETWEEN_COST = 3.0  # of a motion on its way while it happens, which fits neither


@dataclass(frozen=True, slots=True)
class _Split:
    """Motions before and after a time, each fitted by themselves."""

    at_s: float
    before: VelocityFit
    after: VelocityFit
    num_between: int

    @property
    def cost(self) -> float:
        return _total(self.before) + _total(self.after) + _BETWEEN_COST * self.num_between

    @property
    def turn_rad(self) -> float:
        """By how much the sonar is turned after it."""
        return math.remainder(self.before.yaw_rad - self.after.yaw_rad, 2.0 * math.pi)

    @property
    def is_turned(self) -> bool:
        fits = self.before, self.after
        sigma_rad = math.hypot(*(f.factor_sigma / max(f.scale, 1e-9) for f in fits))
        return abs(self.turn_rad) > max(_MIN_TURN_RAD, 5.0 * sigma_rad)


def judge_knock(
    result: Examination,
    motions: PingMotions,
    navigation: NavigationSample,
    start_s: float,
    whole: VelocityFit,
    fit_of: Callable[[PingMotions], VelocityFit | None],
) -> VelocityFit | None:
    """Tell of one direction of the velocity against the echoes before some time, another after.

    Parameters
    ----------
    start_s : stamp that the motions' seconds are counted from.
    whole : fit of all motions.
    fit_of : the same of some of them.

    Returns
    -------
    VelocityFit | None
        That of the motions before it; None where nothing was turned.
    """
    begin_s, end_s = float(motions.begin_s[0]), float(motions.end_s[-1])
    step_s = (end_s - begin_s) / (_NUM_SPLITS + 1)

    def best_of(times_s: FloatArray) -> _Split | None:
        found = []
        for at_s in times_s:
            parts = motions.between(begin_s, float(at_s)), motions.between(float(at_s), end_s)
            if min(len(part) for part in parts) < _MIN_MOTIONS:
                continue
            before, after = (fit_of(part) for part in parts)
            if before is not None and after is not None:
                num_between = len(motions) - sum(len(part) for part in parts)
                found.append(_Split(float(at_s), before, after, num_between))
        return min((s for s in found if s.is_turned), key=lambda s: s.cost, default=None)

    best = best_of(np.linspace(begin_s, end_s, _NUM_SPLITS + 2)[1:-1])
    if best is None or best.cost > _BETTER * _total(whole):
        return None
    for share in _FINER:
        reach_s = share * step_s
        best = best_of(best.at_s + np.linspace(-reach_s, reach_s, 17)) or best
    confidence = confidence_of_lead(_total(whole) - best.cost, whole.repeats)
    if confidence <= SURE:
        return None
    degrees = math.degrees(best.turn_rad)
    if _is_velocity_turned(navigation, best):
        result.tell(
            "dvl_knocked",
            "velocity",
            f"about {best.at_s:.0f} s into the recording it was turned by {-degrees:.0f} degrees "
            "on its mounting (counter-clockwise): map what is before and what is after as two "
            "recordings",
            confidence,
        )
        return best.before
    at_s = start_s + best.at_s
    result.tell(
        "sonar_knocked",
        "sonar",
        f"about {best.at_s:.0f} s into the recording it was turned by {degrees:.0f} degrees on "
        f"its mounting (counter-clockwise; conventions.sonar_knocked_at_s: {at_s:.1f}, "
        f"conventions.sonar_knocked_yaw_rad: {best.turn_rad:.3f})",
        confidence,
        sonar_knocked_at_s=round(at_s, 2),
        sonar_knocked_yaw_rad=round(best.turn_rad, 4),
    )
    return best.before


def _is_velocity_turned(navigation: NavigationSample, split: _Split) -> bool:
    """Whether the velocity says another direction since: a vehicle keeps going ahead."""
    is_after = navigation.velocity_s > split.at_s
    if is_after.all() or not is_after.any():
        return False
    before, after = (
        complex(*np.median(navigation.velocity_m_s[part], axis=0))
        for part in (~is_after, is_after)
    )
    change_rad = float(np.angle(after * before.conjugate()))
    return abs(math.remainder(change_rad - split.turn_rad, 2.0 * math.pi)) < abs(change_rad)


def _total(fit: VelocityFit) -> float:
    return float(np.nansum(fit.cost))
