"""Compiled parts of what two maps say about each other at a pose."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["compare_walls", "count_common"]

FloatArray = NDArray[np.float64]
FloatGrid = NDArray[np.float32]
ByteGrid = NDArray[np.uint8]


@njit(cache=True, nogil=True)
def compare_walls(
    points: FloatArray, cos: float, sin: float, x: float, y: float,
    seen: ByteGrid, distance: FloatGrid, free: FloatGrid,
    near_cells: float, far_cells: float, least_free: float,
    is_near: NDArray[np.bool_],
) -> tuple[int, int, int, float]:  # fmt: skip
    """Compare a map's walls (N, 2) [x, y], turned and moved by (x, y), with another map.

    ``seen`` (R, C) is zero where that one is unknown; ``distance`` is to its nearest wall.

    Returns how many lie on known cells, how many of these near a wall (``is_near`` gets which),
    how many far from any on free space, and the sum of the squared distances of the near ones.
    """
    num_rows, num_cols = seen.shape
    num_seen, num_near, num_conflicts, square = 0, 0, 0, 0.0
    for k in range(points.shape[0]):
        is_near[k] = False
        col = math.floor(cos * points[k, 0] - sin * points[k, 1] + x)
        row = math.floor(sin * points[k, 0] + cos * points[k, 1] + y)
        if row < 0 or col < 0 or row >= num_rows or col >= num_cols or seen[row, col] == 0:
            continue
        num_seen += 1
        d = float(distance[row, col])
        if d <= near_cells:
            is_near[k] = True
            num_near += 1
            square += d * d
        elif d > far_cells and free[row, col] > least_free:
            num_conflicts += 1
    return num_seen, num_near, num_conflicts, square


@njit(cache=True, nogil=True)
def count_common(first: ByteGrid, second: ByteGrid) -> tuple[int, int]:
    """Cells known to both maps, and how many of them are near a wall of one plus of the other.

    Both images (R, C) are 0 where unknown, 1 where known, 2 where known and near a wall.
    """
    both, near = 0, 0
    for row in range(first.shape[0]):
        for col in range(first.shape[1]):
            a, b = first[row, col], second[row, col]
            is_both = (a > 0) & (b > 0)
            both += is_both
            near += (is_both & (a > 1)) + (is_both & (b > 1))
    return both, near
