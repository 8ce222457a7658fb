"""Places as grids: where the walls are, and what of them could be seen."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import FREE, OCCUPIED, UNKNOWN, GridSpec, OccupancyMap
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.waters.world import World, cast_rays

__all__ = ["grid_over", "seen_map", "wall_mask"]

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


def grid_over(world: World, resolution_m: float, margin_m: float = 2.0) -> GridSpec:
    """Grid that holds a place, its origin on the resolution's lattice."""
    x_min, y_min, x_max, y_max = world.bounds
    col0 = math.floor((x_min - margin_m) / resolution_m)
    row0 = math.floor((y_min - margin_m) / resolution_m)
    num_cols = math.ceil((x_max + margin_m) / resolution_m) - col0
    num_rows = math.ceil((y_max + margin_m) / resolution_m) - row0
    origin = SE2(col0 * resolution_m, row0 * resolution_m)
    return GridSpec(resolution_m, num_rows, num_cols, origin)


@njit(cache=True, nogil=True)
def _trace(
    counts: NDArray[np.uint8], x0: float, y0: float, x1: float, y1: float, value: int
) -> None:
    """Set every cell that the line from (x0, y0) to (x1, y1) passes through; units of cells."""
    num_rows, num_cols = counts.shape
    col, row = math.floor(x0), math.floor(y0)
    dx, dy = x1 - x0, y1 - y0
    step_col = 1 if dx > 0.0 else -1
    step_row = 1 if dy > 0.0 else -1
    per_col = abs(1.0 / dx) if dx != 0.0 else np.inf
    per_row = abs(1.0 / dy) if dy != 0.0 else np.inf
    next_col = (col + 1 - x0 if dx > 0.0 else x0 - col) * per_col if dx != 0.0 else np.inf
    next_row = (row + 1 - y0 if dy > 0.0 else y0 - row) * per_row if dy != 0.0 else np.inf
    while True:
        if 0 <= row < num_rows and 0 <= col < num_cols:
            counts[row, col] |= value
        if min(next_col, next_row) > 1.0:
            return
        if next_col < next_row:
            col += step_col
            next_col += per_col
        else:
            row += step_row
            next_row += per_row


@njit(cache=True, nogil=True)
def _trace_many(
    counts: NDArray[np.uint8], starts: FloatArray, ends: FloatArray, value: int
) -> None:
    for i in range(starts.shape[0]):
        _trace(counts, starts[i, 0], starts[i, 1], ends[i, 0], ends[i, 1], value)


def _in_cells(spec: GridSpec, points: FloatArray) -> FloatArray:
    return spec.T_frame_grid.inverse().apply(points) / spec.resolution_m


def wall_mask(world: World, spec: GridSpec) -> BoolArray:
    """Cells of a grid (R, C) that an outline passes through."""
    counts = np.zeros(spec.shape, dtype=np.uint8)
    starts, ends = _in_cells(spec, world.segments[:, :2]), _in_cells(spec, world.segments[:, 2:])
    _trace_many(counts, starts, ends, 1)
    return counts.astype(np.bool_)


def seen_map(
    world: World,
    spec: GridSpec,
    poses: ArrayLike,
    fov_rad: float,
    max_range_m: float,
) -> OccupancyMap:
    """Map that a perfect sonar would make from poses (K, 3) [x, y, yaw] of itself.

    Walls that were seen are 100, water that was looked through is 0, everything else unknown:
    so a map can be judged where something could be known at all.
    """
    poses = np.asarray(poses, dtype=np.float64)
    if poses.ndim != 2 or poses.shape[1] != 3:
        raise InvalidInputError(f"poses have shape {poses.shape}, expected (K, 3)")
    counts = np.zeros(spec.shape, dtype=np.uint8)
    # Neighbouring rays lie less than a cell apart at the maximum range.
    num_rays = max(2, math.ceil(fov_rad * max_range_m / (0.8 * spec.resolution_m)))
    fan = np.linspace(-0.5 * fov_rad, 0.5 * fov_rad, num_rays)
    walls = wall_mask(world, spec)
    for x, y, yaw in poses:
        hits = cast_rays(world.segments, (x, y), yaw + fan, max_range_m)
        is_hit = np.isfinite(hits.range_m)
        # A nudge across the wall's line, so that the cell that holds the hit counts as seen.
        reach = np.where(is_hit, hits.range_m + 1e-3 * spec.resolution_m, max_range_m)
        direction = np.column_stack([np.cos(yaw + fan), np.sin(yaw + fan)])
        ends = np.array([x, y]) + reach[:, None] * direction
        starts = np.broadcast_to(_in_cells(spec, np.array([x, y])), ends.shape)
        _trace_many(counts, np.ascontiguousarray(starts), _in_cells(spec, ends), 1)
    values = np.full(spec.shape, UNKNOWN, dtype=np.int8)
    seen = counts > 0
    values[seen] = FREE
    values[seen & walls] = OCCUPIED
    return OccupancyMap(spec, values)
