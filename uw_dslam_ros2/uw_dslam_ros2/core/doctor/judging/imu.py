"""What an IMU says against itself: its yaw, and the integral of its rate."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.doctor.motions.fits import at_times, turned

__all__ = ["ImuState", "compare_yaw_and_rate"]

FloatArray = NDArray[np.float64]

_WINDOW_S = 1.5
_MIN_TURN_RAD = 0.5
_SWING_S = 30.0
_GAP_S = 1.0  # over which nobody knows how the vehicle turned
_MAX_DELAY_S = 2.0
_MIN_DELAY_S = 0.15  # a filter of its own delays an orientation by up to that
_ALIKE = 0.03  # one less a correlation
_DEGREES = 180.0 / math.pi


@dataclass(frozen=True, slots=True, eq=False)
class ImuState:
    """Usable yaws (K,) by orientation and by rates, not wrapped; None where not filled.

    ``ratio`` is how many times faster the rates turn than the orientation (-1: the other way;
    57.3: in degrees), NaN where it cannot be told; ``swing_rad`` the largest change within 30 s
    of the orientation against the rates, their constant difference taken off.
    ``orientation_delay_s`` is how much later than the rates the orientation turned, before it was
    put in time with them.
    """

    by_orientation: FloatArray | None
    by_rates: FloatArray | None
    is_orientation_constant: bool
    are_rates_zero: bool
    ratio: float
    swing_rad: float
    orientation_delay_s: float = 0.0


def compare_yaw_and_rate(
    imu_s: FloatArray, yaw_rad: FloatArray, yaw_rate_rad_s: FloatArray
) -> ImuState:
    """Compare yaw (K,) with yaw rate (K,), each NaN where not said, at times (K,) rising."""
    has_yaw, has_rate = np.isfinite(yaw_rad), np.isfinite(yaw_rate_rad_s)
    yaw = rates = None
    if has_yaw.sum() > 10:
        yaw = np.interp(imu_s, imu_s[has_yaw], np.unwrap(yaw_rad[has_yaw]))
    if has_rate.sum() > 10:
        rates = turned(imu_s, np.interp(imu_s, imu_s[has_rate], yaw_rate_rad_s[has_rate]))
    is_constant = yaw is not None and bool(np.ptp(yaw) < 1e-6)
    are_zero = rates is not None and not yaw_rate_rad_s[has_rate].any()
    if is_constant and rates is not None and np.ptp(rates) < 1e-3:
        is_constant = False  # it may really have stood still
    if are_zero and (yaw is None or is_constant or np.ptp(yaw) < 0.1):
        are_zero = False
    by_yaw = None if is_constant else yaw
    by_rates = None if are_zero else rates
    ratio = swing_rad = math.nan
    delay_s = 0.0
    if by_yaw is not None and by_rates is not None:
        delay_s = _delay(imu_s, by_yaw, by_rates)
        by_yaw = np.interp(imu_s + delay_s, imu_s, by_yaw)
        ratio = _ratio(imu_s, by_yaw, by_rates)
        if math.isfinite(ratio):
            is_said = has_yaw & has_rate
            difference = by_yaw - by_rates / _nearest(ratio)
            swing_rad = _swing(imu_s[is_said], difference[is_said])
    return ImuState(by_yaw, by_rates, is_constant, are_zero, ratio, swing_rad, delay_s)


def _delay(imu_s: FloatArray, yaw: FloatArray, rates: FloatArray) -> float:
    """How much later than the rates the orientation turns [s]; 0 where it is not sure."""
    begin = np.arange(imu_s[0] + _MAX_DELAY_S, imu_s[-1] - _MAX_DELAY_S - _WINDOW_S, 0.25)
    by_rates = at_times(begin + _WINDOW_S, imu_s, rates) - at_times(begin, imu_s, rates)

    def unlike(delay_s: float) -> float:
        late = begin + delay_s
        by_yaw = at_times(late + _WINDOW_S, imu_s, yaw) - at_times(late, imu_s, yaw)
        known = np.isfinite(by_yaw) & np.isfinite(by_rates)
        if known.sum() < 20 or min(np.ptp(by_yaw[known]), np.ptp(by_rates[known])) == 0.0:
            return 1.0
        return 1.0 - abs(float(np.corrcoef(by_yaw[known], by_rates[known])[0, 1]))

    now = at_times(begin + _WINDOW_S, imu_s, yaw) - at_times(begin, imu_s, yaw)
    now = now[np.isfinite(now)]
    if len(now) < 2 or np.ptp(now) < _MIN_TURN_RAD:
        return 0.0
    delays = np.arange(-_MAX_DELAY_S, _MAX_DELAY_S + 1e-9, 0.05)
    costs = np.array([unlike(float(delay_s)) for delay_s in delays])
    best = int(np.argmin(costs))
    is_sure = costs[best] < _ALIKE and costs[best] < 0.25 * unlike(0.0)
    if not is_sure or abs(delays[best]) < _MIN_DELAY_S:
        return 0.0
    around = delays[best] + np.arange(-0.04, 0.041, 0.01)
    return float(min(around, key=lambda delay_s: unlike(float(delay_s))))


def _nearest(ratio: float) -> float:
    """The convention that a ratio stands for."""
    known = (1.0, -1.0, _DEGREES, -_DEGREES)
    return min(known, key=lambda value: abs(math.log(abs(ratio / value))) + (ratio * value < 0.0))


def _ratio(imu_s: FloatArray, yaw: FloatArray, rates: FloatArray) -> float:
    """Turn by rates over turn by yaw, in the median of windows that turn most."""
    begin = np.arange(imu_s[0], imu_s[-1] - _WINDOW_S, 0.5 * _WINDOW_S)
    first = at_times(begin, imu_s, yaw), at_times(begin, imu_s, rates)
    last = at_times(begin + _WINDOW_S, imu_s, yaw), at_times(begin + _WINDOW_S, imu_s, rates)
    by_yaw, by_rates = last[0] - first[0], last[1] - first[1]
    usable = np.isfinite(by_yaw) & np.isfinite(by_rates)
    by_yaw, by_rates = by_yaw[usable], by_rates[usable]
    if len(by_yaw) < 8 or np.abs(by_yaw).sum() < _MIN_TURN_RAD:
        return math.nan
    most = np.abs(by_yaw) >= np.quantile(np.abs(by_yaw), 0.7)
    ratios = by_rates[most] / by_yaw[most]
    middle = float(np.median(ratios))
    spread = float(np.median(np.abs(ratios - middle)))
    return middle if middle and spread < 0.3 * abs(middle) else math.nan


def _swing(imu_s: FloatArray, difference: FloatArray) -> float:
    """Largest change within 30 s of a difference (K,), of which nothing is known over gaps."""
    if len(imu_s) < 2:
        return math.nan
    steps = np.where(np.diff(imu_s) > _GAP_S, 0.0, np.diff(difference))
    grid = np.arange(imu_s[0], imu_s[-1], 0.5)
    difference = at_times(grid, imu_s, np.concatenate([[0.0], np.cumsum(steps)]))
    known = np.isfinite(difference)
    if known.sum() < 20:
        return math.nan
    # The gyro's bias is a straight line, which a median of slopes finds beside a swing.
    t, d = grid[known], difference[known]
    half = len(t) // 2
    slope = float(np.median((d[half:] - d[: len(d) - half]) / (t[half:] - t[: len(t) - half])))
    d = d - slope * t
    width = round(_SWING_S / 0.5)
    spans = [np.ptp(d[i : i + width]) for i in range(0, max(1, len(d) - width // 2), 4)]
    return float(max(spans))
