# mypy: allow-untyped-defs
"""Compiled parts of the fields: sampling Gaussians, bound tables."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

__all__ = ["add_gaussians", "fill_first_level", "fill_windows"]


@njit(cache=True, nogil=True)
def gaussian_samples(center, sigma, first, count, is_interpolated, out):
    """Samples of one axis, or the coefficients of the spline that follows them."""
    scale = -0.5 / (sigma * sigma)
    d = first - center
    before, value = math.exp(scale * (d - 1.0) ** 2), math.exp(scale * d * d)
    for k in range(count):
        d = first + k + 1 - center
        after = math.exp(scale * d * d)
        out[k] = 1.25 * value - 0.125 * (before + after) if is_interpolated else value
        before, value = value, after


@njit(cache=True, nogil=True)
def add_gaussians(grid, centers, weights, sigmas, tail_sigmas, is_interpolated):
    """Add separable Gaussians, in units of the lattice, up to their tails."""
    num_rows, num_cols = grid.shape
    size = 0
    for j in range(sigmas.shape[0]):
        size = max(size, 2 * math.ceil(tail_sigmas * sigmas[j]) + 3)
    along_x, along_y = np.empty(size), np.empty(size)
    for j in range(centers.shape[0]):
        reach = tail_sigmas * sigmas[j]
        first_x = max(2, math.floor(centers[j, 0] - reach))
        first_y = max(2, math.floor(centers[j, 1] - reach))
        count_x = min(num_cols - 3, math.ceil(centers[j, 0] + reach)) - first_x + 1
        count_y = min(num_rows - 3, math.ceil(centers[j, 1] + reach)) - first_y + 1
        gaussian_samples(centers[j, 0], sigmas[j], first_x, count_x, is_interpolated, along_x)
        gaussian_samples(centers[j, 1], sigmas[j], first_y, count_y, is_interpolated, along_y)
        for row in range(count_y):
            factor = weights[j] * along_y[row]
            line = grid[first_y + row, first_x : first_x + max(count_x, 0)]
            for col in range(count_x):
                line[col] += factor * along_x[col]


@njit(cache=True, nogil=True)
def fill_first_level(coefficients, scale, bounds, curvatures):
    """Per cell: largest Bezier control value, and largest eigenvalue of second derivatives."""
    num_rows, num_cols = coefficients.shape
    up = np.float64(1.0) + 2.0**-20
    for row in range(num_rows):
        for col in range(num_cols):
            if row == 0 or col == 0 or row == num_rows - 1 or col == num_cols - 1:
                bounds[row, col] = 0.0
                curvatures[row, col] = 0.0
                continue
            c = np.float64(coefficients[row, col])
            n, s = np.float64(coefficients[row + 1, col]), np.float64(coefficients[row - 1, col])
            e, w = np.float64(coefficients[row, col + 1]), np.float64(coefficients[row, col - 1])
            ne, nw = (
                np.float64(coefficients[row + 1, col + 1]),
                np.float64(coefficients[row + 1, col - 1]),
            )
            se, sw = (
                np.float64(coefficients[row - 1, col + 1]),
                np.float64(coefficients[row - 1, col - 1]),
            )
            best = max(c, 0.5 * (c + max(max(n, s), max(e, w))))
            best = max(
                best, 0.25 * (c + max(max(n + e + ne, n + w + nw), max(s + e + se, s + w + sw)))
            )
            bounds[row, col] = np.float32(best + abs(best) * 2.0**-20)
            xx, xx_n, xx_s = e - 2.0 * c + w, ne - 2.0 * n + nw, se - 2.0 * s + sw
            yy, yy_e, yy_w = n - 2.0 * c + s, ne - 2.0 * e + se, nw - 2.0 * w + sw
            fxx = max(xx, max(0.5 * (xx + xx_n), 0.5 * (xx + xx_s)))
            fyy = max(yy, max(0.5 * (yy + yy_e), 0.5 * (yy + yy_w)))
            fxy = max(
                max(abs(ne - n - e + c), abs(n - nw - c + w)),
                max(abs(e - c - se + s), abs(c - w - s + sw)),
            )
            half = 0.5 * (fxx - fyy)
            largest = scale * (0.5 * (fxx + fyy) + math.sqrt(half * half + fxy * fxy))
            slack = scale * (abs(c) + abs(n) + abs(s) + abs(e) + abs(w)) * 2.0**-45
            curvatures[row, col] = np.float32(largest + abs(largest) * (up - 1.0) + slack)


@njit(cache=True, nogil=True)
def fill_windows(tables):
    """``tables[k]``: maxima over 2^k x 2^k cells from each cell on, clipped at the edge."""
    num_levels, num_rows, num_cols = tables.shape
    for level in range(1, num_levels):
        half = 1 << (level - 1)
        below = tables[level - 1]
        inside = max(num_cols - half, 0)
        for row in range(num_rows):
            first, second = below[row], below[min(row + half, num_rows - 1)]
            line = tables[level, row]
            first_right, second_right = first[half:], second[half:]
            # Two loops without a branch, so that the compiler uses vector instructions.
            for col in range(inside):
                line[col] = max(
                    max(first[col], first_right[col]), max(second[col], second_right[col])
                )
            last = max(first[num_cols - 1], second[num_cols - 1])
            for col in range(inside, num_cols):
                line[col] = max(max(first[col], second[col]), last)
