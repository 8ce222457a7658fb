"""Iterative closest points, from one start and from many."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.registration.baselines.result import BaselineResult, checked_points
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["icp", "many_start_icp"]

FloatArray = NDArray[np.float64]


@njit(cache=True, nogil=True)
def _icp_kernel(
    source: FloatArray,
    target: FloatArray,
    start: FloatArray,
    first_cutoff: float,
    last_cutoff: float,
    max_iterations: int,
) -> tuple[float, float, float, float, int]:
    """x, y, yaw, mean truncated square distance, iterations; pairs beyond the cutoff are left out.

    The cutoff falls by a fifth each iteration, so that a start may be rough and the end exact.
    """
    m, n = source.shape[0], target.shape[0]
    x, y, yaw = start[0], start[1], start[2]
    cutoff, cost, iterations = first_cutoff, 0.0, 0
    for iteration in range(max_iterations):
        iterations = iteration + 1
        cos, sin = math.cos(yaw), math.sin(yaw)
        limit = cutoff * cutoff
        count, cost = 0, 0.0
        sum_px = sum_py = sum_qx = sum_qy = dot = cross = 0.0
        for i in range(m):
            px, py = source[i, 0], source[i, 1]
            moved_x, moved_y = cos * px - sin * py + x, sin * px + cos * py + y
            best, nearest = math.inf, 0
            for j in range(n):
                dx, dy = target[j, 0] - moved_x, target[j, 1] - moved_y
                square = dx * dx + dy * dy
                if square < best:
                    best, nearest = square, j
            cost += min(best, last_cutoff * last_cutoff)
            if best <= limit:
                qx, qy = target[nearest, 0], target[nearest, 1]
                count += 1
                sum_px, sum_py, sum_qx, sum_qy = sum_px + px, sum_py + py, sum_qx + qx, sum_qy + qy
                dot += px * qx + py * qy
                cross += px * qy - py * qx
        cost /= m
        if count < 2:
            break
        dot -= (sum_px * sum_qx + sum_py * sum_qy) / count
        cross -= (sum_px * sum_qy - sum_py * sum_qx) / count
        new_yaw = math.atan2(cross, dot)
        cos, sin = math.cos(new_yaw), math.sin(new_yaw)
        new_x = (sum_qx - cos * sum_px + sin * sum_py) / count
        new_y = (sum_qy - sin * sum_px - cos * sum_py) / count
        turn = abs((new_yaw - yaw + math.pi) % (2.0 * math.pi) - math.pi)
        change = abs(new_x - x) + abs(new_y - y) + turn
        x, y, yaw = new_x, new_y, new_yaw
        if change < 1e-9 and cutoff <= last_cutoff:
            break
        cutoff = max(0.8 * cutoff, last_cutoff)
    return x, y, yaw, cost, iterations


def icp(
    source: ArrayLike,
    target: ArrayLike,
    *,
    T_initial: SE2 | None = None,
    first_cutoff_m: float = 1.0,
    last_cutoff_m: float = 0.1,
    max_iterations: int = 100,
) -> BaselineResult:
    """Point-to-point ICP from one start (identity unless told).

    Parameters
    ----------
    source, target : (m, 2) and (n, 2)
        Points [m].
    first_cutoff_m, last_cutoff_m : float
        Pairs farther apart than the cutoff [m] are left out; it falls from the first to the last.

    Notes
    -----
    Besl and McKay (1992), with the usual limit on the distance of pairs.
    """
    start = (SE2() if T_initial is None else T_initial).as_array()
    x, y, yaw, cost, iterations = _icp_kernel(
        checked_points("source", source),
        checked_points("target", target),
        start,
        first_cutoff_m,
        last_cutoff_m,
        max_iterations,
    )
    return BaselineResult(SE2(x, y, yaw), -cost, {"num_iterations": float(iterations)})


def many_start_icp(
    source: ArrayLike,
    target: ArrayLike,
    *,
    num_starts: int = 36,
    first_cutoff_m: float = 0.5,
    last_cutoff_m: float = 0.05,
    max_iterations: int = 50,
) -> BaselineResult:
    """ICP from evenly spaced headings about the centroids; the best truncated cost wins."""
    source, target = checked_points("source", source), checked_points("target", target)
    c_x, c_y = source.mean(axis=0), target.mean(axis=0)
    best, total = None, 0
    for k in range(num_starts):
        rotation = SE2(yaw=2.0 * math.pi * k / num_starts)
        start = np.array([*(c_y - rotation.apply(c_x)), rotation.yaw])
        found = _icp_kernel(source, target, start, first_cutoff_m, last_cutoff_m, max_iterations)
        total += found[4]
        if best is None or found[3] < best[3]:
            best = found
    assert best is not None
    T_target_source = SE2(best[0], best[1], best[2])
    return BaselineResult(T_target_source, -best[3], {"num_iterations": float(total)})
