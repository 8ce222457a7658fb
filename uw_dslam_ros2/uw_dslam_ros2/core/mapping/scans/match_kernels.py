"""Compiled loops of scan matching."""

from __future__ import annotations

import numpy as np
from numba import njit

__all__ = ["climb", "derivatives", "score_poses", "score_window", "splat"]


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
    """Score, gradient (3,) and Hessian (3, 3) at a pose by central differences.

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
    return s[0], gradient, hessian


@njit(cache=True, nogil=True)
def _absolute(matrix):  # type: ignore[no-untyped-def]
    """A symmetric matrix (n, n) with its eigenvalues' absolute values, by Jacobi's rotations.

    numba's `np.linalg.eigh` finds the same and takes long to compile.
    """
    size = len(matrix)
    rest, vectors = matrix.copy(), np.eye(size)
    for _ in range(30):
        largest = 0.0
        for p in range(size):
            for q in range(p + 1, size):
                if rest[p, q] ** 2 <= 1e-30 * np.abs(rest[p, p] * rest[q, q]):
                    continue
                largest = max(largest, np.abs(rest[p, q]))
                angle = 0.5 * np.arctan2(2.0 * rest[p, q], rest[q, q] - rest[p, p])
                cos, sin = np.cos(angle), np.sin(angle)
                for k in range(size):
                    a, b = rest[k, p], rest[k, q]
                    rest[k, p], rest[k, q] = cos * a - sin * b, sin * a + cos * b
                    a, b = vectors[k, p], vectors[k, q]
                    vectors[k, p], vectors[k, q] = cos * a - sin * b, sin * a + cos * b
                for k in range(size):
                    a, b = rest[p, k], rest[q, k]
                    rest[p, k], rest[q, k] = cos * a - sin * b, sin * a + cos * b
        if largest == 0.0:
            break
    result = np.zeros((size, size))
    for k in range(size):
        for i in range(size):
            for j in range(size):
                result[i, j] += vectors[i, k] * np.abs(rest[k, k]) * vectors[j, k]
    return result


@njit(cache=True, nogil=True)
def _solved(matrix, right):  # type: ignore[no-untyped-def]
    """Solution (n,) of a small system, by elimination with pivots."""
    a, x = matrix.copy(), right.copy()
    size = len(x)
    for i in range(size):
        pivot = i + np.argmax(np.abs(a[i:, i]))
        for j in range(size):
            a[i, j], a[pivot, j] = a[pivot, j], a[i, j]
        x[i], x[pivot] = x[pivot], x[i]
        for k in range(i + 1, size):
            factor = a[k, i] / a[i, i]
            for j in range(i, size):
                a[k, j] -= factor * a[i, j]
            x[k] -= factor * x[i]
    for i in range(size - 1, -1, -1):
        for j in range(i + 1, size):
            x[i] -= a[i, j] * x[j]
        x[i] /= a[i, i]
    return x


@njit(cache=True, nogil=True)
def _log_prior(pose, mean, information):  # type: ignore[no-untyped-def]
    """Its value, and its gradient (3,)."""
    delta = pose - mean
    delta[2] = (delta[2] + np.pi) % (2.0 * np.pi) - np.pi
    value, slope = 0.0, np.zeros(3)
    for i in range(3):
        for j in range(3):
            slope[i] -= information[i, j] * delta[j]
        value += 0.5 * slope[i] * delta[i]
    return value, slope


@njit(cache=True, nogil=True)
def climb(  # type: ignore[no-untyped-def]
    field, origin_x, origin_y, cell, points, weight, start, mean, information, share, size,
    sigma, max_steps,
):  # fmt: skip
    """Damped Newton ascent of ``share * score`` + log prior from a pose; returns a pose (3,).

    `mean` (3,) and `information` (3, 3) are the prior's; `size` (3,) turns a pose's changes into
    metres, `sigma` [m] is the field's.
    """
    damping = 1e-3
    poses = np.empty((1, 3))
    poses[0] = start
    pose = start.copy()
    log_prior, slope = _log_prior(pose, mean, information)
    first = score_poses(field, origin_x, origin_y, cell, points, weight, poses)
    best = share * first[0] + log_prior
    for _ in range(max_steps):
        _, gradient, hessian = derivatives(
            field, origin_x, origin_y, cell, points, weight, pose, 0.5 * sigma / size
        )
        scales = size.reshape(3, 1) * size
        curvature = _absolute(share * hessian / scales) * scales + information
        uphill = share * gradient + slope
        moved, length = False, 0.0
        for _ in range(5):
            damped = curvature.copy()
            for i in range(3):
                damped[i, i] += damping * curvature[i, i]
            step = _solved(damped, uphill)
            length = np.max(np.abs(step * size))
            poses[0] = pose + step
            log_prior, new_slope = _log_prior(poses[0], mean, information)
            found = score_poses(field, origin_x, origin_y, cell, points, weight, poses)
            value = share * found[0] + log_prior
            if value > best:
                pose, slope, best, moved = pose + step, new_slope, value, True
                damping = max(damping * 0.3, 1e-6)
                break
            damping = min(damping * 10.0, 1e6)
        if not moved or length < 1e-3 * sigma:
            break
    return pose
