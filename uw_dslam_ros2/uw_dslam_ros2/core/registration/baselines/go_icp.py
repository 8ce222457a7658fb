"""Go-ICP cut down to the plane: the least trimmed square error, by nested branch and bound."""

from __future__ import annotations

import heapq
import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt

from uw_dslam_ros2.core.registration.baselines.icp import icp
from uw_dslam_ros2.core.registration.baselines.result import BaselineResult, checked_points
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["go_icp"]

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]


@njit(cache=True, nogil=True)
def _error(
    distances: Float32Array,
    origin: FloatArray,
    pitch: float,
    points: FloatArray,
    slack: FloatArray,
    x: float,
    y: float,
    radius: float,
    num_kept: int,
) -> float:
    """Sum of the least `num_kept` squares of max(distance - slack - radius, 0)."""
    num_rows, num_cols = distances.shape
    squares = np.empty(points.shape[0])
    for i in range(points.shape[0]):
        p_x, p_y = (points[i, 0] + x - origin[0]) / pitch, (points[i, 1] + y - origin[1]) / pitch
        col = min(max(math.floor(p_x), 0), num_cols - 1)
        row = min(max(math.floor(p_y), 0), num_rows - 1)
        # Off the grid: the distance to the grid's edge comes on top.
        off_x = max(-p_x, p_x - num_cols, 0.0) * pitch
        off_y = max(-p_y, p_y - num_rows, 0.0) * pitch
        distance = max(distances[row, col], math.hypot(off_x, off_y))
        residual = max(distance - slack[i] - radius, 0.0)
        squares[i] = residual * residual
    if num_kept < squares.shape[0]:
        squares = np.partition(squares, num_kept - 1)[:num_kept]
    return squares.sum()


@njit(cache=True, nogil=True)
def _translations(
    distances: Float32Array,
    origin: FloatArray,
    pitch: float,
    points: FloatArray,
    slack: FloatArray,
    half_side: float,
    best: float,
    gap: float,
    num_kept: int,
) -> tuple[float, float, float, int]:
    """Inner search: least error over translations, and where; `best` if none is less.

    Best first over squares; the heap is (bound, x, y, half side) in arrays grown as needed.
    """
    heap = [(0.0, 0.0, 0.0, half_side)]
    best_x, best_y, count = 0.0, 0.0, 0
    while len(heap) > 0:
        bound, x, y, half = heapq.heappop(heap)
        if best - bound <= gap:
            break
        half *= 0.5
        for child in range(4):
            c_x, c_y = x + half * (2 * (child // 2) - 1), y + half * (2 * (child % 2) - 1)
            upper = _error(distances, origin, pitch, points, slack, c_x, c_y, 0.0, num_kept)
            count += 1
            if upper < best:
                best, best_x, best_y = upper, c_x, c_y
            radius = math.sqrt(2.0) * half
            lower = _error(distances, origin, pitch, points, slack, c_x, c_y, radius, num_kept)
            if lower < best - gap:
                heapq.heappush(heap, (lower, c_x, c_y, half))
    return best, best_x, best_y, count


def go_icp(
    source: ArrayLike,
    target: ArrayLike,
    *,
    trim: float = 0.0,
    gap: float = 0.05,
    pitch_m: float = 0.01,
    max_rotations: int = 4000,
) -> BaselineResult:
    """Least trimmed mean square distance over all motions, ICP polishing each new incumbent.

    Parameters
    ----------
    source, target : (m, 2) and (n, 2)
        Points [m].
    trim : float
        Share of the source's points left out of the error, in [0, 1): what has no counterpart.
    gap : float
        Stop when the mean square distance is proven to within this share of what a random motion
        has, which is A / (pi n) before trimming, with A the area of the target's bounding box.
    pitch_m : float
        Side [m] of a cell of the distance table.
    max_rotations : int
        Limit on the rotation intervals that are opened.

    Notes
    -----
    Yang et al. (2016), section 5, in the plane: the outer search halves rotation intervals, the
    inner one squares of translations; the residual of a point is less than its distance at the
    centre by at most the radius of its uncertainty. Distances come from a table, as theirs do.
    """
    source, target = checked_points("source", source), checked_points("target", target)
    c_x, c_y = source.mean(axis=0), (target.min(axis=0) + target.max(axis=0)) / 2.0
    points, moved = source - c_x, target - c_y
    lengths = np.linalg.norm(points, axis=1)
    half_side = float(np.abs(moved).max() + lengths.max())
    distances, origin = _distance_table(moved, pitch_m)
    num_kept = max(2, round(len(points) * (1.0 - trim)))
    num_kept = min(num_kept, len(points))
    slack_sum = gap * num_kept * _random_square(target, num_kept / len(points))

    def inner(theta: float, slack: FloatArray, best: float) -> tuple[float, float, float, int]:
        turned = points @ SE2(yaw=theta).rotation().T
        return _translations(
            distances, origin, pitch_m, turned, slack, half_side, best, slack_sum, num_kept
        )

    best, T_best = math.inf, SE2()
    heap, opened, count = [(0.0, 0.0, math.pi)], 0, 0
    while heap and opened < max_rotations:
        bound, theta, beta = heapq.heappop(heap)
        if best - bound <= slack_sum:
            break
        opened += 1
        beta /= 2.0
        for child in (theta - beta, theta + beta):
            upper, x, y, used = inner(child, np.zeros(len(points)), best)
            count += used
            if upper < best:
                best, T_best = _polished(points, moved, SE2(x, y, child), num_kept)
                best = min(best, upper)
            slack = 2.0 * np.sin(min(beta, math.pi) / 2.0) * lengths
            lower, _, _, used = inner(child, slack, best)
            count += used
            # The inner search proves its own minimum to within the gap only.
            lower -= slack_sum
            if lower < best - slack_sum:
                heapq.heappush(heap, (lower, child, beta))
    T_target_source = SE2(*c_y.tolist()) @ T_best @ SE2(*(-c_x).tolist())
    diagnostics = {"num_rotations": float(opened), "num_errors": float(count)}
    return BaselineResult(T_target_source, -best / num_kept, diagnostics)


def _random_square(target: FloatArray, kept: float) -> float:
    """Mean square distance [m^2] that the best `kept` share of points has at a random motion.

    Square distances to the nearest of n points spread evenly over A are exponential with mean
    A / (pi n).
    """
    area = float(np.prod(target.max(axis=0) - target.min(axis=0)))
    trimmed = 1.0 + (1.0 - kept) * math.log(1.0 - kept) / kept if kept < 1.0 else 1.0
    return max(trimmed * area / (math.pi * len(target)), 1e-9)


def _polished(
    points: FloatArray, target: FloatArray, T_start: SE2, num_kept: int
) -> tuple[float, SE2]:
    """Trimmed square error after ICP from a new incumbent, and the motion, if ICP improves it."""
    results = []
    for T in (T_start, icp(points, target, T_initial=T_start, first_cutoff_m=0.2).T_target_source):
        assert T is not None
        gaps = np.linalg.norm(T.apply(points)[:, None, :] - target[None, :, :], axis=2).min(axis=1)
        results.append((float(np.sort(gaps**2)[:num_kept].sum()), T))
    return min(results, key=lambda pair: pair[0])


def _distance_table(target: FloatArray, pitch_m: float) -> tuple[Float32Array, FloatArray]:
    """Lower bound of the distance from each cell to the nearest target point, and the origin."""
    border = 0.25 * float(np.abs(target).max()) + 2.0 * pitch_m
    origin = target.min(axis=0) - border
    shape = np.ceil((target.max(axis=0) + border - origin) / pitch_m).astype(int)[::-1] + 1
    is_free = np.ones(shape, dtype=bool)
    cells = np.floor((target - origin) / pitch_m).astype(int)
    is_free[cells[:, 1], cells[:, 0]] = False
    # Between two points in cells a distance may be a diagonal less than between their centres.
    distance = pitch_m * (distance_transform_edt(is_free) - math.sqrt(2.0))
    return np.maximum(distance, 0.0).astype(np.float32), origin
