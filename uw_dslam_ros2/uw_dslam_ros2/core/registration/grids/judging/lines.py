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
) -> NDArray[np.float64]:
    """By how much (N,) each of the points [x, y] (N, 2) lies off the strongest lines, 0 to 1.

    Lines are taken greedily, each the strip of ``2 half_width`` that holds most of the points
    left, among ``num_angles`` directions and offsets half a width apart. A point within the strip
    counts 0, one a half width outside of it 1: what is at the edge does not jump.
    """
    count = points.shape[0]
    left = np.ones(count)
    reach = 0.0
    for k in range(count):
        reach = max(reach, math.hypot(points[k, 0], points[k, 1]))
    num_bins = int(2.0 * reach / half_width) + 3
    for _ in range(num_lines):
        best, best_angle, best_bin = 0.0, 0.0, 0
        for step in range(num_angles):
            angle = step * math.pi / num_angles
            cos, sin = math.cos(angle), math.sin(angle)
            bins = np.zeros(num_bins)
            for k in range(count):
                if left[k] > 0.0:
                    offset = cos * points[k, 0] + sin * points[k, 1] + reach
                    bins[int(offset / half_width)] += left[k]
            for index in range(num_bins - 1):
                if bins[index] + bins[index + 1] > best:
                    best = bins[index] + bins[index + 1]
                    best_angle, best_bin = angle, index
        cos, sin = math.cos(best_angle), math.sin(best_angle)
        middle = (best_bin + 1) * half_width - reach
        for k in range(count):
            distance = abs(cos * points[k, 0] + sin * points[k, 1] - middle)
            left[k] *= min(max(distance / half_width - 1.0, 0.0), 1.0)
    return left
