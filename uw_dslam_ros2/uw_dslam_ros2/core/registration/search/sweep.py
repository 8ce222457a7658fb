"""Sweeps over all motions, which leave the best-first search little to do.

All translations of a slab of rotations are bounded together (`sweep_kernels`), for a fiftieth of
what the same boxes cost one by one. Every level halves cells and slabs, and looks only around
those that could still hold the best pose. The bounds are the search's first ones, the largest
value of the field that each point can reach, added up in float32 with the rounding on top.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.registration.search import sweep_kernels, tile_kernels
from uw_dslam_ros2.core.registration.search.field import Field
from uw_dslam_ros2.core.registration.search.problem import Problem, Term
from uw_dslam_ros2.core.registration.search.tile_kernels import SIDE

__all__ = ["Sweep"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
SumArray = NDArray[np.float32]
TableArray = NDArray[np.int16]

_TURN = 0.8  # half cells that half a slab moves the mean point by, at most
_FIRST_ADDITIONS = 6e6  # points times cells of the first level, at most
_STEPS = (2, 2, 2, 4, 8)  # table cells to a cell, from the finest level on
_WIDTHS = np.array([1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32])  # of squares, in table cells
_LAYER_OF_WIDTH = np.searchsorted(_WIDTHS, np.arange(_WIDTHS[-1] + 1)).astype(np.int64)
_UNITS = 32000.0  # that the highest value of a field is in its tables
_RECTANGLES_FROM = 150  # points, on the finest level; with fewer, tables of squares are cheaper
_MAX_TILES = 100_000  # of a level; 25 MB

# What things cost, in nanoseconds; the first three per point.
_BOX, _TILE, _FIRST_GAIN = 6.0, 4.0, 64.0
_ENTRY = 5.0  # of a slab's own table
_CUT = 4.0  # an entry of a layer
_LEVEL = 2e5  # beginning one
_BATCH = 2e7  # between two questions whether to stop


@dataclass(frozen=True, slots=True, eq=False)
class _Level:
    """Slabs and cells of one size."""

    half_m: float  # of a cell
    step: int  # table cells to a cell
    fold: int  # table cells to a square of a slab's own table
    delta: float  # half a slab
    num_slabs: int
    shape: tuple[int, int]  # rows and columns of cells
    origin: FloatArray  # (2,), middle of the first cell [m]


class Sweep:
    """Bounds of ever smaller boxes around those above a floor.

    Attributes
    ----------
    num_tiles : int
        Tiles of `SIDE` x `SIDE` boxes bounded so far.
    """

    def __init__(self, problem: Problem, max_tiles: int = _MAX_TILES) -> None:
        self._problem = problem
        self._max_tiles = min(max_tiles, _MAX_TILES)
        num_points = problem.points.shape[1]
        # Each weight, product and sum is rounded once, by 2^-24 of at most the peak.
        self._slack = (num_points + 16) * 2.0**-23 * problem.peak
        self._points = self._in_strips()
        self._levels = self._plan()
        self._at = -1
        self._tiles = np.zeros((1, 3), np.int64)
        self._sums = np.full((1, SIDE * SIDE), np.inf, np.float32)
        self.num_tiles = 0

    def _in_strips(self) -> FloatArray:
        """Each term's points, neighbours one after the other, which read the same memory."""
        points = self._problem.points[:3].copy()
        for first, end in self._problem.rows[:, :2]:
            x, y, _ = part = points[:, first:end]
            side = max(float(np.ptp(y)), 1e-300) / 8.0
            points[:, first:end] = part[:, np.lexsort((x, np.floor(y / side)))]
        return points

    def _plan(self) -> list[_Level]:
        """Levels, the first as fine as is cheap, the last two cells of the finest field wide.

        Smaller ones do not pay: there the search's second bound is better than the first.
        """
        p, window = self._problem, self._problem.window
        halves = p.pitch_m * 2.0 ** np.arange(16)
        num_slabs = np.ceil(np.maximum(window[3] * p.arm / (_TURN * halves), 1.0)).astype(int)
        # Columns and rows of cells that cover the window; the last ones stick out.
        shapes = np.ceil(window[4:, None] / halves * (1.0 + 1e-12))
        cols, rows = np.maximum(shapes, 1.0).astype(int)
        is_cheap = num_slabs * rows * cols * p.points.shape[1] <= _FIRST_ADDITIONS
        first = int(is_cheap.argmax()) if is_cheap.any() else len(halves) - 1
        levels, slabs = [], int(num_slabs[first])
        for k in range(first, -1, -1):
            if slabs < num_slabs[k]:
                slabs *= 2
            step, fold = _STEPS[min(k, len(_STEPS) - 1)], 2 if k == 0 else 1
            shape, low = (int(rows[k]), int(cols[k])), window[1:3] - window[4:] + halves[k]
            levels.append(
                _Level(float(halves[k]), step, fold, window[3] / slabs, slabs, shape, low)
            )
        return levels

    def advance(self, floor: float, is_over: Callable[[], bool] | None = None) -> bool:
        """Bound the next level around the cells above ``floor``.

        False where that is not done: no level or no cell is left, single boxes are cheaper, it
        would take too many, or the time is up.
        """
        if self._at + 1 == len(self._levels):
            return False
        level = self._levels[self._at + 1]
        tiles, parents = self._children(floor, level)
        if not 0 < len(tiles) <= self._max_tiles - self.num_tiles:
            return False
        costs = self._costs(tiles, level)
        if costs[-1] > self._cost_of_boxes(floor, level):
            return False
        sums = np.full((len(tiles), SIDE * SIDE), np.float32(self._slack))
        adders = [self._adder(k, level) for k in range(len(self._problem.terms))]
        ends = np.searchsorted(costs, np.arange(_BATCH, costs[-1], _BATCH))
        for begin, end in zip([0, *ends], [*ends, len(tiles)], strict=True):
            if is_over and is_over():
                return False
            for add in adders:
                add(tiles[begin:end], sums[begin:end])
        tile_kernels.close_tiles(tiles, parents, self._sums, floor, *level.shape, sums)
        self._at += 1
        self._tiles, self._sums = tiles, sums
        self.num_tiles += len(tiles)
        return True

    @property
    def num_cells(self) -> int:
        """Boxes bounded so far."""
        return self.num_tiles * SIDE * SIDE

    def num_open(self, floor: float) -> int:
        """Number of boxes of the last level above ``floor``."""
        return int(np.count_nonzero(self._sums > _rounded_down(floor)))

    def highest(self, count: int) -> FloatArray:
        """Boxes (K, 6) with the highest bounds, one of a tile, highest first."""
        tiles, cells = np.empty((2, count), np.int64)
        num = tile_kernels.find_highest(self._sums, tiles, cells)
        return self._boxes(tiles[:num], cells[:num])

    def boxes(self, floor: float) -> tuple[FloatArray, FloatArray]:
        """Boxes (K, 6) above a floor and their bounds (K,), highest first."""
        sums = self._sums.ravel()
        places = np.flatnonzero(sums > _rounded_down(floor))
        bounds = sums[places]
        order = np.argsort(-bounds, kind="stable")
        tiles, cells = np.divmod(places[order], SIDE**2)
        return self._boxes(tiles, cells), bounds[order].astype(np.float64)

    def _boxes(self, tiles: IntArray, cells: IntArray) -> FloatArray:
        """Boxes of some cells, without what sticks out of the window."""
        level, window = self._levels[self._at], self._problem.window
        slab, row, col = self._tiles[tiles].T
        row, col = SIDE * row + cells // SIDE, SIDE * col + cells % SIDE
        boxes = np.empty((len(tiles), 6))
        boxes[:, 0] = self._first_theta(level) + 2.0 * level.delta * slab
        boxes[:, 3] = level.delta
        middles = level.origin + 2.0 * level.half_m * np.column_stack([col, row])
        low, high = middles - level.half_m, middles + level.half_m
        high = np.minimum(high, window[1:3] + window[4:])
        boxes[:, 1:3], boxes[:, 4:] = 0.5 * (low + high), 0.5 * (high - low)
        return boxes

    def _children(self, floor: float, level: _Level) -> tuple[IntArray, IntArray]:
        if self._at < 0:
            sizes = level.num_slabs, *(math.ceil(side / SIDE) for side in level.shape)
            tiles = np.indices(sizes).reshape(3, -1).T.copy()
            return tiles, np.zeros(len(tiles), np.int64)
        turns = level.num_slabs // self._levels[self._at].num_slabs
        children = np.empty((4 * turns * len(self._tiles), 3), np.int64)
        parents = np.empty(len(children), np.int64)
        count = tile_kernels.split_tiles(self._tiles, self._sums, floor, turns, children, parents)
        return children[:count], parents[:count]

    def _costs(self, tiles: IntArray, level: _Level) -> FloatArray:
        """What it costs up to each of the tiles, tables included (K,)."""
        tables, slab = _LEVEL, 0.0
        for term in self._problem.terms:
            entries = term.field.coefficients.size / self._size(term.field.pitch_m, level) ** 2
            if term.is_inverse:
                slab += _ENTRY * entries / level.fold**2
            tables += _CUT * entries * 4.0
        is_next = np.concatenate([[1.0], np.diff(tiles[:, 0]) != 0])
        tile = _TILE * self._problem.points.shape[1]
        costs: FloatArray = tables + np.cumsum(tile + slab * is_next)
        return costs

    def _cost_of_boxes(self, floor: float, level: _Level) -> float:
        """What the single boxes cost that the search would have to bound instead."""
        if self._at < 0:  # it lets the next be swept
            num_boxes = _FIRST_GAIN * level.num_slabs * math.prod(level.shape)
        else:
            num_boxes = 8.0 * self.num_open(floor)
        return _BOX * self._problem.points.shape[1] * num_boxes

    @staticmethod
    def _size(pitch_m: float, level: _Level) -> float:
        """Cells of a field to one of its tables."""
        size = 2.0 * level.half_m / (level.step * pitch_m)
        whole = round(size)
        return float(whole) if abs(size - whole) < 1e-9 * size else size

    def _first_theta(self, level: _Level) -> float:
        return float(self._problem.window[0] - self._problem.window[3]) + level.delta

    def _adder(self, k: int, level: _Level) -> Callable[[IntArray, SumArray], None]:
        """What adds a term's part to the sums of tiles, its tables at hand."""
        p, term = self._problem, self._problem.terms[k]
        first, end = p.rows[k, :2]
        size = self._size(term.field.pitch_m, level)
        unit = max(float(np.abs(term.field.coefficients).max()), 1e-30) / _UNITS
        kernel, tables = (
            (sweep_kernels.add_inverse, self._inverse_tables(term, level, size, unit))
            if term.is_inverse
            else (sweep_kernels.add_forward, self._forward_tables(term, level, size, unit))
        )
        arguments = (
            self._first_theta(level), level.delta, level.half_m, level.origin,
            self._points, int(first), int(end), p.frames[k], size, level.step, unit,
            _LAYER_OF_WIDTH, *tables,
        )  # fmt: skip
        return lambda tiles, sums: kernel(tiles, *arguments, sums)

    def _forward_tables(
        self, term: Term, level: _Level, size: float, unit: float
    ) -> tuple[object, ...]:
        """The most that a field brings, slots of the layers, first cell, and the strips."""
        reach = float(np.hypot(*(term.points - self._problem.source_center).T).max())
        widest = level.step + 2.0 * min(level.delta, 2.0) * reach / (size * term.field.pitch_m)
        layers = _layers(level.step + 1, widest + 1.0)
        pad = int(_WIDTHS[layers[-1]])
        tables = _squares(term.field, size, unit, pad, layers)
        slots = np.full((len(_WIDTHS), len(_WIDTHS)), -1)
        index = np.arange(len(layers))
        slots[np.ix_(layers, layers)] = np.maximum(index[:, None], index)
        if level is self._levels[-1] and len(term.points) >= _RECTANGLES_FROM:
            tables = _rectangles(tables, _WIDTHS[layers])
            slots[np.ix_(layers, layers)] = np.arange(len(tables)).reshape(2 * [len(layers)])
        before = SIDE * level.step
        rows, cols = (-(-(before + side) // level.step) for side in tables.shape[1:])
        strips = np.empty((len(tables), level.step, level.step, cols, rows + SIDE, SIDE), np.int16)
        for table, into in zip(tables, strips, strict=True):
            sweep_kernels.cut_strips(table, -before, level.step, into)
        return slots, term.field.maximum, -before - pad, strips

    def _inverse_tables(
        self, term: Term, level: _Level, size: float, unit: float
    ) -> tuple[object, ...]:
        """Table cells to a square of u, where the field is not zero, and its layers."""
        field = term.field
        corner = np.abs([field.origin, field.high] - self._problem.source_center).max(axis=0)
        reach = float(np.hypot(*corner))
        widest = 1.5 * level.fold + 2.0 * min(level.delta, 2.0) * reach / (size * field.pitch_m)
        tables = _squares(field, size, unit, 0, _layers(1, widest + 1.0))
        ends = []
        for axis in (1, 0):
            used = np.flatnonzero(tables[0].any(axis=1 - axis))
            ends.append((used[0], used[-1] + 1) if len(used) else (0, 1))
        content = np.array(ends, dtype=np.float64).T.ravel()
        return level.fold, content, tables


def _rounded_down(value: float) -> np.float32:
    """As float32, which is quicker to compare with, and no greater."""
    return np.nextafter(np.float32(value), np.float32(-np.inf))


def _layers(narrowest: int, widest: float) -> IntArray:
    """Those of the widths from one to another, as far as there are."""
    last = _LAYER_OF_WIDTH[min(math.ceil(widest), int(_WIDTHS[-1]))]
    return np.arange(_LAYER_OF_WIDTH[narrowest], last + 1)


def _squares(field: Field, size: float, unit: float, pad: int, layers: IntArray) -> TableArray:
    """Greatest values (L, R, C) over squares of the layers' widths, in units; see `coarsen`."""
    shape = [pad + math.ceil(side / size) for side in field.coefficients.shape]
    tables = np.empty((len(layers), *shape), np.int16)
    narrow, width = np.empty(shape, np.int16), 1
    sweep_kernels.coarsen(field.tables[0][0], size, unit, pad, narrow)
    for table, wider in zip(tables, _WIDTHS[layers].tolist(), strict=True):
        # A wide window is the union of narrow ones, which may overlap.
        while True:
            more = min(wider - width, width)
            sweep_kernels.widen(narrow, more, more, table)
            narrow, width = table, width + more
            if width == wider:
                break
            narrow = table.copy()
    return tables


def _rectangles(squares: TableArray, widths: IntArray) -> TableArray:
    """Greatest values (L^2, R, C) over rectangles, by height and then width, from squares."""
    num = len(widths)
    tables = np.empty((num**2, *squares.shape[1:]), np.int16)
    for i, j in itertools.product(range(num), repeat=2):
        more = (widths[[i, j]] - widths[min(i, j)]).tolist()
        sweep_kernels.widen(squares[min(i, j)], *more, tables[num * i + j])
    return tables
