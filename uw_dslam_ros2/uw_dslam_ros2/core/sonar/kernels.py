"""Compiled loops of the front end.

Arrays [range, beam]; the inner loop always runs over beams, which lie together.
"""

from __future__ import annotations

import numpy as np
from numba import njit

__all__ = ["cfar_ratio", "neighbor_counts", "row_ratio", "select_returns", "to_power"]


@njit(cache=True, nogil=True)
def to_power(intensity, is_amplitude, first_row, last_row):  # type: ignore[no-untyped-def]
    """Rows [first_row, last_row) as float32 power."""
    num_beams = intensity.shape[1]
    power = np.empty((last_row - first_row, num_beams), np.float32)
    for r in range(last_row - first_row):
        for b in range(num_beams):
            value = np.float32(intensity[first_row + r, b])
            power[r, b] = value * value if is_amplitude else value
    return power


@njit(cache=True, nogil=True)
def cfar_ratio(power, num_train, num_guard, ca_factors, so_factor, floor):  # type: ignore[no-untyped-def]
    """Power over its threshold, (R, B) float32; above 1 is an echo.

    The threshold is the larger of `floor` and a factor times the noise mean: of the quieter side
    where `so_factor` is positive and both sides are complete, else of all cells there are.
    """
    num_rows, num_beams = power.shape
    ratio = np.zeros((num_rows, num_beams), np.float32)
    lead = np.zeros(num_beams, np.float64)  # farther cells
    lag = np.zeros(num_beams, np.float64)  # nearer cells
    for r in range(num_guard + 1, min(num_rows, num_guard + 1 + num_train)):
        for b in range(num_beams):
            lead[b] += power[r, b]
    for r in range(num_rows):
        num_lead = max(0, min(num_rows, r + num_guard + 1 + num_train) - (r + num_guard + 1))
        num_lag = max(0, (r - num_guard) - max(0, r - num_guard - num_train))
        is_smallest = so_factor > 0.0 and num_lead == num_train and num_lag == num_train
        if is_smallest:
            share = so_factor / num_train
            for b in range(num_beams):
                threshold = max(share * min(lead[b], lag[b]), floor)
                ratio[r, b] = power[r, b] / threshold if threshold > 0.0 else np.float32(0.0)
        else:
            share = ca_factors[num_lead + num_lag] / max(num_lead + num_lag, 1)
            for b in range(num_beams):
                threshold = max(share * (lead[b] + lag[b]), floor)
                if num_lead + num_lag > 0 and threshold > 0.0:
                    ratio[r, b] = power[r, b] / threshold
        # Slide both windows by one range.
        gone, come = r + num_guard + 1, r + num_guard + 1 + num_train
        if gone < num_rows:
            for b in range(num_beams):
                lead[b] -= power[gone, b]
        if come < num_rows:
            for b in range(num_beams):
                lead[b] += power[come, b]
        gone, come = r - num_guard - num_train, r - num_guard
        if come >= 0:
            for b in range(num_beams):
                lag[b] += power[come, b]
        if gone >= 0:
            for b in range(num_beams):
                lag[b] -= power[gone, b]
    return ratio


@njit(cache=True, nogil=True)
def row_ratio(power, factor, floor):  # type: ignore[no-untyped-def]
    """Power over median + factor * spread of its range; (R, B) float32.

    The spread is twice the way from the lower quartile to the median, so that echoes in up to half
    of the beams do not raise it. At most 128 beams, evenly chosen, are looked at.
    """
    num_rows, num_beams = power.shape
    ratio = np.zeros((num_rows, num_beams), np.float32)
    stride = (num_beams + 127) // 128
    sample = np.empty((num_beams + stride - 1) // stride, np.float32)
    for r in range(num_rows):
        for k in range(sample.shape[0]):
            sample[k] = power[r, k * stride]
        ordered = np.sort(sample)
        middle = np.float64(ordered[sample.shape[0] // 2])
        spread = 2.0 * (middle - np.float64(ordered[sample.shape[0] // 4]))
        threshold = max(middle + factor * spread, floor)
        if threshold > 0.0:
            for b in range(num_beams):
                ratio[r, b] = power[r, b] / threshold
    return ratio


@njit(cache=True, nogil=True)
def _vertex(below, here, above):  # type: ignore[no-untyped-def]
    """Peak of the parabola through three samples, within half a bin of the middle one."""
    curvature = below - 2.0 * here + above
    if curvature >= 0.0:
        return 0.0
    return min(0.5, max(-0.5, 0.5 * (below - above) / curvature))


@njit(cache=True, nogil=True)
def select_returns(power, ratio, mode, min_gap_bins):  # type: ignore[no-untyped-def]
    """Echoes of each beam: local maxima above the threshold.

    `mode` 0: the first, 1: the strongest, 2: all that lie `min_gap_bins` from the one before.
    Returns beam (N,) and bin (N,) with fraction, ratio (N,), and the first bin above threshold
    (B,), -1: none.
    """
    num_rows, num_beams = ratio.shape
    first_above = np.full(num_beams, -1, np.int64)
    best_row = np.full(num_beams, -1, np.int64)
    last_row = np.full(num_beams, -1.0, np.float64)
    capacity = num_beams if mode < 2 else max(num_beams, 1024)
    beams = np.empty(capacity, np.int64)
    rows = np.empty(capacity, np.int64)
    count = 0
    for r in range(num_rows):
        for b in range(num_beams):
            if ratio[r, b] <= 1.0:
                continue
            if first_above[b] < 0:
                first_above[b] = r
            if mode == 0 and best_row[b] >= 0:
                continue
            value = power[r, b]
            # Of a plateau the first sample counts, so that saturated echoes are found once.
            if (r > 0 and power[r - 1, b] >= value) or (
                r + 1 < num_rows and power[r + 1, b] > value
            ):
                continue
            if mode == 2:
                if last_row[b] >= 0.0 and r - last_row[b] < min_gap_bins:
                    continue
                last_row[b] = r
                if count == capacity:
                    capacity *= 2
                    more_beams, more_rows = (
                        np.empty(capacity, np.int64),
                        np.empty(capacity, np.int64),
                    )
                    more_beams[:count], more_rows[:count] = beams[:count], rows[:count]
                    beams, rows = more_beams, more_rows
                beams[count], rows[count] = b, r
                count += 1
            elif best_row[b] < 0 or ratio[r, b] > ratio[best_row[b], b]:
                best_row[b] = r
    if mode < 2:
        for b in range(num_beams):
            if best_row[b] >= 0:
                beams[count], rows[count] = b, best_row[b]
                count += 1
    bins = np.empty(count, np.float64)
    strengths = np.empty(count, np.float64)
    for i in range(count):
        r, b = rows[i], beams[i]
        end = r
        while end + 1 < num_rows and power[end + 1, b] == power[r, b]:
            end += 1
        bins[i] = 0.5 * (r + end)
        if end == r and 0 < r < num_rows - 1:
            bins[i] += _vertex(
                np.float64(power[r - 1, b]), np.float64(power[r, b]), np.float64(power[r + 1, b])
            )
        strengths[i] = ratio[r, b]
    return beams[:count].copy(), bins, strengths, first_above


@njit(cache=True, nogil=True)
def neighbor_counts(points, reach):  # type: ignore[no-untyped-def]
    """How many other points (N, 2) lie within ``reach[i]`` of point i.

    Points sorted by x (rising).
    """
    num_points = points.shape[0]
    counts = np.zeros(num_points, np.int64)
    for i in range(num_points):
        limit = reach[i] * reach[i]
        for direction in (-1, 1):
            j = i + direction
            while 0 <= j < num_points:
                dx = points[j, 0] - points[i, 0]
                if abs(dx) > reach[i]:
                    break
                dy = points[j, 1] - points[i, 1]
                if dx * dx + dy * dy <= limit:
                    counts[i] += 1
                j += direction
    return counts
