"""Compiled loops of scan matching."""

from __future__ import annotations

import numpy as np
from numba import njit

__all__ = ["derivatives", "score_poses", "score_window", "splat"]


@njit(cache=True, nogil=True)
def splat(field, points, weight, origin_x, origin_y, cell, sigma, support):  # type: ignore[no-untyped-def]
    """Fill `field` with ``1 - exp(-density / support)``.

    The density is the sum of ``weight * exp(-d^2 / (2 sigma^2))`` over the points (N, 2), each as
    far as 3.5 sigma; `field` must come as zeros.
    """
    num_rows, num_cols = field.shape
    reach = 3.5 * sigma
    width = int(2.0 * reach / cell) + 3
    along, across = np.empty(width), np.empty(width)
    for i in range(points.shape[0]):
        px, py = points[i, 0] - origin_x, points[i, 1] - origin_y
        c0 = max(0, int(np.floor((px - reach) / cell)))
        c1 = min(num_cols - 1, int(np.floor((px + reach) / cell)))
        r0 = max(0, int(np.floor((py - reach) / cell)))
        r1 = min(num_rows - 1, int(np.floor((py + reach) / cell)))
        # A Gaussian is a product: one exponential for each column and each row.
        for col in range(c0, c1 + 1):
            along[col - c0] = np.exp(-0.5 * (((col + 0.5) * cell - px) / sigma) ** 2)
        for row in range(r0, r1 + 1):
            across[row - r0] = weight[i] * np.exp(-0.5 * (((row + 0.5) * cell - py) / sigma) ** 2)
        for row in range(r0, r1 + 1):
            for col in range(c0, c1 + 1):
                field[row, col] += across[row - r0] * along[col - c0]
    for row in range(num_rows):
        for col in range(num_cols):
            if field[row, col] > 0.0:
                field[row, col] = 1.0 - np.exp(-field[row, col] / support)


@njit(cache=True, nogil=True)
def _value(field, u, v):  # type: ignore[no-untyped-def]
    """Bilinear value at column `u`, row `v`, counted from the centre of cell (0, 0); 0 outside."""
    col, row = int(np.floor(u)), int(np.floor(v))
    if row < 0 or col < 0 or row + 1 >= field.shape[0] or col + 1 >= field.shape[1]:
        return 0.0
    a, b = u - col, v - row
    return (1.0 - b) * ((1.0 - a) * field[row, col] + a * field[row, col + 1]) + b * (
        (1.0 - a) * field[row + 1, col] + a * field[row + 1, col + 1]
    )


@njit(cache=True, nogil=True)
def score_poses(field, origin_x, origin_y, cell, points, weight, poses):  # type: ignore[no-untyped-def]
    """Sum of weighted field values under the points (N, 2), moved by each pose (K, 3); (K,)."""
    scores = np.zeros(poses.shape[0])
    for k in range(poses.shape[0]):
        cos, sin = np.cos(poses[k, 2]), np.sin(poses[k, 2])
        x0, y0 = poses[k, 0] - origin_x, poses[k, 1] - origin_y
        total = 0.0
        for i in range(points.shape[0]):
            u = (x0 + cos * points[i, 0] - sin * points[i, 1]) / cell - 0.5
            v = (y0 + sin * points[i, 0] + cos * points[i, 1]) / cell - 0.5
            total += weight[i] * _value(field, u, v)
        scores[k] = total
    return scores


@njit(cache=True, nogil=True)
def score_window(  # type: ignore[no-untyped-def]
    field, origin_x, origin_y, cell, points, weight, center, num_steps, step, yaw_step
):  # fmt: skip
    """Scores of a lattice of poses around `center` (3,): (yaw, y, x) of 2 * num_steps + 1 each.

    `num_steps` (3,) counts x, y and yaw steps to each side; nearest cells, no interpolation.
    """
    num_rows, num_cols = field.shape
    nx, ny, nt = num_steps[0], num_steps[1], num_steps[2]
    scores = np.zeros((2 * nt + 1, 2 * ny + 1, 2 * nx + 1))
    for t in range(2 * nt + 1):
        yaw = center[2] + (t - nt) * yaw_step
        cos, sin = np.cos(yaw), np.sin(yaw)
        for i in range(points.shape[0]):
            px = center[0] - origin_x + cos * points[i, 0] - sin * points[i, 1] - nx * step
            py = center[1] - origin_y + sin * points[i, 0] + cos * points[i, 1] - ny * step
            for m in range(2 * ny + 1):
                row = int(np.floor((py + m * step) / cell))
                if row < 0 or row >= num_rows:
                    continue
                for n in range(2 * nx + 1):
                    col = int(np.floor((px + n * step) / cell))
                    if 0 <= col < num_cols:
                        scores[t, m, n] += weight[i] * field[row, col]
    return scores


@njit(cache=True, nogil=True)
def derivatives(field, origin_x, origin_y, cell, points, weight, pose, steps):  # type: ignore[no-untyped-def]
    """Gradient (3,) and Hessian (3, 3) of the score at a pose (3,), by central differences.

    `steps` (3,) [m, m, rad] smooth the jumps between cells.
    """
    poses = np.empty((19, 3))
    poses[:] = pose
    row = 7
    for i in range(3):
        poses[1 + 2 * i, i] += steps[i]
        poses[2 + 2 * i, i] -= steps[i]
        for j in range(i + 1, 3):
            for k, (first, second) in enumerate(((1, 1), (-1, -1), (1, -1), (-1, 1))):
                poses[row + k, i] += first * steps[i]
                poses[row + k, j] += second * steps[j]
            row += 4
    s = score_poses(field, origin_x, origin_y, cell, points, weight, poses)
    gradient, hessian = np.empty(3), np.empty((3, 3))
    row = 7
    for i in range(3):
        gradient[i] = (s[1 + 2 * i] - s[2 + 2 * i]) / 2.0 / steps[i]
        hessian[i, i] = (s[1 + 2 * i] + s[2 + 2 * i] - 2.0 * s[0]) / steps[i] ** 2
        for j in range(i + 1, 3):
            mixed = s[row] + s[row + 1] - s[row + 2] - s[row + 3]
            hessian[i, j] = hessian[j, i] = mixed / (4.0 * steps[i] * steps[j])
            row += 4
    return gradient, hessian
