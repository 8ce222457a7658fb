"""How much of a set of wall points a few straight lines explain."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["off_strongest_lines"]


@njit(cache=True, nogil=True)
def off_strongest_lines(
    points: NDArray[np.float64], num_lines: int, num_angles: int, half_width: float
) -> NDArray[np.bool_]:
    """Mask (N,) of the points [x, y] (N, 2) that none of the strongest lines holds.

    Lines are taken greedily, each the strip of ``2 half_width`` that holds most of the points
    left, among ``num_angles`` directions and offsets half a width apart.
    """
    count = points.shape[0]
    is_left = np.ones(count, np.bool_)
    reach = 0.0
    for k in range(count):
        reach = max(reach, math.hypot(points[k, 0], points[k, 1]))
    num_bins = int(2.0 * reach / half_width) + 3
    for _ in range(num_lines):
        best, best_angle, best_bin = 0, 0.0, 0
        for step in range(num_angles):
            angle = step * math.pi / num_angles
            cos, sin = math.cos(angle), math.sin(angle)
            bins = np.zeros(num_bins, np.int64)
            for k in range(count):
                if is_left[k]:
                    bins[int((cos * points[k, 0] + sin * points[k, 1] + reach) / half_width)] += 1
            for index in range(num_bins - 1):
                if bins[index] + bins[index + 1] > best:
                    best = bins[index] + bins[index + 1]
                    best_angle, best_bin = angle, index
        cos, sin = math.cos(best_angle), math.sin(best_angle)
        for k in range(count):
            index = int((cos * points[k, 0] + sin * points[k, 1] + reach) / half_width)
            if is_left[k] and (index == best_bin or index == best_bin + 1):
                is_left[k] = False
    return is_left
