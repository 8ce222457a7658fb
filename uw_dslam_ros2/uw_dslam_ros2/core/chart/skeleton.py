"""The skeleton of a map's walls as runs of cells from end to end."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["connected_cells", "skeleton_runs"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
Cell = tuple[int, int]

_NEIGHBOURS = ((-1, 0), (0, 1), (1, 0), (0, -1), (-1, 1), (1, 1), (1, -1), (-1, -1))
_SPUR_CELLS = 4
"""A branch, or a way between two forks, no longer than that is a bulge of the wall beside it."""


def skeleton_runs(is_wall: BoolArray, gap_cells: float) -> list[IntArray]:
    """Thin walls to runs (N, 2) of cells [row, col], each next to the one before.

    Runs end at forks and where a wall ends; those that end no more than ``gap_cells`` from each
    other are joined. A ring ends where it begins.
    """
    from skimage.morphology import skeletonize  # slow to import, and charts are drawn at the end

    closed = is_wall.astype(np.uint8)
    if gap_cells >= 2.0:  # pinholes and bays of a cell would be rings and forks
        closed = cv2.morphologyEx(closed, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    skeleton = skeletonize(closed > 0)
    forks = _forks(skeleton)
    return _joined(_without_spurs(list(_runs(skeleton, forks)), forks), forks, gap_cells)


def connected_cells(is_wall: BoolArray, gap_cells: float) -> list[IntArray]:
    """Cells (N, 2) [row, col] of walls that no more than a gap keeps apart."""
    reach = int(0.5 * gap_cells + 0.5)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    grown = cv2.dilate(is_wall.astype(np.uint8), disc)
    _, labels = cv2.connectedComponents(grown, connectivity=8)
    cells = np.argwhere(is_wall)
    own = labels[tuple(cells.T)]
    order = np.argsort(own, kind="stable")
    starts = np.flatnonzero(np.diff(own[order])) + 1
    return [part for part in np.split(cells[order], starts) if len(part)]


def _forks(skeleton: BoolArray) -> dict[Cell, Cell]:
    """Skeleton cells where lines meet, and for each the one in their middle."""
    around = cv2.filter2D(
        skeleton.astype(np.uint8), -1, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT
    )
    forks: dict[Cell, Cell] = {}
    for cells in connected_cells(skeleton & (around > 3), 0.0):
        nearest = np.argmin(np.square(cells - cells.mean(axis=0)).sum(axis=1))
        row, col = cells[nearest]
        forks |= {(int(r), int(c)): (int(row), int(col)) for r, c in cells}
    return forks


def _runs(skeleton: BoolArray, forks: dict[Cell, Cell]) -> Iterator[list[Cell]]:
    """Skeleton cells from ends and forks to ends and forks, in the order of their first cells."""
    left = {(int(r), int(c)) for r, c in np.argwhere(skeleton)} - forks.keys()
    # Ends first: what is left then are rings.
    ends = [cell for cell in sorted(left) if len(_beside(cell, left)) <= 1]
    for start in [*ends, *sorted(left)]:
        if start not in left:
            continue
        run = [start]
        left.discard(start)
        while ways := _beside(run[-1], left):
            run.append(ways[0])
            left.discard(ways[0])
        first, last = _fork_at(run[0], forks), _fork_at(run[-1], forks)
        is_ring = first is None and last is None and len(run) > 2 and _touch(run[0], run[-1])
        run = [*([first] if first else []), *run, *([last] if last else [])]
        yield [*run, run[0]] if is_ring else run


def _without_spurs(runs: list[list[Cell]], forks: dict[Cell, Cell]) -> list[list[Cell]]:
    """Leave spurs out, and make one run of the two that then meet at a fork."""
    left = {
        number: run
        for number, run in enumerate(runs)
        if len(run) > _SPUR_CELLS + 1 or not (run[0] in forks or run[-1] in forks)
    }
    at: dict[Cell, list[int]] = {}
    for number, run in left.items():
        for cell in (run[0], run[-1]):
            if cell in forks:
                at.setdefault(cell, []).append(number)
    now = {number: number for number in left}  # in which run each is now
    for cell, numbers in sorted(at.items()):
        if len(numbers) != 2:
            continue
        a, b = (now[number] for number in numbers)
        if a == b:
            continue
        first, second = left[a], left.pop(b)
        first = first if first[-1] == cell else first[::-1]
        second = second if second[0] == cell else second[::-1]
        left[a] = [*first, *second[1:]]
        now = {number: a if run == b else run for number, run in now.items()}
    return list(left.values())


def _beside(cell: Cell, cells: set[Cell]) -> list[Cell]:
    row, col = cell
    return [(row + r, col + c) for r, c in _NEIGHBOURS if (row + r, col + c) in cells]


def _touch(cell: Cell, other: Cell) -> bool:
    return max(abs(cell[0] - other[0]), abs(cell[1] - other[1])) <= 1


def _fork_at(cell: Cell, forks: dict[Cell, Cell]) -> Cell | None:
    """The middle of a fork beside a cell."""
    row, col = cell
    return next(
        (forks[row + r, col + c] for r, c in _NEIGHBOURS if (row + r, col + c) in forks), None
    )


def _joined(runs: list[list[Cell]], forks: dict[Cell, Cell], gap_cells: float) -> list[IntArray]:
    """Runs whose ends face each other over a gap become one; the nearest ends first."""
    # Where runs meet there is a fork and no gap; a ring has no end.
    owner = {
        cell: number
        for number, run in enumerate(runs)
        if len(run) == 1 or run[0] != run[-1]
        for cell in (run[0], run[-1])
        if cell not in forks
    }
    free = sorted(owner)
    # Between the middles of the outermost cells a gap is one cell wider than what is open.
    pairs = _near_pairs(np.array(free, np.float64).reshape(-1, 2), gap_cells + 1.0)
    pieces: dict[int, list[Cell]] = dict(enumerate(runs))
    for one, two in ((free[i], free[j]) for i, j in pairs):
        if one not in owner or two not in owner:
            continue  # something nearer was joined there
        a, b = owner[one], owner[two]
        first, second = pieces[a], pieces[b]
        if a == b:
            if len(first) > 2:  # a ring, which has no end
                pieces[a] = [*first, first[0]]
                del owner[one], owner[two]
            continue
        first = first if first[-1] == one else first[::-1]
        second = second if second[0] == two else second[::-1]
        pieces[a] = [*first, *second]
        del pieces[b], owner[one], owner[two]
        owner |= {cell: a for cell in (first[0], second[-1]) if cell not in forks}
    return [np.array(run, np.int64) for _, run in sorted(pieces.items())]


def _near_pairs(cells: FloatArray, reach: float) -> list[tuple[int, int]]:
    """Pairs of cells no farther apart than that, the nearest first."""
    from scipy.spatial import cKDTree  # not every program that has charts draws lines

    if len(cells) < 2:
        return []
    pairs = cKDTree(cells).query_pairs(reach, output_type="ndarray")
    apart = np.hypot(*(cells[pairs[:, 0]] - cells[pairs[:, 1]]).T)
    order = np.lexsort((pairs[:, 1], pairs[:, 0], apart))
    return [(int(i), int(j)) for i, j in pairs[order]]
