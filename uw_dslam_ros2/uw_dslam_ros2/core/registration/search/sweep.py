"""Sweeps over all motions, which leave the best-first search little to do.

All translations of a slab of rotations are bounded together (`sweep_kernels`), for a fiftieth of
what the same boxes cost one by one. Every level halves cells and slabs, and looks only around
those that could still hold the best pose. The bounds are the search's first ones, the largest
value of the field that each point can reach, added up in float32 with the rounding on top.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.registration.search import sweep_kernels
from uw_dslam_ros2.core.registration.search.problem import Problem

__all__ = ["Sweep"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_TURN = 1.0  # half cells that half a slab moves the mean point by, at most
_FIRST_ADDITIONS = 4e6  # points times cells of the first level, at most
_MAX_LEVELS = 8
_MAX_SIZES = 6  # of rectangles along an axis; what reaches further counts with the maximum
_BATCH = 1e8  # points times cells between two looks at the clock


@dataclass(frozen=True, slots=True, eq=False)
class _Level:
    """Slabs and cells of one size."""

    base: int  # cells of the field in half a cell of the translations
    half_m: float  # that half
    delta: float  # half a slab
    num_slabs: int
    shape: tuple[int, int]  # rows and columns of cells
    origin: FloatArray  # (2,), middle of the first cell [m]


class Sweep:
    """Bounds of ever smaller boxes around those above a floor.

    Parameters
    ----------
    problem : Problem
        One that it `suits`.
    max_cells : int
        That a level may have.
    max_bytes : float
        That its tables may have.

    Attributes
    ----------
    num_cells : int
        Bounded so far.
    """

    def __init__(self, problem: Problem, max_cells: int, max_bytes: float = math.inf) -> None:
        self._problem = problem
        self._max_cells = max_cells
        self._max_bytes = max_bytes
        self._field = problem.terms[0].field
        weights = problem.points[2]
        peak = float(weights.sum()) * float(np.abs(self._field.coefficients).max())
        # Each weight, product and sum is rounded once, by 2^-24 of at most the peak.
        self._slack = (len(weights) + 16) * 2.0**-23 * peak
        self._levels = self._plan()
        self._at = -1
        self._nodes, self._offsets = np.zeros((0, 5), np.int64), np.zeros(1, np.int64)
        self._sums = np.zeros(0, np.float32)
        self.num_cells = 0

    @staticmethod
    def suits(problem: Problem) -> bool:
        """Whether there is one field, in the frame of the translations."""
        return len(problem.terms) == 1 and not problem.terms[0].is_inverse

    def advance(self, floor: float, is_over: Callable[[], bool] | None = None) -> bool:
        """Bound the next level around the cells above `floor`.

        False where that is not done: no level or no cell is left, or too many, or the time is up.
        """
        if self._at + 1 == len(self._levels):
            return False
        level = self._levels[self._at + 1]
        nodes = self._first_nodes() if self._at < 0 else self._children(floor, level)
        sizes = (nodes[:, 2] - nodes[:, 1]) * (nodes[:, 4] - nodes[:, 3])
        offsets = np.concatenate([[0], np.cumsum(sizes)])
        count = int(offsets[-1])
        if not 0 < count <= self._max_cells or self._num_bytes(level) > self._max_bytes:
            return False
        sums = np.empty(count, dtype=np.float32)
        if not self._add(level, nodes, offsets, sums, is_over):
            return False
        self._at += 1
        self._nodes, self._offsets, self._sums = nodes, offsets, sums
        self.num_cells += count
        return True

    def highest(self, count: int) -> FloatArray:
        """Boxes (K, 6) of the cells with the highest bounds."""
        cells = np.empty(min(count, len(self._sums)), dtype=np.int64)
        sweep_kernels.highest(self._sums, cells)
        return self._boxes_of(cells)

    def boxes(self, floor: float) -> tuple[FloatArray, FloatArray]:
        """Boxes (K, 6) of the cells above a floor and their bounds (K,), highest first."""
        cells = np.flatnonzero(self._sums > np.float64(floor))
        cells = cells[np.argsort(-self._sums[cells])]
        return self._boxes_of(cells), self._sums[cells].astype(np.float64)

    def _plan(self) -> list[_Level]:
        """Levels, the first as fine as is cheap, the last two cells of the field wide.

        Smaller ones do not pay: there the search's second bound is better than the first.
        """
        p = self._problem
        halves = []
        for k in range(_MAX_LEVELS):
            half_m = self._field.pitch_m * 2**k
            halves.append(half_m)
            num_slabs = max(1, math.ceil(math.pi * p.arm / (_TURN * half_m)))
            cols, rows = (math.ceil(side / half_m * (1.0 + 1e-12)) for side in p.window[4:])
            if num_slabs * rows * cols * p.points.shape[1] <= _FIRST_ADDITIONS:
                break
        low = p.window[1:3] - half_m * np.array([cols, rows])
        levels = []
        for k in reversed(range(len(halves))):
            delta, origin = math.pi / num_slabs, low + halves[k]
            levels.append(_Level(2**k, halves[k], delta, num_slabs, (rows, cols), origin))
            rows, cols = 2 * rows, 2 * cols
            if k and math.pi / num_slabs * p.arm > _TURN * halves[k - 1]:
                num_slabs *= 2
        return levels

    def _first_nodes(self) -> IntArray:
        level = self._levels[0]
        nodes = np.zeros((level.num_slabs, 5), dtype=np.int64)
        nodes[:, 0] = np.arange(level.num_slabs)
        nodes[:, [2, 4]] = level.shape
        return nodes

    def _children(self, floor: float, level: _Level) -> IntArray:
        turns = level.num_slabs // self._levels[self._at].num_slabs
        children = np.empty((turns * len(self._nodes), 5), dtype=np.int64)
        count = sweep_kernels.split_nodes(
            self._nodes, self._offsets, self._sums, floor, turns, children
        )
        return children[:count]

    def _add(
        self,
        level: _Level,
        nodes: IntArray,
        offsets: IntArray,
        sums: NDArray[np.float32],
        is_over: Callable[[], bool] | None,
    ) -> bool:
        """Fill the sums; False where the time was up before."""
        p = self._problem
        tables, pad = self._tables(level)
        size = max(1, int(_BATCH * len(nodes) / (p.points.shape[1] * len(sums))))
        for k in range(0, len(nodes), size):
            if is_over and is_over():
                return False
            sweep_kernels.add_slabs(
                p.points, p.frames[0], tables, level.base, pad, self._field.maximum, self._slack,
                self._first_theta(level), level.delta, level.origin,
                nodes[k : k + size], offsets[k : k + size + 1], sums,
            )  # fmt: skip
        return True

    def _tables(self, level: _Level) -> tuple[NDArray[np.float32], int]:
        """Tables of a level, and the bases before the first one of the field."""
        shape, pad = self._shape(level)
        tables = np.empty(shape, dtype=np.float32)
        sweep_kernels.fill_tables(self._field.windows[0], level.base, pad, tables)
        return tables, pad

    def _num_bytes(self, level: _Level) -> float:
        return 4.0 * math.prod(self._shape(level)[0])

    def _shape(self, level: _Level) -> tuple[tuple[int, ...], int]:
        radius = float(np.hypot(*self._problem.points[:2]).max())
        reach = 2.0 * level.delta * radius / level.half_m
        num = int(min(_MAX_SIZES, math.floor(reach + 1e-6) + 2))
        # Rectangles that end before the first base are outside, as are those after the last.
        pad = 2 * ((num + sweep_kernels.SMALLEST) // 2)
        bases = [(size - 1) // level.base + 1 for size in self._field.coefficients.shape]
        rows, cols = ((pad + size) // 2 + 1 for size in bases)
        return (num, num, 2, 2, rows, cols), pad

    def _boxes_of(self, cells: IntArray) -> FloatArray:
        """By their index in all sums."""
        level, boxes = self._levels[self._at], np.empty((len(cells), 6))
        sweep_kernels.fill_boxes(
            cells, self._nodes, self._offsets, self._first_theta(level), level.delta,
            level.origin, level.half_m, boxes,
        )  # fmt: skip
        return boxes

    def _first_theta(self, level: _Level) -> float:
        return float(self._problem.window[0]) - math.pi + level.delta
