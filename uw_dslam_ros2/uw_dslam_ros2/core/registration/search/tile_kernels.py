"""Compiled choice of tiles: which cells of a level are left, which are highest, what to split.

A tile is `SIDE` x `SIDE` cells of the translations under one slab of rotations.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["SIDE", "close_tiles", "find_highest", "split_tiles"]

IntArray = NDArray[np.int64]
SumArray = NDArray[np.float32]

SIDE = 8
"""Cells along a tile."""


@njit(cache=True, nogil=True)
def close_tiles(
    tiles: IntArray, parents: IntArray, parent_sums: SumArray, floor: float, rows: int, cols: int,
    sums: SumArray,
) -> None:  # fmt: skip
    """Bounds of tiles are at most their parents', and -inf where nothing is to be looked for.

    That is in cells outside of the window, and in those of which ``parent_sums``, at ``parents``
    (K,), say that they are not above ``floor``.
    """
    for k in range(tiles.shape[0]):
        row, col, total = tiles[k, 1], tiles[k, 2], sums[k]
        parent = parent_sums[parents[k]]
        first_row, first_col = SIDE // 2 * (row & 1), SIDE // 2 * (col & 1)
        for y in range(SIDE):
            for x in range(SIDE):
                above = parent[SIDE * (first_row + y // 2) + first_col + x // 2]
                at = SIDE * y + x
                is_inside = SIDE * row + y < rows and SIDE * col + x < cols
                total[at] = min(total[at], above) if is_inside and above > floor else -np.inf


@njit(cache=True, nogil=True)
def find_highest(sums: SumArray, tiles: IntArray, cells: IntArray) -> int:
    """Tiles with the highest sums, highest first, and their cells, both (K,); their number."""
    greatest, count = np.empty(tiles.shape[0], np.float32), 0
    for tile in range(sums.shape[0]):
        best, cell = np.float32(-np.inf), 0
        for x in range(SIDE * SIDE):
            if sums[tile, x] > best:
                best, cell = sums[tile, x], x
        k = min(count, tiles.shape[0] - 1)
        if best == -np.inf or (count == tiles.shape[0] and best <= greatest[k]):
            continue
        while k > 0 and best > greatest[k - 1]:
            greatest[k], tiles[k], cells[k] = greatest[k - 1], tiles[k - 1], cells[k - 1]
            k -= 1
        greatest[k], tiles[k], cells[k] = best, tile, cell
        count = min(count + 1, tiles.shape[0])
    return count


@njit(cache=True, nogil=True)
def split_tiles(
    tiles: IntArray, sums: SumArray, floor: float, turns: int, children: IntArray,
    parents: IntArray,
) -> int:  # fmt: skip
    """Tiles of the next level, by slab, around the cells above ``floor``; their number.

    ``children`` (4 turns K, 3) have half the cells, and one of ``turns`` parts of the slab;
    ``parents`` (4 turns K,) are the indices of the tiles that they lie in.
    """
    count, begin, half = 0, 0, SIDE // 2
    while begin < tiles.shape[0]:
        end = begin
        while end < tiles.shape[0] and tiles[end, 0] == tiles[begin, 0]:
            end += 1
        for turn in range(turns):
            for k in range(begin, end):
                for part in range(4):
                    row, col = part >> 1, part & 1
                    is_open = False
                    for y in range(half * row, half * row + half):
                        for x in range(half * col, half * col + half):
                            is_open |= sums[k, SIDE * y + x] > floor
                    if is_open:
                        children[count, 0] = turns * tiles[k, 0] + turn
                        children[count, 1] = 2 * tiles[k, 1] + row
                        children[count, 2] = 2 * tiles[k, 2] + col
                        parents[count] = k
                        count += 1
        begin = end
    return count
