"""Sweeps over the poses of two maps, which leave the search box by box little to do.

All translations of a slab of rotations are bounded together (`grid_sweep_kernels`), for a fiftieth
of what the same boxes cost one by one. Every level halves the cells and looks only around those
that could still hold a better pose than the best one known.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.registration.grids import sweep_kernels as grid_sweep_kernels
from uw_dslam_ros2.core.registration.grids.kernels import TABLE_STEP
from uw_dslam_ros2.core.registration.grids.problem import GridProblem, PoseWindow
from uw_dslam_ros2.core.registration.grids.signed_field import (
    PAD,
    layer_lookup,
    refined,
    value_tables,
)
from uw_dslam_ros2.core.registration.grids.sweep_kernels import SIDE

__all__ = ["GridSweep", "Tables"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
TableArray = NDArray[np.int16]

_LEVELS = ((4.0, 1, 1), (2.0, 1, 1), (1.0, 2, 1), (0.5, 2, 1), (0.25, 4, 2))
"""Half-widths of boxes, table cells to a working cell there, and to a cell of a slab's table."""
_SLACK_CELLS = 1e-6
_MAX_TABLE_CELLS = 600_000  # of one side, 16 MB
_MAX_TILES = 100_000  # of a level; 25 MB
_LEVEL_COST = 200.0  # of getting tables ready, in single boxes that could be bounded meanwhile
_ENTRY_COST = 1e-3  # of an entry of a slab's table
_TILE_COST = 0.3
_FIRST_GAIN = 64.0  # boxes that one of the first level spares, for it lets the next be swept
_BATCH_COST = 500.0  # between two questions whether to stop


@dataclass(frozen=True, slots=True, eq=False)
class Tables:
    """Range maxima of both fields, ``scale`` table cells to a working cell."""

    scale: int
    target: TableArray
    source: TableArray


@dataclass(frozen=True, slots=True, eq=False)
class _Level:
    """Slabs and cells of one size."""

    half: float  # of a cell [working cells]
    scale: int
    size: int
    num_slabs: int
    shape: tuple[int, int]  # rows and columns of cells

    @property
    def step(self) -> int:
        """Table cells to a cell of the translations."""
        return round(2.0 * self.half * self.scale)


class GridSweep:
    """Bounds of ever smaller boxes of poses around those above a threshold.

    Parameters
    ----------
    tables : list of Tables
        Those that exist already, at least of scale 1; finer ones are made when they are needed.

    Attributes
    ----------
    num_tiles : int
        Tiles of `SIDE` x `SIDE` boxes bounded so far.
    """

    def __init__(self, problem: GridProblem, window: PoseWindow, tables: list[Tables]) -> None:
        self._problem, self._window = problem, window
        self._tables = {t.scale: t for t in tables}
        self._levels = self._plan()
        self._at = -1
        self._tiles = np.zeros((1, 3), np.int64)
        self._sums = np.full((1, SIDE * SIDE), np.inf, np.float32)
        self.num_tiles = 0

    def _plan(self) -> list[_Level]:
        levels: list[_Level] = []
        fields = self._problem.target_field, self._problem.source_field
        num_cells = max(field.coefficients.size for field in fields)
        for half, scale, size in _LEVELS:
            if scale > 1 and scale**2 * num_cells > _MAX_TABLE_CELLS:
                break
            if not levels:
                cols, rows = (math.ceil(float(s) / half - 1e-9) for s in self._window.half[1:])
                rim = float(self._window.half[0]) * self._problem.radius
                num_slabs = math.ceil(rim / half)
            else:
                rows, cols, num_slabs = 2 * rows, 2 * cols, 2 * num_slabs
            levels.append(_Level(half, scale, size, num_slabs, (rows, cols)))
        return levels

    @property
    def half(self) -> float:
        """Half-width of the boxes [cells]."""
        return self._levels[self._at].half

    @property
    def half_rad(self) -> float:
        """The same of their rotations."""
        return float(self._window.half[0]) / self._levels[self._at].num_slabs

    def advance(self, threshold: float, max_tiles: int, should_stop: Callable[[], bool]) -> bool:
        """Bound the next level around the boxes above ``threshold``.

        False where that is not done: no level or no box is left, single boxes are cheaper, or it
        would take more than ``max_tiles``, or it was stopped.
        """
        if self._at + 1 == len(self._levels):
            return False
        level = self._levels[self._at + 1]
        tiles, parents = self._children(threshold, level)
        changes = np.concatenate([[1.0], np.diff(tiles[:, 0]) != 0])
        costs = np.cumsum(_TILE_COST + changes * self._num_entries(level) * _ENTRY_COST)
        if not 0 < len(tiles) <= min(max_tiles, _MAX_TILES):
            return False
        if _LEVEL_COST * level.scale + costs[-1] > self._num_boxes(threshold, level):
            return False
        sums = np.empty((len(tiles), SIDE * SIDE), np.float32)
        ends = np.searchsorted(costs, np.arange(_BATCH_COST, costs[-1], _BATCH_COST))
        arguments = self._arguments(level)
        for begin, end in zip([0, *ends], [*ends, len(tiles)], strict=True):
            if should_stop():
                return False
            grid_sweep_kernels.bound_tiles(
                tiles[begin:end], parents[begin:end], self._sums, sums[begin:end], threshold,
                *arguments,
            )  # fmt: skip
        self._at += 1
        self._tiles, self._sums = tiles, sums
        self.num_tiles += len(tiles)
        return True

    def boxes(self, threshold: float) -> tuple[FloatArray, FloatArray]:
        """Boxes (K, 3) [theta, t_x, t_y] of the last level above ``threshold``, and their bounds.

        The highest come first.
        """
        at, cell = np.nonzero(self._sums > np.float64(threshold))
        bounds = self._sums[at, cell].astype(np.float64)
        order = np.argsort(-bounds, kind="stable")
        return self._poses(at[order], cell[order]), bounds[order]

    def promising(self, count: int) -> FloatArray:
        """Middles (K, 3) of the boxes with the highest bounds, one of a tile."""
        greatest = self._sums.max(axis=1)
        tiles = np.argsort(-greatest, kind="stable")[:count]
        tiles = tiles[greatest[tiles] > -np.inf]
        return self._poses(tiles, self._sums[tiles].argmax(axis=1))

    @property
    def greatest(self) -> float:
        """Greatest bound of the last level."""
        return float(self._sums.max())

    def num_open(self, threshold: float) -> int:
        """Number of boxes of the last level above ``threshold``."""
        return int(np.count_nonzero(self._sums > np.float64(threshold)))

    def greatest_below(self, threshold: float) -> float:
        """Greatest bound of the last level that is not above ``threshold``."""
        return float(self._sums.max(initial=-np.inf, where=self._sums <= np.float64(threshold)))

    def _poses(self, tiles: IntArray, cells: IntArray) -> FloatArray:
        """Middles (K, 3) of cells of tiles."""
        slab, row, col = self._tiles[tiles].T
        row, col = SIDE * row + cells // SIDE, SIDE * col + cells % SIDE
        level = self._levels[self._at]
        low = self._low(level)
        theta = self._window.middle[0] + self.half_rad * (2 * slab + 1 - level.num_slabs)
        x, y = low[0] + 2.0 * level.half * col, low[1] + 2.0 * level.half * row
        return np.column_stack([theta, x, y])

    def _children(self, threshold: float, level: _Level) -> tuple[IntArray, IntArray]:
        if self._at < 0:
            rows, cols = (math.ceil(side / SIDE) for side in level.shape)
            axes = np.meshgrid(
                np.arange(level.num_slabs), np.arange(rows), np.arange(cols), indexing="ij"
            )
            tiles = np.column_stack([axis.ravel() for axis in axes])
            return tiles, np.zeros(len(tiles), np.int64)
        turns = level.num_slabs // self._levels[self._at].num_slabs
        children = np.empty((4 * turns * len(self._tiles), 3), np.int64)
        parents = np.empty(len(children), np.int64)
        count = grid_sweep_kernels.split_tiles(
            self._tiles, self._sums, threshold, turns, children, parents
        )
        return children[:count], parents[:count]

    def _num_boxes(self, threshold: float, level: _Level) -> float:
        """Single boxes that the search would have to bound instead."""
        if self._at < 0:
            return _FIRST_GAIN * level.num_slabs * level.shape[0] * level.shape[1]
        return 8.0 * self.num_open(threshold)

    def _low(self, level: _Level) -> FloatArray:
        """Middle [x, y] of the first cell."""
        rows, cols = level.shape
        return self._window.middle[1:] - level.half * (np.array([cols, rows]) - 1.0)

    def _bounds(self) -> FloatArray:
        """Where the source's field is not zero, [x, y, x, y] about the center."""
        rows, cols = self._problem.source_field.coefficients.shape
        # Half a cell to the first centre, and one that the spline reaches.
        low = np.full(2, PAD - 2.0)
        high = np.array([cols, rows]) - low
        return np.concatenate([low, high]) - np.tile(self._problem.center + PAD + 0.5, 2)

    def _num_entries(self, level: _Level) -> float:
        """Table cells of a slab."""
        bounds = self._bounds()
        return (level.scale / level.size) ** 2 * float(np.prod(bounds[2:] - bounds[:2]))

    def _arguments(self, level: _Level) -> tuple[object, ...]:
        problem, tables = self._problem, self._tables_of(level.scale)
        delta = float(self._window.half[0]) / level.num_slabs
        strips, first, slots = self._strips(level, delta)
        weights = problem.source_weights, problem.target_weights
        peak = sum(
            float(w.sum()) * float(np.abs(table[[0, -1]]).max()) * TABLE_STEP
            for w, table in zip(weights, (tables.target, tables.source), strict=True)
        )
        # Each weight, product and sum is rounded once, by 2^-24 of at most the peak.
        margin = (len(weights[0]) + len(weights[1]) + 16) * 2.0**-23 * peak
        first_theta = float(self._window.middle[0] - self._window.half[0]) + delta
        return (
            first_theta, delta, level.half, self._low(level), np.array(level.shape),
            problem.source_points, weights[0], strips, first, slots,
            problem.target_points, weights[1], tables.source, level.scale * (PAD - 2.0),
            self._bounds(), problem.center, PAD + 0.5, float(level.scale), float(level.size),
            TABLE_STEP, layer_lookup()[0], level.step, margin, _SLACK_CELLS,
        )  # fmt: skip

    def _tables_of(self, scale: int) -> Tables:
        if scale not in self._tables:
            fields = [self._problem.target_field, self._problem.source_field]
            for _ in range(scale.bit_length() - 1):
                fields = [refined(field) for field in fields]
            self._tables[scale] = Tables(scale, *(value_tables(field) for field in fields))
        return self._tables[scale]

    def _strips(self, level: _Level, delta: float) -> tuple[TableArray, int, IntArray]:
        """Strips of the target's tables that are used, the table cell that they count from, slots.

        Slots (L,) tell for every table where its strips are, -1 where they are not.
        """
        tables, step = self._tables_of(level.scale).target, level.step
        layer_of_width, width_of_layer = layer_lookup()
        reach = float(np.sqrt((self._problem.source_points**2).sum(axis=1).max())) * min(
            delta, 2.0
        )
        widest = min(step + math.ceil(2.0 * level.scale * reach) + 2, int(width_of_layer[-1]))
        layers = np.arange(layer_of_width[step], layer_of_width[widest] + 1)
        slots = np.full(len(tables), -1)
        slots[layers] = np.arange(len(layers))
        # Beyond the cell of the rim in which the spline ends, everything is zero.
        begin = level.scale * (PAD - 2)
        first = begin - int(width_of_layer[-1]) - SIDE * step
        num = [-(-(side - begin - first) // step) for side in tables.shape[1:]]
        strips = np.empty((len(layers), step, step, num[1], num[0] + SIDE, SIDE), np.int16)
        for layer, into in zip(layers, strips, strict=True):
            grid_sweep_kernels.cut_strips(tables[layer], first, step, into)
        return strips, first, slots
