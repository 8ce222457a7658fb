"""Correlative matching with branch and bound over a likelihood grid, the whole plane searched."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt, maximum_filter1d

from uw_dslam_ros2.core.registration.baselines.icp import icp
from uw_dslam_ros2.core.registration.baselines.result import BaselineResult, checked_points
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["correlative"]

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
IntArray = NDArray[np.int64]

_TOP_LEVEL = 5  # the search begins with windows of 32 x 32 cells


@njit(cache=True, nogil=True)
def _score(grid: Float32Array, cells: IntArray, row: int, col: int) -> float:
    num_rows, num_cols = grid.shape
    total = 0.0
    for i in range(cells.shape[0]):
        r, c = cells[i, 0] + row, cells[i, 1] + col
        if 0 <= r < num_rows and 0 <= c < num_cols:
            total += grid[r, c]
    return total


@njit(cache=True, nogil=True)
def _search(
    pyramid: Float32Array,
    points: FloatArray,
    angles: FloatArray,
    origin: FloatArray,
    pitch: float,
    half_cells: int,
) -> tuple[float, float, int, int, int]:
    """Best score, angle, row and column of the shift in cells, and the number of scores taken.

    Level k of `pyramid` holds maxima over the 2^k x 2^k cells that begin at each cell. Shifts in
    [-half_cells, half_cells) are searched depth first, the best children first; the angles in
    the order of the best score of their coarsest level.
    """
    top = pyramid.shape[0] - 1
    width = 1 << top
    count = (2 * half_cells + width - 1) // width
    num_angles, m = angles.shape[0], points.shape[0]
    cells = np.empty((num_angles, m, 2), np.int64)
    roots = np.empty(num_angles * count * count, np.float64)
    taken = 0
    for a in range(num_angles):
        cos, sin = math.cos(angles[a]), math.sin(angles[a])
        for i in range(m):
            x = cos * points[i, 0] - sin * points[i, 1]
            y = sin * points[i, 0] + cos * points[i, 1]
            cells[a, i, 0] = math.floor((y - origin[1]) / pitch)
            cells[a, i, 1] = math.floor((x - origin[0]) / pitch)
        for k in range(count * count):
            row, col = (k // count) * width - half_cells, (k % count) * width - half_cells
            roots[a * count * count + k] = _score(pyramid[top], cells[a], row, col)
            taken += 1
    order = np.argsort(-roots)
    best, best_angle, best_row, best_col = 0.0, 0.0, 0, 0
    stack = np.empty((4 * (top + 2), 4), np.int64)  # level, row, col
    bounds = np.empty(4 * (top + 2), np.float64)
    for number in order:
        if roots[number] <= best:
            break
        a, k = number // (count * count), number % (count * count)
        size = 1
        stack[0, 0] = top
        stack[0, 1] = (k // count) * width - half_cells
        stack[0, 2] = (k % count) * width - half_cells
        bounds[0] = roots[number]
        while size > 0:
            size -= 1
            bound, level = bounds[size], stack[size, 0]
            row, col = stack[size, 1], stack[size, 2]
            if bound <= best:
                continue
            if level == 0:
                best, best_angle, best_row, best_col = bound, angles[a], row, col
                continue
            half, begin = 1 << (level - 1), size
            for child in range(4):
                r, c = row + half * (child // 2), col + half * (child % 2)
                value = _score(pyramid[level - 1], cells[a], r, c)
                taken += 1
                if value <= best:
                    continue
                place = size  # insertion sort: the best child ends on top of the stack
                while place > begin and bounds[place - 1] > value:
                    bounds[place] = bounds[place - 1]
                    stack[place] = stack[place - 1]
                    place -= 1
                bounds[place] = value
                stack[place, 0], stack[place, 1], stack[place, 2] = level - 1, r, c
                size += 1
    return best, best_angle, best_row, best_col, taken


def correlative(
    source: ArrayLike,
    target: ArrayLike,
    *,
    kernel_m: float = 0.02,
    pitch_m: float = 0.02,
    polish_m: float = 0.05,
) -> BaselineResult:
    """Best cell of a likelihood grid over all rotations and shifts, polished by ICP.

    Parameters
    ----------
    source, target : (m, 2) and (n, 2)
        Points [m].
    kernel_m : float
        Standard deviation [m] of the likelihood around each target point.
    pitch_m : float
        Side of a cell [m]; the angular step moves the farthest point by one cell.
    polish_m : float
        Distance [m] up to which ICP pairs points in the end.

    Notes
    -----
    Olson (2009) for the matching, Hess et al. (2016) for the branch and bound over pyramids of
    maxima: the optimum of the grid's score, without a guarantee on what lies between the cells.
    """
    source, target = checked_points("source", source), checked_points("target", target)
    centre = (source.min(axis=0) + source.max(axis=0)) / 2.0
    points = source - centre
    reach = float(np.linalg.norm(points, axis=1).max())
    border = 4.0 * kernel_m + pitch_m
    low, high = target.min(axis=0) - border, target.max(axis=0) + border
    middle = (low + high) / 2.0
    half_cells = math.ceil((float((high - low).max()) / 2.0 + reach) / pitch_m)
    pyramid = _pyramid(target, low, high, kernel_m, pitch_m)
    corner = low - pitch_m * (1 << _TOP_LEVEL)  # of the padded grid
    step = min(pitch_m / max(reach, pitch_m), math.pi / 8.0)
    angles = np.arange(0.0, 2.0 * math.pi, step)
    # Shifts count from the middle of the target.
    best, angle, row, col, taken = _search(
        pyramid, points, angles, corner - middle, pitch_m, half_cells
    )
    diagnostics = {"num_scores": float(taken), "num_angles": float(len(angles))}
    if best <= 0.0:
        return BaselineResult(None, 0.0, diagnostics)
    shift = middle + pitch_m * np.array([col, row])
    T_target_centred = SE2(float(shift[0]), float(shift[1]), angle)
    T_start = T_target_centred @ SE2(-float(centre[0]), -float(centre[1]))
    polished = icp(
        source, target, T_initial=T_start, first_cutoff_m=2.0 * polish_m, last_cutoff_m=polish_m
    )
    return BaselineResult(polished.T_target_source, best / len(source), diagnostics)


def _pyramid(
    target: FloatArray, low: FloatArray, high: FloatArray, kernel_m: float, pitch_m: float
) -> Float32Array:
    """Likelihood of each cell and maxima over 2, 4, 8, ... cells, shape (levels, rows, columns).

    Zeros as wide as the coarsest window lie before the first row and column: windows may begin
    off the grid and still reach into it.
    """
    shape = np.ceil((high - low) / pitch_m).astype(int)[::-1] + 1
    is_free = np.ones(shape, dtype=bool)
    cells = np.floor((target - low) / pitch_m).astype(int)
    is_free[cells[:, 1], cells[:, 0]] = False
    distance = pitch_m * distance_transform_edt(is_free)
    base = np.exp(-0.5 * (distance / kernel_m) ** 2).astype(np.float32)
    base[base < 1e-3] = 0.0
    base = np.pad(base, ((1 << _TOP_LEVEL, 0), (1 << _TOP_LEVEL, 0)))
    return np.stack([_forward_maximum(base, 1 << level) for level in range(_TOP_LEVEL + 1)])


def _forward_maximum(grid: Float32Array, width: int) -> Float32Array:
    """Maximum over the `width` cells that begin at each cell, along both axes, zero outside."""
    origin = -(width // 2)
    along = maximum_filter1d(grid, width, axis=0, origin=origin, mode="constant", cval=0.0)
    return maximum_filter1d(along, width, axis=1, origin=origin, mode="constant", cval=0.0)
