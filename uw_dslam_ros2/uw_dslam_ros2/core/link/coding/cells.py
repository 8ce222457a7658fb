"""A submap's grid as cells of three values, coarse or fine, and back."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numba import njit
from numpy.typing import NDArray

from uw_dslam_ros2.core.grid import UNKNOWN, GridSpec, OccupancyMap, bounds_of
from uw_dslam_ros2.core.link.coding.cell_coder import (
    CELL_FREE,
    CELL_UNKNOWN,
    CELL_WALL,
    CellArray,
)
from uw_dslam_ros2.core.mosaic import fuse_maps
from uw_dslam_ros2.core.se2 import SE2

__all__ = [
    "blocks_of_known",
    "known_window",
    "levelled",
    "occupancy_of",
    "reduce_cells",
    "seen_free",
    "with_walls",
]

# A wall is as sure as a mapper is of one that it saw often. Free water, whose border is told in
# blocks, is less so: where submaps are laid on each other the free water of one must not take the
# walls of another away.
_FREE_PERCENT, _WALL_PERCENT = 15, 95
_WALL_MIN_PERCENT = 60
_FREE_MAX_PERCENT = 40
_MAX_BARE_CELLS = 3  # from a coarse wall's side to the true wall
_MIN_WALL_CELLS = 3
"""Walls that touch each other; fewer are a speck."""


def levelled(occupancy: OccupancyMap, unit_m: float) -> OccupancyMap:
    """The same map on cells whose size is a whole number of `unit_m`, with axes of the frame."""
    spec = occupancy.spec
    units = round(spec.resolution_m / unit_m)
    is_whole = units > 0 and abs(spec.resolution_m - units * unit_m) < 1e-9
    if is_whole and spec.T_frame_grid.yaw == 0.0:
        return occupancy
    lattice = GridSpec(max(1, units) * unit_m, 1, 1)
    drawn = fuse_maps(lattice, [(occupancy, SE2())], 8.0)
    return occupancy if drawn is None else drawn


@njit(cache=True, nogil=True)
def _counts(values, width, free_max, wall_min, walls, free):  # type: ignore[no-untyped-def]
    """Count walls and free cells of a map [percent] in blocks of ``width`` x ``width``."""
    for row in range(values.shape[0]):
        block_row = row // width
        for block_col in range(-(-values.shape[1] // width)):
            num_walls, num_free = 0, 0
            for col in range(block_col * width, min(values.shape[1], (block_col + 1) * width)):
                value = values[row, col]
                if value < 0:
                    continue
                if value >= wall_min:
                    num_walls += 1
                elif value <= free_max:
                    num_free += 1
            walls[block_row, block_col] += num_walls
            free[block_row, block_col] += num_free


def reduce_cells(
    values: NDArray[np.int8], size: int, factors: Iterable[int]
) -> dict[int, CellArray]:
    """Cells of three values by factor, which divides three: `factor` blocks of ``size`` a side.

    A cell is a wall if half of a line through it is, else free if a third of it is, else unknown;
    see `drop_specks` for the rest. All begin at the map's first cell and reach equally far.
    """
    rows, cols = (-(-length // (3 * size)) * 3 for length in values.shape)
    walls, free = np.zeros((2, rows, cols), np.int32)
    _counts(np.ascontiguousarray(values), size, _FREE_MAX_PERCENT, _WALL_MIN_PERCENT, walls, free)
    found = {}
    for factor in factors:
        width = factor * size
        cells = np.zeros((rows // factor, cols // factor), np.int8)
        cells[3 * _summed(free, factor) >= width * width] = CELL_FREE
        cells[_summed(walls, factor) >= max(1, (width + 1) // 2)] = CELL_WALL
        found[factor] = drop_specks(cells)
    return found


def _summed(counts: NDArray[np.int32], factor: int) -> NDArray[np.int32]:
    """Over blocks of ``factor`` x ``factor``."""
    if factor == 1:
        return counts
    found = np.zeros((counts.shape[0] // factor, counts.shape[1] // factor), np.int32)
    for row in range(factor):
        for col in range(factor):
            found += counts[row::factor, col::factor]
    return found


def drop_specks(cells: CellArray) -> CellArray:
    """Without walls that stand alone, and with free and unknown cells as most around them are."""
    import cv2  # large, so loaded when first used

    wall = cells == CELL_WALL
    _, labels, stats, _ = cv2.connectedComponentsWithStats(wall.astype(np.uint8), connectivity=8)
    is_kept = stats[:, cv2.CC_STAT_AREA] >= _MIN_WALL_CELLS
    is_kept[0] = False
    wall = is_kept[labels]
    free = (cells == CELL_FREE) | ((cells == CELL_WALL) & ~wall)
    count = cv2.boxFilter(
        free.astype(np.uint8), -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT
    )
    kept = np.zeros_like(cells)
    kept[count >= 5] = CELL_FREE
    kept[wall] = CELL_WALL
    return kept


def blocks_of_known(cells: CellArray) -> NDArray[np.bool_]:
    """Which blocks of 2 x 2 cells (R, C), R and C even, are known whole, as most around them.

    What is called free and is not would contradict another map's walls.
    """
    import cv2  # large, so loaded when first used

    rows, cols = cells.shape
    is_known = (cells != CELL_UNKNOWN).reshape(rows // 2, 2, cols // 2, 2).all(axis=(1, 3))
    return cv2.medianBlur(is_known.astype(np.uint8), 3) > 0


def seen_free(free: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Free cells (R, C) without strips narrower than three cells.

    Where what is free is told in large blocks, these are the far sides of walls.
    """
    import cv2  # large, so loaded when first used

    wide = cv2.morphologyEx(
        free.astype(np.uint8),
        cv2.MORPH_OPEN,
        np.ones((3, 3), np.uint8),
        borderType=cv2.BORDER_CONSTANT,
        borderValue=0,
    )
    # The corners of staircases come back.
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    return (cv2.dilate(wide, cross) > 0) & free


def known_window(cells: CellArray) -> tuple[slice, slice]:
    """Rows and columns around everything known; empty where nothing is."""
    return bounds_of(cells != CELL_UNKNOWN) or (slice(0, 0), slice(0, 0))


def with_walls(known: CellArray, walls: NDArray[np.bool_]) -> CellArray:
    """Cells whose walls are told exactly; the rest is as it was `known` before, coarsely.

    Of what was a wall and is none any more, that is free which free cells beside it reach; the far
    side of the wall is unknown. So are the cells next to a wall, as on a mapper's own map.
    """
    import cv2  # large, so loaded when first used

    is_bare = (known == CELL_WALL) & ~walls
    free = ((known == CELL_FREE) & ~walls).astype(np.uint8)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    for _ in range(_MAX_BARE_CELLS):
        free |= cv2.dilate(free, cross) & is_bare
    beside = cv2.dilate(walls.astype(np.uint8), np.ones((3, 3), np.uint8))
    cells = np.full(known.shape, CELL_UNKNOWN, np.int8)
    cells[free > beside] = CELL_FREE
    cells[walls] = CELL_WALL
    return cells


def occupancy_of(cells: CellArray, resolution_m: float, x: float, y: float) -> OccupancyMap:
    """An ordinary map of cells whose outer corner lies at (x, y) [m]."""
    table = np.array([UNKNOWN, _FREE_PERCENT, _WALL_PERCENT], np.int8)
    spec = GridSpec(resolution_m, cells.shape[0], cells.shape[1], SE2(x, y))
    return OccupancyMap(spec, table[cells])
