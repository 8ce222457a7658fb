"""A map's walls as lines with a width and an age, and what is too small for a line as points."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.chart.skeleton import connected_cells, skeleton_runs
from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import OccupancyMap

__all__ = ["Pier", "Wall", "trace_walls"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
Ages = Callable[[IntArray], IntArray]

_WALL_PERCENT = 50
_AROUND_CELLS = 3
"""The middle of a wall is that of its cells in squares of so many to each side."""
_TOLERANCE_CELLS = 1.0
"""A line passes no farther from the middle of its wall."""


@dataclass(frozen=True, slots=True, eq=False)
class Wall:
    """A polyline (N >= 2, 2) [m] along the middle of a wall, and how thick the map shows it.

    ``last_seen_ns`` is when the last of its cells was last seen, None where that is not known.
    """

    points: FloatArray
    width_m: float
    last_seen_ns: int | None = None

    @property
    def length_m(self) -> float:
        """Along the line."""
        return float(np.hypot(*np.diff(self.points, axis=0).T).sum())


@dataclass(frozen=True, slots=True)
class Pier:
    """Something that stands alone: its middle [m], its size as the map shows it, its age."""

    x: float
    y: float
    width_m: float
    last_seen_ns: int | None = None


def trace_walls(
    occupancy: OccupancyMap,
    last_seen_ns: Ages | None = None,
    *,
    gap_m: float | None = None,
    pier_m: float = 1.0,
) -> tuple[list[Wall], list[Pier]]:
    """Thin a map's walls to lines; coordinates are those of the map's frame.

    Parameters
    ----------
    occupancy
        The map; cells above 50 percent are walls.
    last_seen_ns
        Takes cells (N, 2) [row, col] to when each was last seen (N,); 0 where that is not known.
    gap_m
        Walls that end no farther from each other than that are one. Default: 0.3 m, which is what
        a beam of a degree leaves open at 17 m, or two cells.
    pier_m
        What extends no farther than that, whichever way, is a pier.

    Raises
    ------
    InvalidInputError
        A gap or size that is negative or not finite.
    """
    spec = occupancy.spec
    gap_m = max(0.3, 2.0 * spec.resolution_m) if gap_m is None else gap_m
    for name, value in (("gap_m", gap_m), ("pier_m", pier_m)):
        if not (math.isfinite(value) and value >= 0.0):
            raise InvalidInputError(f"{name} is {value}, expected a number of at least 0")
    is_wall = occupancy.values > _WALL_PERCENT
    gap_cells = gap_m / spec.resolution_m
    piers, is_line = [], is_wall.copy()
    for cells in connected_cells(is_wall, gap_cells):
        side_m = float((np.ptp(cells, axis=0).max() + 1) * spec.resolution_m)
        if side_m <= pier_m:
            ((x, y),) = spec.centers_of(cells.mean(axis=0)[None])
            seen_ns = 0 if last_seen_ns is None else int(last_seen_ns(cells).max())
            piers.append(Pier(float(x), float(y), side_m, seen_ns or None))
            is_line[tuple(cells.T)] = False
    runs = skeleton_runs(is_line, gap_cells)
    return list(_walls(occupancy, is_line, runs, last_seen_ns)), piers


def _walls(
    occupancy: OccupancyMap, is_line: BoolArray, runs: list[IntArray], ages: Ages | None
) -> Iterator[Wall]:
    padded = np.pad(is_line, _AROUND_CELLS)
    areas, latest = _nearest(is_line, runs, ages)
    for number, run in enumerate(runs):
        if len(run) < 2:
            continue
        across = _across(run, padded)
        # In single precision, as OpenCV takes it: exact to a thousandth of a cell.
        kept = cv2.approxPolyDP(across[:, None].astype(np.float32), _TOLERANCE_CELLS, closed=False)
        points = occupancy.spec.centers_of(kept[:, 0].astype(np.float64))
        length_cells = float(np.hypot(*np.diff(across, axis=0).T).sum()) + 1.0
        width_m = areas[number] / length_cells * occupancy.spec.resolution_m
        yield Wall(points, float(width_m), int(latest[number]) or None)


def _middles(padded: BoolArray, cells: IntArray) -> FloatArray:
    """Mean (N, 2) of the wall cells around each of some cells, as an offset from it.

    ``padded`` are the wall cells with `_AROUND_CELLS` more on each side.
    """
    step = np.arange(2 * _AROUND_CELLS + 1)
    around = padded[
        (cells[:, 0, None] + step)[:, :, None], (cells[:, 1, None] + step)[:, None, :]
    ].astype(np.float64)
    count = np.maximum(around.sum(axis=(1, 2)), 1.0)
    offset = step - float(_AROUND_CELLS)
    rows, cols = around.sum(axis=2) @ offset, around.sum(axis=1) @ offset
    return np.column_stack([rows / count, cols / count])


def _across(run: IntArray, padded: BoolArray) -> FloatArray:
    """A run (N, 2) moved to the middle of its wall, square to the run only: ends stay ends."""
    path = run.astype(np.float64)
    before = np.maximum(np.arange(len(path)) - _AROUND_CELLS, 0)
    after = np.minimum(np.arange(len(path)) + _AROUND_CELLS, len(path) - 1)
    along = path[after] - path[before]
    length = np.hypot(*along.T)
    along = np.where(length[:, None] > 0.0, along / np.maximum(length, 1.0)[:, None], 0.0)
    offset = _middles(padded, run)
    offset = offset - (offset * along).sum(axis=1, keepdims=True) * along
    return path + offset


def _nearest(
    is_line: BoolArray, runs: list[IntArray], ages: Ages | None
) -> tuple[IntArray, IntArray]:
    """How many wall cells lie nearest to each run, and when the last of them was seen."""
    from scipy.spatial import cKDTree  # not every program that has charts draws lines

    latest = np.zeros(len(runs), np.int64)
    if not runs:
        return latest, latest
    cells = np.argwhere(is_line)
    owner = np.repeat(np.arange(len(runs)), [len(run) for run in runs])
    nearest = owner[cKDTree(np.concatenate(runs)).query(cells)[1]]
    if ages is not None:
        np.maximum.at(latest, nearest, ages(cells))
    return np.bincount(nearest, minlength=len(runs)), latest
