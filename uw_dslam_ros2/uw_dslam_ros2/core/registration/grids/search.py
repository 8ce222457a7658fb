"""Certified search of the objective of two maps over all of SE(2).

Boxes of poses are halved in all three directions, one size after the other, in sweeps at first
(`grid_sweep`). A box is dropped once its bound says that it cannot beat the best pose found by
more than the asked gap; what remains when the boxes are small is closed by a second-order bound.
The certificate holds for the continuous objective of `GridProblem`, not for a lattice of poses.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.registration.grids import kernels as grid_kernels
from uw_dslam_ros2.core.registration.grids.problem import GridProblem, PoseWindow
from uw_dslam_ros2.core.registration.grids.signed_field import (
    PAD,
    curvature_tables,
    layer_lookup,
    refined,
    value_tables,
)
from uw_dslam_ros2.core.registration.grids.sweep import GridSweep, Tables

__all__ = ["SearchLimits", "SearchOutcome", "search_poses", "whole_plane"]

FloatArray = NDArray[np.float64]
TableArray = NDArray[np.int16]
_ROOT_HALF_CELLS = 8.0
_FINE_FROM_HALF_CELLS = 2.0
_SMOOTH_FROM_HALF_CELLS = 0.25
_AGAIN_FROM_HALF_CELLS = 0.5
_SMALLEST_HALF_CELLS = 0.01
_CHUNK = 512  # 10 to 30 ms
_NUM_OPEN_POSES = 64
_NUM_PROMISING = 32
_LEAST_GAIN = 1e-7  # less is where the climb to the same pose ended
_OCTANTS = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))


@dataclass(frozen=True, slots=True)
class SearchLimits:
    """When to stop: relative gap, number of boxes bounded, and a question asked often.

    A tile of 8 x 8 boxes that a sweep bounds together counts as one: it takes a third of the time
    of a single box.
    """

    gap: float
    max_boxes: int
    should_stop: Callable[[], bool] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SearchOutcome:
    """Best pose (3,) and proven bounds on the objective's maximum over the window.

    ``open_poses`` (K, 3) are the middles of the most promising boxes that a stopped search left.
    """

    pose: FloatArray
    lower_bound: float
    upper_bound: float
    is_complete: bool
    is_stopped: bool  # by the question, not by the number of boxes
    num_boxes: int
    open_poses: FloatArray


def whole_plane(problem: GridProblem) -> PoseWindow:
    """All rotations, and all translations for which points of one side meet the other's field."""
    reach_points = _greatest_norm(problem.source_points)
    rows, cols = problem.source_field.coefficients.shape
    corners = np.array([[0, 0], [cols, 0], [cols, rows], [0, rows]]) - PAD - problem.center
    reach = max(reach_points, _greatest_norm(corners))
    num_rows, num_cols = problem.target_field.coefficients.shape
    size = np.array([num_cols, num_rows]) - 2.0 * PAD
    low = np.minimum(problem.target_points.min(axis=0), -1.0) - reach
    high = np.maximum(problem.target_points.max(axis=0), size) + reach
    half = 0.5 * (high - low)
    return PoseWindow(np.array([0.0, *(0.5 * (low + high))]), np.array([math.pi, *half]))


def _greatest_norm(points: FloatArray) -> float:
    return float(np.sqrt((points**2).sum(axis=1).max()))


def search_poses(
    problem: GridProblem,
    window: PoseWindow,
    start: FloatArray,
    limits: SearchLimits,
    report: Callable[[FloatArray, float, float, int, int], None] | None = None,
) -> SearchOutcome:
    """Bracket the objective's maximum over a window.

    Parameters
    ----------
    start : (3,)
        A pose inside the window to beat.
    report
        Called now and then with pose, lower bound, upper bound, number of boxes bounded, number of
        open boxes.
    """
    search = _Search(problem, start, limits, report)
    return search.run(window)


class _Search:
    def __init__(
        self,
        problem: GridProblem,
        start: FloatArray,
        limits: SearchLimits,
        report: Callable[[FloatArray, float, float, int, int], None] | None,
    ) -> None:
        self._problem = problem
        self._limits = limits
        self._report = report
        fields = (problem.target_field, problem.source_field)
        coarse = [value_tables(field) for field in fields]
        fine = [value_tables(refined(field)) for field in fields]
        curvature = [curvature_tables(field) for field in fields]
        self._tables = [Tables(1, *coarse), Tables(2, *fine)]
        self._coarse = self._kernel_arguments(coarse, curvature, 1.0)
        self._fine = self._kernel_arguments(fine, curvature, 2.0)
        self._pose = start
        self._best = problem.value(start)
        self._dropped = -math.inf  # greatest bound of a dropped box
        self._num_boxes = 0
        self._is_stopped = False
        self._open_poses = np.empty((0, 3))

    def _kernel_arguments(
        self, values: list[TableArray], curvature: list[TableArray], scale: float
    ) -> tuple[Any, ...]:
        problem = self._problem
        return (
            problem.source_points, problem.source_weights, problem.target_field.coefficients,
            values[0], curvature[0],
            problem.target_points, problem.target_weights, problem.source_field.coefficients,
            values[1], curvature[1],
            problem.center, float(PAD), scale, *layer_lookup(),
        )  # fmt: skip

    @property
    def _threshold(self) -> float:
        """Boxes below this cannot open the gap again."""
        return self._best / (1.0 - self._limits.gap) if self._best > 0.0 else self._best

    def run(self, window: PoseWindow) -> SearchOutcome:
        boxes, parents, half_rad, half = self._sweep(window)
        # What sweeps of the finest tables left, only the second bound can exclude.
        is_swept = half <= _SMOOTH_FROM_HALF_CELLS
        while len(boxes):
            kept = self._bound_level(boxes, parents, half_rad, half, is_swept)
            if kept is None:
                return self._outcome(False)
            boxes, bounds = kept
            if half < _SMALLEST_HALF_CELLS:
                self._dropped = max(self._dropped, float(bounds.max(initial=-math.inf)))
                break
            boxes, parents, half_rad, half = _octants(boxes, bounds, half_rad, half)
            is_swept = False
        return self._outcome(True)

    def _sweep(self, window: PoseWindow) -> tuple[FloatArray, FloatArray, float, float]:
        """Boxes that sweeps leave, what bounds them, and their half-widths."""
        sweep = GridSweep(self._problem, window, self._tables)
        while sweep.advance(
            self._threshold, self._limits.max_boxes - self._num_boxes, self._is_stopped_now
        ):
            self._num_boxes = sweep.num_tiles
            poses = sweep.promising(_NUM_PROMISING)
            values = grid_kernels.objective_at(poses, *self._problem.arguments)
            pose, value = self._problem.ascend(poses[values.argmax()])
            if value > self._best + _LEAST_GAIN:
                self._pose, self._best = pose, value
            self._dropped = max(self._dropped, sweep.greatest_below(self._threshold))
            self._tell(sweep.greatest, sweep.num_open(self._threshold))
        if sweep.num_tiles == 0:
            boxes, half_rad, half = _roots(window, self._problem.radius)
            return boxes, np.full(len(boxes), np.inf), half_rad, half
        boxes, bounds = sweep.boxes(self._threshold)
        if sweep.half <= _AGAIN_FROM_HALF_CELLS:  # there single boxes have better bounds
            return boxes, bounds, sweep.half_rad, sweep.half
        return _octants(boxes, bounds, sweep.half_rad, sweep.half)

    def _bound_level(
        self,
        boxes: FloatArray,
        parents: FloatArray,
        half_rad: float,
        half: float,
        is_swept: bool,
    ) -> tuple[FloatArray, FloatArray] | None:
        """Open boxes, promising ones first, and their bounds; None where the budget ran out."""
        is_smooth = half <= _SMOOTH_FROM_HALF_CELLS
        kept_boxes, kept_bounds = [np.empty((0, 3))], [np.empty(0)]
        num_kept, greatest = 0, -math.inf
        for first in range(0, len(boxes), _CHUNK):
            chunk = slice(first, first + _CHUNK)
            if self._is_out_of_budget():
                self._dropped = max(self._dropped, greatest, float(parents[first:].max()))
                self._leave(
                    np.concatenate([*kept_boxes, boxes[first:]]),
                    np.concatenate([*kept_bounds, parents[first:]]),
                )
                return None
            tables = self._fine if half <= _FINE_FROM_HALF_CELLS else self._coarse
            bounds, values = grid_kernels.bound_boxes(
                boxes[chunk], parents[chunk], half_rad, half, self._threshold,
                is_smooth, is_swept, *tables,
            )  # fmt: skip
            self._num_boxes += len(bounds)
            self._improve(boxes[chunk], values)
            is_open = bounds > self._threshold
            self._dropped = max(self._dropped, float(bounds[~is_open].max(initial=-math.inf)))
            kept_boxes.append(boxes[chunk][is_open])
            kept_bounds.append(bounds[is_open])
            num_kept += int(is_open.sum())
            greatest = max(greatest, float(bounds[is_open].max(initial=-math.inf)))
            if self._report is not None:
                upper = max(greatest, float(parents[first:].max()))
                self._tell(upper, num_kept + len(boxes) - first - len(bounds))
        bounds = np.concatenate(kept_bounds)
        order = np.argsort(-bounds, kind="stable")
        return np.concatenate(kept_boxes)[order], bounds[order]

    def _leave(self, boxes: FloatArray, bounds: FloatArray) -> None:
        """Keep the most promising of the boxes that nothing is known of, for others to look at."""
        order = np.argsort(-bounds, kind="stable")[:_NUM_OPEN_POSES]
        self._open_poses = boxes[order]

    def _improve(self, boxes: FloatArray, values: FloatArray) -> None:
        index = int(values.argmax())
        if values[index] > self._best:
            self._pose, self._best = self._problem.ascend(boxes[index])

    def _is_out_of_budget(self) -> bool:
        return self._is_stopped_now() or self._num_boxes >= self._limits.max_boxes

    def _is_stopped_now(self) -> bool:
        should_stop = self._limits.should_stop
        self._is_stopped = should_stop is not None and should_stop()
        return self._is_stopped

    def _tell(self, open_bound: float, num_open: int) -> None:
        if self._report is not None:
            upper = min(max(self._best, self._dropped, open_bound), 1.0)
            self._report(self._pose, self._best, upper, self._num_boxes, num_open)

    def _outcome(self, is_complete: bool) -> SearchOutcome:
        upper = min(max(self._best, self._dropped), 1.0)
        return SearchOutcome(
            self._pose, self._best, upper, is_complete, self._is_stopped, self._num_boxes,
            self._open_poses,
        )  # fmt: skip


def _octants(
    boxes: FloatArray, bounds: FloatArray, half_rad: float, half: float
) -> tuple[FloatArray, FloatArray, float, float]:
    """Boxes of half the size, what bounds them, and their half-widths."""
    half_rad, half = 0.5 * half_rad, 0.5 * half
    steps = _OCTANTS * (2.0 * half_rad, 2.0 * half, 2.0 * half)
    return (boxes[:, None, :] + steps).reshape(-1, 3), np.repeat(bounds, 8), half_rad, half


def _roots(window: PoseWindow, radius: float) -> tuple[FloatArray, float, float]:
    """Equal boxes that cover the window, and their half-widths; turns move the rim like shifts."""
    half = min(_ROOT_HALF_CELLS, float(window.half[1:].max()))
    num_x, num_y = (math.ceil(float(size) / half - 1e-9) for size in window.half[1:])
    num_theta = math.ceil(float(window.half[0]) * radius / half)
    half_rad = float(window.half[0]) / num_theta
    axes = [
        window.middle[axis] + step * (2.0 * np.arange(num) - (num - 1))
        for axis, (num, step) in enumerate(((num_theta, half_rad), (num_x, half), (num_y, half)))
    ]
    grid = np.meshgrid(*axes, indexing="ij")
    return np.column_stack([axis.ravel() for axis in grid]), half_rad, half
