"""Compiled loops that draw walls' faces where echoes heap up."""

from __future__ import annotations

import numpy as np
from numba import njit

__all__ = ["draw_faces"]


@njit(cache=True, nogil=True)
def _smoothed(values, taps):  # type: ignore[no-untyped-def]
    """Weighted means (R, C) int32 of whole numbers, none negative, by a separable kernel.

    The taps, of odd number, sum to 256.
    """
    num_rows, num_cols = values.shape
    reach = taps.shape[0] // 2
    across = np.zeros((num_rows, num_cols), np.int32)
    smooth = np.zeros((num_rows, num_cols), np.int32)
    has_any = np.zeros(num_rows, np.bool_)
    line = np.zeros(num_cols, np.int64)
    for row in range(num_rows):
        # Echoes are few: they are spread, not gathered.
        for col in range(num_cols):
            value = np.int64(values[row, col])
            if value > 0:
                has_any[row] = True
                for c in range(max(0, col - reach), min(num_cols, col + reach + 1)):
                    line[c] += taps[c - col + reach] * value
        if has_any[row]:
            for col in range(num_cols):
                across[row, col] = (line[col] + 128) >> 8
            line[:] = 0
    for row in range(num_rows):
        first, last = max(0, row - reach), min(num_rows - 1, row + reach)
        if not has_any[first : last + 1].any():
            continue
        line[:] = 0
        for r in range(first, last + 1):
            if has_any[r]:
                tap = taps[r - row + reach]
                for col in range(num_cols):
                    line[col] += tap * across[r, col]
        for col in range(num_cols):
            smooth[row, col] = (line[col] + 128) >> 8
    return smooth


@njit(cache=True, nogil=True)
def _crest_distance(heap, row, col):  # type: ignore[no-untyped-def]
    """How far [cells] a cell's centre lies from the crest of a heap; infinite: there is none.

    A quadratic is fitted to the 3 x 3 cells (Haralick's facet model); the crest runs where it is
    highest across its sharpest bend (Steger 1998, IEEE PAMI 20(2)).
    """
    num_rows, num_cols = heap.shape
    z = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            r, c = row + i - 1, col + j - 1
            if 0 <= r < num_rows and 0 <= c < num_cols:
                z[i, j] = heap[r, c]
    left, right = z[0, 0] + z[1, 0] + z[2, 0], z[0, 2] + z[1, 2] + z[2, 2]
    low, high = z[0, 0] + z[0, 1] + z[0, 2], z[2, 0] + z[2, 1] + z[2, 2]
    total = left + right + z[0, 1] + z[1, 1] + z[2, 1]
    slope_x, slope_y = (right - left) / 6.0, (high - low) / 6.0
    bend_xx = (3.0 * (left + right) - 2.0 * total) / 3.0
    bend_yy = (3.0 * (low + high) - 2.0 * total) / 3.0
    bend_xy = (z[2, 2] + z[0, 0] - z[0, 2] - z[2, 0]) / 4.0
    half = 0.5 * (bend_xx - bend_yy)
    mean = 0.5 * (bend_xx + bend_yy)
    if mean >= 0.0:  # on a flank, which only along the wall has tops
        return np.inf
    least = mean - np.sqrt(half * half + bend_xy * bend_xy)
    # The eigenvector of the least eigenvalue, from the row that is farther from zero.
    if abs(bend_xx - least) > abs(bend_yy - least):
        nx, ny = -bend_xy, bend_xx - least
    else:
        nx, ny = bend_yy - least, -bend_xy
    size = np.sqrt(nx * nx + ny * ny)
    if size == 0.0:  # a round top bends alike every way
        return np.sqrt(slope_x * slope_x + slope_y * slope_y) / -least
    return abs(slope_x * nx + slope_y * ny) / size / -least


@njit(cache=True, nogil=True)
def _is_tail(heap, row, col, reach, share):  # type: ignore[no-untyped-def]
    """Whether something `reach` cells around is so much higher that `share` of it is more."""
    num_rows, num_cols = heap.shape
    limit = heap[row, col] / share
    for r in range(max(0, row - reach), min(num_rows, row + reach + 1)):
        for c in range(max(0, col - reach), min(num_cols, col + reach + 1)):
            if heap[r, c] > limit:
                return True
    return False


@njit(cache=True, nogil=True)
def draw_faces(  # type: ignore[no-untyped-def]
    echoes, water, taps, gain, free, against, half_width, reach, least_share
):  # fmt: skip
    """Log-odds (R, C) and what was observed, of summed evidence (see `add_ping`).

    Where pings heard a wall their echoes heap up: smoothed by `taps` and scaled by `gain`, the
    face runs along the crest of the heap, `half_width` cells to each side. What is lower than
    `least_share` of something within `reach` cells is that one's tail. What lies before a face is
    as free as it was seen to be, unless more echoes came from there; what lies behind it nobody
    has seen. A ping that looked through takes `free` off free water and `against` off a face.
    """
    num_rows, num_cols = echoes.shape
    log_odds = np.zeros((num_rows, num_cols), np.int32)
    observed = np.zeros((num_rows, num_cols), np.bool_)
    heap = _smoothed(echoes, taps)
    for row in range(num_rows):
        for col in range(num_cols):
            passed = np.int32(free * water[row, col])
            said = np.int32(np.rint(gain * heap[row, col]))
            is_face = said > 0 and _crest_distance(heap, row, col) <= half_width
            if is_face and not _is_tail(heap, row, col, reach, least_share):
                log_odds[row, col] = said - np.int32(against * water[row, col])
                observed[row, col] = True
                continue
            # Beside a face more echoes than water: neither a wall nor free.
            if passed > said:
                log_odds[row, col] = -passed
                observed[row, col] = True
    return log_odds, observed
