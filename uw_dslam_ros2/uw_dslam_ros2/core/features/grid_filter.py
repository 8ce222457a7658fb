"""What the cells of an occupancy map say once specks are gone: walls, free space, unknown."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from uw_dslam_ros2.core.grid import OccupancyMap

__all__ = ["FilteredCells", "clean_cells", "clean_masks", "coarsen", "split"]

FloatGrid = NDArray[np.float32]
Shares = NDArray[Any]

# The paper's maps and map_server agree on decided cells; between the two lies "contradicting
# echoes".
_WALL_MIN_PERCENT = 60
_FREE_MAX_PERCENT = 40
_LINE_LENGTH_CELLS = 9
_MIN_LINE_CELLS = 4
_MAJORITY_WIDTH_CELLS = 5


@dataclass(frozen=True, slots=True, eq=False)
class FilteredCells:
    """Evidence of a grid's cells, each array (R, C) float32 in [0, 1].

    ``wall`` is that of a wall somewhere in the cell, ``free`` and ``known`` are shares of the
    cell's area, uint8 as `clean_masks` gives them. ``row`` and ``col`` tell where in the cell the
    wall lies, in cells from the grid's outer corner.
    """

    resolution_m: float
    wall: FloatGrid
    free: Shares
    known: Shares
    row: FloatGrid
    col: FloatGrid

    @property
    def shape(self) -> tuple[int, int]:
        """``(num_rows, num_cols)``."""
        num_rows, num_cols = self.wall.shape
        return num_rows, num_cols


def _line_offsets() -> NDArray[np.int64]:
    """Cells [row, col] of bars in eight directions (8, K, 2); shorter ones repeat (0, 0)."""
    half = _LINE_LENGTH_CELLS // 2
    offsets = np.arange(-half, half + 1)
    col, row = np.meshgrid(offsets, offsets)
    bars = []
    for step in range(8):
        angle = step * math.pi / 8.0
        across = np.abs(row * math.cos(angle) - col * math.sin(angle))
        along = np.abs(row * math.sin(angle) + col * math.cos(angle))
        inside = (across <= 1.3) & (along <= half + 0.3) & ((row != 0) | (col != 0))
        bars.append(np.column_stack([row[inside], col[inside]]))
    longest = max(len(bar) for bar in bars)
    result = np.zeros((8, longest, 2), np.int64)
    for index, bar in enumerate(bars):
        result[index, : len(bar)] = bar
    return result


@njit(cache=True, nogil=True)
def _keep_lines(
    wall: NDArray[np.bool_], offsets: NDArray[np.int64], min_cells: int
) -> NDArray[np.bool_]:
    """Wall cells through which some bar holds ``min_cells`` walls, themselves included."""
    num_rows, num_cols = wall.shape
    kept = np.zeros((num_rows, num_cols), np.bool_)
    for row in range(num_rows):
        for col in range(num_cols):
            if not wall[row, col]:
                continue
            for bar in range(offsets.shape[0]):
                count = 1
                for k in range(offsets.shape[1]):
                    d_row, d_col = offsets[bar, k, 0], offsets[bar, k, 1]
                    r, c = row + d_row, col + d_col
                    if (d_row != 0 or d_col != 0) and 0 <= r < num_rows and 0 <= c < num_cols:
                        count += wall[r, c]
                        if count >= min_cells:
                            break
                if count >= min_cells:
                    kept[row, col] = True
                    break
    return kept


def _surface(wall: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Walls without the inside of filled bodies, which no echo comes from."""
    import cv2  # large, so loaded when first used

    inside = cv2.erode(wall.astype(np.uint8), np.ones((3, 3), np.uint8), iterations=2)
    return wall & (inside == 0)


def clean_cells(occupancy: OccupancyMap) -> FilteredCells:
    """Drop specks from a map (R, C); see `clean_masks`."""
    return _with_shares(clean_masks(occupancy))


def clean_masks(occupancy: OccupancyMap) -> FilteredCells:
    """The same to be made larger: ``free`` and ``known`` are uint8, for a quarter of the room.

    A wall cell stays where a line of nine cells through it holds a line's worth of walls; free and
    unknown are decided by the majority of a neighbourhood. Algorithm 2's clustering filter, on
    cells instead of points.
    """
    import cv2  # large, so loaded when first used

    values = occupancy.values
    wall = values >= _WALL_MIN_PERCENT
    offsets = _line_offsets()
    for _ in range(2):  # specks that leaned on specks go in the second round
        wall = _keep_lines(wall, offsets, _MIN_LINE_CELLS)
    body, wall = wall, _surface(wall)
    free = _is_majority((values >= 0) & (values <= _FREE_MAX_PERCENT), cv2.BORDER_CONSTANT)
    known = _is_majority(values >= 0, cv2.BORDER_REPLICATE)
    free &= ~body
    evidence = np.zeros(values.shape, np.float32)
    evidence[wall] = np.clip((values[wall].astype(np.float32) - 50.0) / 40.0, 0.0, 1.0)
    rows, cols = (np.arange(size, dtype=np.float32) + np.float32(0.5) for size in values.shape)
    return FilteredCells(
        occupancy.spec.resolution_m,
        evidence,
        free.view(np.uint8),
        (known | body).view(np.uint8),
        np.broadcast_to(rows[:, None], values.shape),
        np.broadcast_to(cols, values.shape),
    )


def _with_shares(cells: FilteredCells) -> FilteredCells:
    if cells.free.dtype == np.float32:
        return cells
    return replace(cells, free=cells.free.astype(np.float32), known=cells.known.astype(np.float32))


def _is_majority(mask: NDArray[np.bool_], border: int) -> NDArray[np.bool_]:
    """Whether most cells of the square around each cell are set."""
    import cv2  # large, so loaded when first used

    size = (_MAJORITY_WIDTH_CELLS, _MAJORITY_WIDTH_CELLS)
    count = cv2.boxFilter(mask.view(np.uint8), -1, size, normalize=False, borderType=border)
    return count > _MAJORITY_WIDTH_CELLS**2 // 2


def coarsen(cells: FilteredCells, resolution_m: float) -> FilteredCells:
    """The same evidence on larger cells whose grid starts at the same corner; any ratio from 1 up.

    The wall's place inside a large cell is the mean of the small wall cells in it, so that no
    precision is lost.
    """
    ratio = resolution_m / cells.resolution_m
    if ratio < 1.0 + 1e-9:
        return _with_shares(cells)
    whole = round(ratio)
    if abs(ratio - whole) < 1e-9 * ratio:
        sums = _whole_block_sums(  # much quicker
            cells.wall, cells.free, cells.known, cells.row, cells.col, whole
        )
    else:
        starts = [_block_starts(size, ratio) for size in cells.shape]
        cells = _with_shares(cells)
        wall = cells.wall
        places = wall * cells.row, wall * cells.col
        counted = (wall, cells.free, cells.known, *places, np.ones(cells.shape, np.float32))
        sums = np.stack([_block_sum(values, starts) for values in counted])
    wall_sum, free_sum, known_sum, row_sum, col_sum, count = sums
    weight = np.maximum(wall_sum, np.float32(1e-9))
    return FilteredCells(
        resolution_m,
        # A line through a block of k x k cells fills k of them; half of that is a wall.
        np.minimum(wall_sum * np.float32(2.0) / np.sqrt(count), np.float32(1.0)),
        free_sum / count,
        known_sum / count,
        (row_sum / weight / ratio).astype(np.float32),
        (col_sum / weight / ratio).astype(np.float32),
    )


def split(cells: FilteredCells) -> FilteredCells:
    """The same evidence on cells half as large: each of the four holds what the one held."""
    wall, free, known = (
        np.repeat(np.repeat(values, 2, axis=0), 2, axis=1)
        for values in (cells.wall, cells.free, cells.known)
    )
    rows, cols = (np.arange(size, dtype=np.float32) + np.float32(0.5) for size in wall.shape)
    return FilteredCells(
        0.5 * cells.resolution_m,
        wall,
        free,
        known,
        np.broadcast_to(rows[:, None], wall.shape),
        np.broadcast_to(cols, wall.shape),
    )


def _block_starts(size: int, ratio: float) -> NDArray[np.int64]:
    block = np.floor((np.arange(size) + 0.5) / ratio).astype(np.int64)
    return np.searchsorted(block, np.arange(block[-1] + 1))


@njit(cache=True, nogil=True)
def _whole_block_sums(
    wall: FloatGrid, free: Shares, known: Shares,
    row: FloatGrid, col: FloatGrid, side: int,
) -> FloatGrid:  # fmt: skip
    """Sums (6, R, C) over blocks of ``side`` x ``side`` cells.

    Of the first three arrays, of the walls' rows and columns, and of ones.
    """
    num_rows, num_cols = wall.shape
    sums = np.empty((6, -(-num_rows // side), -(-num_cols // side)), np.float32)
    for i in range(sums.shape[1]):
        for j in range(sums.shape[2]):
            last_row, last_col = min((i + 1) * side, num_rows), min((j + 1) * side, num_cols)
            s_wall, s_free, s_known, s_row, s_col = 0.0, 0.0, 0.0, 0.0, 0.0
            for r in range(i * side, last_row):
                for c in range(j * side, last_col):
                    s_free += free[r, c]
                    s_known += known[r, c]
                    w = wall[r, c]
                    if w > 0.0:
                        s_wall += w
                        s_row += w * row[r, c]
                        s_col += w * col[r, c]
            sums[0, i, j], sums[1, i, j], sums[2, i, j] = s_wall, s_free, s_known
            sums[3, i, j], sums[4, i, j] = s_row, s_col
            sums[5, i, j] = (last_row - i * side) * (last_col - j * side)
    return sums


def _block_sum(values: FloatGrid, starts: list[NDArray[np.int64]]) -> FloatGrid:
    return np.add.reduceat(np.add.reduceat(values, starts[0], axis=0), starts[1], axis=1)
