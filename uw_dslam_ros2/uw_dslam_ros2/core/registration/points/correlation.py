"""Candidate poses from a lattice over all of them, where a search alone is not decisive.

A search keeps what it needs to prove the best pose of one objective. Where the right pose is not
that, its like has to be found otherwise: the sum of the field under the points is evaluated on a
lattice of rotations and translations (Olson's correlative matching), and its highest local
maxima, each apart from the others, are worth refining.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from uw_dslam_ros2.core.registration.search import field_kernels
from uw_dslam_ros2.core.suppression import first_apart

__all__ = ["lattice_maxima", "likelihood_raster", "sum_shifted"]

FloatArray = NDArray[np.float64]

_PITCH = 0.7  # kernels between translations
_TURN = 1.0  # kernels that a step of rotation moves the points by
_TAIL = 4.5
_ROOM = 16_000  # maxima held before the lower ones are dropped
_KEPT = 2_000


def lattice_maxima(
    source: FloatArray,
    target: FloatArray,
    sigma_m: float,
    contrast: float,
    count: int,
    max_additions: float,
) -> FloatArray:
    """Poses (K, 3) of theta, x, y, at most `count`, best first; none if it would cost too much.

    Parameters
    ----------
    source, target : (m, 2), (n, 2)
        Centred points [m].
    sigma_m : float
        Kernel, the standard deviation of a pair [m].
    contrast : float
        Density on top of a target over that of clutter, as in `likelihood_field`.
    count : int
        Poses wanted.
    max_additions : float
        Budget: points times lattice nodes.
    """
    pitch_m = _PITCH * sigma_m
    arm_m = math.sqrt(float((source**2).sum(axis=1).mean()))
    low, high = target.min(axis=0), target.max(axis=0)
    half = 0.5 * (high - low) + 0.5 * arm_m  # half of the source may lie outside
    sides = np.ceil(2.0 * half / pitch_m) + 1.0
    num_turns = math.ceil(2.0 * math.pi * arm_m / (_TURN * sigma_m)) + 1
    if len(source) * float(sides.prod()) * num_turns > max_additions:
        return np.zeros((0, 3))
    raster, origin = likelihood_raster(target, sigma_m, pitch_m, contrast)
    thetas = np.linspace(-math.pi, math.pi, num_turns, endpoint=False)
    values = np.full(_ROOM, -np.inf, dtype=np.float32)
    poses = np.zeros((_ROOM, 3))
    start = 0.5 * (low + high) - half
    columns, rows = sides.astype(np.int64)
    found = _scan(source, raster, origin, pitch_m, start, rows, columns, thetas, values, poses)
    order = np.argsort(-values[:found], kind="stable")
    return _apart(poses[order], arm_m, 1.5 * sigma_m, count)


def likelihood_raster(
    target: FloatArray, sigma_m: float, pitch_m: float, contrast: float
) -> tuple[NDArray[np.float32], FloatArray]:
    """Samples (R, C) of ``log(1 + contrast sum_j exp(...))``, and the first one's place [m]."""
    low, high = target.min(axis=0) - _TAIL * sigma_m, target.max(axis=0) + _TAIL * sigma_m
    columns, rows = np.ceil((high - low) / pitch_m).astype(int) + 1
    samples = np.zeros((rows, columns))
    n = len(target)
    field_kernels.add_gaussians(
        samples, (target - low) / pitch_m, np.ones(n), np.full(n, sigma_m / pitch_m), _TAIL, False
    )
    return np.log1p(contrast * samples).astype(np.float32), low


def _apart(poses: FloatArray, arm_m: float, distance_m: float, count: int) -> FloatArray:
    """The first `count` of the poses that are no neighbours of one before."""
    places = np.column_stack(
        [arm_m * np.cos(poses[:, 0]), arm_m * np.sin(poses[:, 0]), poses[:, 1:]]
    )
    chosen = first_apart(
        len(poses), lambda k: np.abs(places - places[k]).max(axis=1) < distance_m, count
    )
    return poses[chosen]


@njit(cache=True, nogil=True)
def _add_shifted(raster, col, row, total):  # type: ignore[no-untyped-def]
    """Add the part of a raster that starts at (row, col) onto `total`; what is outside is zero."""
    first_row, last_row = max(0, -row), min(total.shape[0], raster.shape[0] - row)
    first_col, last_col = max(0, -col), min(total.shape[1], raster.shape[1] - col)
    if first_col >= last_col:
        return
    for y in range(first_row, last_row):
        # Slices, whose indices cannot be negative, so that the compiler uses vector instructions.
        line = total[y, first_col:last_col]
        other = raster[row + y, col + first_col : col + last_col]
        for x in range(line.shape[0]):
            line[x] += other[x]


@njit(cache=True, nogil=True)
def _scan(source, raster, origin, pitch, start, rows, columns, thetas, values, poses):  # type: ignore[no-untyped-def]
    """Local maxima of every slice of equal rotation into `values` and `poses`; their number."""
    total = np.empty((rows, columns), dtype=np.float32)
    count, floor = 0, np.float32(0.0)
    for k in range(thetas.shape[0]):
        total[:, :] = 0.0
        cos, sin = math.cos(thetas[k]), math.sin(thetas[k])
        for i in range(source.shape[0]):
            px = cos * source[i, 0] - sin * source[i, 1] + start[0] - origin[0]
            py = sin * source[i, 0] + cos * source[i, 1] + start[1] - origin[1]
            col, row = math.floor(px / pitch + 0.5), math.floor(py / pitch + 0.5)
            _add_shifted(raster, col, row, total)
        for y in range(1, rows - 1):
            for x in range(1, columns - 1):
                value = total[y, x]
                if value <= floor or value <= total[y, x + 1] or value < total[y, x - 1]:
                    continue
                above, below = total[y + 1], total[y - 1]
                if value <= max(above[x - 1], max(above[x], above[x + 1])):
                    continue
                if value < max(below[x - 1], max(below[x], below[x + 1])):
                    continue
                if count == values.shape[0]:
                    order = np.argsort(-values)[:_KEPT]
                    values[:_KEPT] = values[order]
                    poses[:_KEPT] = poses[order]
                    count, floor = _KEPT, values[_KEPT - 1]
                values[count] = value
                poses[count, 0] = thetas[k]
                poses[count, 1], poses[count, 2] = start[0] + x * pitch, start[1] + y * pitch
                count += 1
    return count


@njit(cache=True, nogil=True)
def sum_shifted(raster, places, rows, columns):  # type: ignore[no-untyped-def]
    """Sum, and sum of squares, of a raster read from each of the places (K, 2) of column, row on.

    Both are (rows, columns); outside the raster is zero.
    """
    total = np.zeros((rows, columns), dtype=np.float32)
    squares = np.zeros((rows, columns), dtype=np.float32)
    square = raster * raster
    for i in range(places.shape[0]):
        _add_shifted(raster, places[i, 0], places[i, 1], total)
        _add_shifted(square, places[i, 0], places[i, 1], squares)
    return total, squares
