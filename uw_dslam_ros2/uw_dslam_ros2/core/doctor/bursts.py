"""Which pings of a recording are looked at: bursts of a few, a second apart."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["choose_pings", "more_bursts"]

FloatArray = NDArray[np.float64]

_NUM_BURSTS = 36
_IN_A_BURST = 4
_STEP_S = 1.0
_MAX_STEP_S = 2.0
_MOST, _MAX_TIMES_MORE = 0.7, 3


def choose_pings(
    ping_s: FloatArray,
    imu_s: FloatArray,
    yaw_rate_rad_s: FloatArray,
    num_bursts: int = _NUM_BURSTS,
) -> NDArray[np.int64]:
    """Indices, rising, of pings (P,) that show most of how the sonar moves.

    Half of the bursts are where the rate of yaw (K,) changes most, the others evenly spread.
    Pings that are farther apart than two seconds show nothing, and none is chosen.
    """
    starts = []
    bursts = []
    for first in range(len(ping_s)):
        wanted = ping_s[first] + _STEP_S * np.arange(_IN_A_BURST)
        found = np.searchsorted(ping_s, wanted - 1e-6)
        if found[-1] < len(ping_s) and (np.diff(ping_s[found]) <= _MAX_STEP_S).all():
            starts.append(float(ping_s[first]))
            bursts.append(found)
    if not bursts:
        return np.empty(0, np.int64)
    begin = np.array(starts)
    end = ping_s[np.array(bursts)[:, -1]]
    chosen: list[int] = []
    for index in np.argsort(-_activity(begin, end, imu_s, yaw_rate_rad_s), kind="stable"):
        if len(chosen) >= num_bursts // 2:
            break
        if all(begin[index] > end[k] or end[index] < begin[k] for k in chosen):
            chosen.append(int(index))
    evenly = np.linspace(0, len(begin) - 1, num_bursts // 2).astype(int)
    indices = {int(i) for i in [*chosen, *evenly]}
    return np.unique(np.concatenate([bursts[i] for i in indices]))


def more_bursts(ping_s: FloatArray, share: float) -> int:
    """How many bursts to look at where only a share of the pings shows enough; 0: no more.

    Bursts that lie side by side tell the same twice, so a short recording has no more to tell.
    """
    most = int((ping_s[-1] - ping_s[0]) / (_IN_A_BURST * _STEP_S)) if len(ping_s) else 0
    if share > _MOST or most <= _NUM_BURSTS:
        return 0
    return min(most, _MAX_TIMES_MORE * _NUM_BURSTS)


def _activity(
    begin: FloatArray, end: FloatArray, imu_s: FloatArray, rate: FloatArray
) -> FloatArray:
    """Standard deviation (P,) of the rate in each span; 0 where there is none."""
    known = np.isfinite(rate)
    if known.sum() < 2:
        return np.zeros(len(begin))
    times, values = imu_s[known], rate[known]
    sums = np.concatenate([[0.0], np.cumsum(values)])
    squares = np.concatenate([[0.0], np.cumsum(values**2)])
    first, last = np.searchsorted(times, begin), np.searchsorted(times, end)
    count = np.maximum(last - first, 1)
    mean = (sums[last] - sums[first]) / count
    return np.sqrt(np.maximum((squares[last] - squares[first]) / count - mean**2, 0.0))
