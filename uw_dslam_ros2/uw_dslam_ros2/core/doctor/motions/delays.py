"""Whose clock is late: the echoes' turns and their way, against the IMU's and the DVL's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from uw_dslam_ros2.core.doctor.motions.fits import TurnFit, VelocityFit, confidence_of

__all__ = ["Delays", "find_delays", "late_in_words"]

_MAX_DELAY_S = 2.3
_COARSE_S, _FINE_S = 0.1, 0.02
_MIN_TURN_DELAY_S = 0.08
_MIN_WAY_DELAY_S = 0.2  # a DVL's own filter takes up to that, and it costs a map nothing
_NUM_WAY_DELAYS = 4
"""Of those that are tried, as many as do not look alike: a vehicle's speed changes in a second."""


@dataclass(frozen=True, slots=True)
class Delays:
    """How much later than the others' a sensor's stamps are [s]; 0: not shown to be late.

    Where `is_owner_known` is False it is either the sonar or the IMU, and the likelier is named.
    """

    imu_s: float = 0.0
    velocity_s: float = 0.0
    sonar_s: float = 0.0
    is_owner_known: bool = True
    confidence: float = 1.0

    @property
    def velocity_after_imu_s(self) -> float:
        """How much later than the IMU's the velocity's stamps are."""
        return self.velocity_s - self.imu_s


def find_delays(
    turns: list[TurnFit],
    way: Callable[[float], VelocityFit | None],
    sure: float,
    likely: float,
) -> Delays:
    """Tell the three clocks apart as far as the echoes show it.

    Parameters
    ----------
    turns : of `fit_turns`: best, other sign, without delay.
    way : fit of the velocity when its stamps are so much later than the IMU's [s].
    sure : confidence from which a delay is believed; of the velocity, from `likely` on.
    """
    best, still = turns[0], turns[2]
    against_imu_s = best.delay_s
    by_turns = confidence_of(best, still)
    if abs(against_imu_s) < _MIN_TURN_DELAY_S or by_turns < sure:
        against_imu_s = 0.0
    together = way(0.0)
    if against_imu_s == 0.0:
        if together is None:
            return Delays()
        moved, moved_s = _best(way)
        if moved is None or abs(moved_s) < _MIN_WAY_DELAY_S:
            return Delays()
        by_way = confidence_of(moved, together, _NUM_WAY_DELAYS)
        return Delays(velocity_s=moved_s, confidence=by_way) if by_way > likely else Delays()
    # The sonar and the IMU differ: the DVL goes with one of them.
    with_sonar = way(against_imu_s)
    is_imu = 0.5
    if together is not None and with_sonar is not None:
        is_imu = confidence_of(with_sonar, together)
    owner = max(is_imu, 1.0 - is_imu)
    is_known, confidence = owner > sure, min(by_turns, owner)
    if is_imu > 0.5:
        return Delays(imu_s=-against_imu_s, is_owner_known=is_known, confidence=confidence)
    return Delays(sonar_s=against_imu_s, is_owner_known=is_known, confidence=confidence)


def _best(way: Callable[[float], VelocityFit | None]) -> tuple[VelocityFit | None, float]:
    coarse = np.arange(-_MAX_DELAY_S, _MAX_DELAY_S + 1e-9, _COARSE_S)
    middle = min(coarse, key=lambda d: _cost(way(float(d))))
    fine = middle + np.arange(-_COARSE_S, _COARSE_S + 1e-9, _FINE_S)
    chosen = float(min(fine, key=lambda d: _cost(way(float(d)))))
    return way(chosen), chosen


def _cost(fit: VelocityFit | None) -> float:
    return np.inf if fit is None else float(np.nanmean(fit.cost))


def late_in_words(delay_s: float) -> str:
    """How much later or earlier."""
    return f"{abs(delay_s):.2f} s {'later' if delay_s > 0.0 else 'earlier'}"
