"""Which pings of a recording are looked at: bursts of a few, a second apart."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["choose_pings", "more_pings"]

FloatArray = NDArray[np.float64]

_NUM_BURSTS = 36
_IN_A_BURST = 4
_STEP_S = 1.0
_MAX_STEP_S = 2.0
_ENOUGH = 0.7
_MOST_PINGS = 432
_APART_S = 0.25  # pings closer together tell nearly the same
_GOLDEN = 0.5 * (5.0**0.5 - 1.0)


def choose_pings(
    ping_s: FloatArray, imu_s: FloatArray, yaw_rate_rad_s: FloatArray
) -> NDArray[np.int64]:
    """Indices, rising, of pings (P,) that show most of how the sonar moves.

    Half of the bursts are where the rate of yaw (K,) changes most, the others evenly spread.
    Pings that are farther apart than two seconds show nothing, and none is chosen.
    """
    bursts = _bursts(ping_s)
    if not len(bursts):
        return np.empty(0, np.int64)
    begin, end = ping_s[bursts[:, 0]], ping_s[bursts[:, -1]]
    chosen: list[int] = []
    for index in np.argsort(-_activity(begin, end, imu_s, yaw_rate_rad_s), kind="stable"):
        if len(chosen) >= _NUM_BURSTS // 2:
            break
        if all(begin[index] > end[k] or end[index] < begin[k] for k in chosen):
            chosen.append(int(index))
    evenly = np.linspace(0, len(begin) - 1, _NUM_BURSTS // 2).astype(int)
    indices = {int(i) for i in [*chosen, *evenly]}
    return np.unique(np.concatenate([bursts[i] for i in indices]))


def more_pings(
    ping_s: FloatArray, seen_s: FloatArray, has_echoes: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Indices, rising, of further pings (P,) to look at where few of those seen (S,) show enough.

    They lie where the pings seen next to them have echoes: all of them, or bursts from the whole
    recording where they are many. There are none where most of those seen have echoes.
    """
    bursts = _bursts(ping_s)
    if not len(bursts) or not len(seen_s) or has_echoes.mean() > _ENOUGH:
        return np.empty(0, np.int64)
    right = np.clip(np.searchsorted(seen_s, ping_s), 1, max(1, len(seen_s) - 1))
    right = np.minimum(right, len(seen_s) - 1)
    left = np.maximum(right - 1, 0)
    is_left_nearer = ping_s - seen_s[left] <= seen_s[right] - ping_s
    nearest = np.where(is_left_nearer, left, right)
    is_promising = has_echoes[nearest]
    is_new = np.abs(ping_s - seen_s[nearest]) >= _APART_S
    room = _MOST_PINGS - len(seen_s)
    if np.count_nonzero(is_promising & is_new) <= room:
        return _apart(ping_s, np.flatnonzero(is_promising & is_new))
    taken: list[int] = []
    # Steps of the golden ratio go everywhere before they go anywhere twice.
    for index in np.argsort(np.mod(np.arange(len(bursts)) * _GOLDEN, 1.0), kind="stable"):
        burst = bursts[index]
        if len(taken) + _IN_A_BURST > room:
            break
        if is_promising[burst].sum() > _IN_A_BURST // 2 and is_new[burst].all():
            is_new[burst] = False
            taken += burst.tolist()
    return np.array(sorted(taken), np.int64)


def _apart(ping_s: FloatArray, indices: NDArray[np.int64]) -> NDArray[np.int64]:
    """Those of some pings, rising, that do not follow another at once."""
    kept: list[int] = []
    for index in indices:
        if not kept or ping_s[index] - ping_s[kept[-1]] >= _APART_S:
            kept.append(int(index))
    return np.array(kept, np.int64)


def _bursts(ping_s: FloatArray) -> NDArray[np.int64]:
    """Indices (N, 4) of pings a second apart, one row for each ping that can begin such."""
    bursts = []
    for first_s in ping_s:
        wanted = first_s + _STEP_S * np.arange(_IN_A_BURST)
        found = np.searchsorted(ping_s, wanted - 1e-6)
        if found[-1] < len(ping_s) and (np.diff(ping_s[found]) <= _MAX_STEP_S).all():
            bursts.append(found)
    return np.array(bursts, np.int64).reshape(-1, _IN_A_BURST)


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
