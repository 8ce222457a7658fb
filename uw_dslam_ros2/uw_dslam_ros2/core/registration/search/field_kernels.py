# mypy: allow-untyped-defs
"""Compiled parts of the fields: sampling Gaussians, spline values, bound tables."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

__all__ = ["add_gaussians", "fill_first_level", "fill_pyramid", "fill_windows", "spline_values"]


@njit(cache=True, nogil=True)
def spline_values(coefficients, nodes):
    """Values (N,) at positions (N, 2) in units of the lattice."""
    num_rows, num_cols = coefficients.shape
    values = np.zeros(nodes.shape[0])
    for k in range(nodes.shape[0]):
        u, v = nodes[k, 0], nodes[k, 1]
        if not (0.5 <= u < num_cols - 1.5 and 0.5 <= v < num_rows - 1.5):
            continue
        i, j = math.floor(u + 0.5), math.floor(v + 0.5)
        a, b = u - i, v - j
        wa = (0.5 * (0.5 - a) ** 2, 0.75 - a * a, 0.5 * (0.5 + a) ** 2)
        wb = (0.5 * (0.5 - b) ** 2, 0.75 - b * b, 0.5 * (0.5 + b) ** 2)
        for row in range(3):
            line = 0.0
            for col in range(3):
                line += wa[col] * coefficients[j + row - 1, i + col - 1]
            values[k] += wb[row] * line
    return values


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
def fill_pyramid(window, table, levels):
    """Each window is the union of four half as wide, one level below; the first of ``window``s."""
    num_rows, num_cols = window.shape
    below_shift, half = 0, 1 << (levels[0, 2] + 1)
    below = window.ravel()
    below_rows, below_cols = num_rows, num_cols
    for level in range(levels.shape[0]):
        offset, cols, shift = levels[level, 0], levels[level, 1], levels[level, 2]
        rows = ((num_rows - 1) >> shift) + 1
        step, ahead = 1 << (shift - below_shift), half >> below_shift
        for row in range(rows):
            top = row * step
            bottom = min(top + ahead, below_rows - 1)
            for col in range(cols):
                left = col * step
                right = min(left + ahead, below_cols - 1)
                table[offset + row * cols + col] = max(
                    max(below[top * below_cols + left], below[top * below_cols + right]),
                    max(below[bottom * below_cols + left], below[bottom * below_cols + right]),
                )
        below = table[offset : offset + rows * cols]
        below_rows, below_cols, below_shift, half = rows, cols, shift, 2 * half


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
