"""Certified search of the objective of two maps: windows of poses, and the engine's terms."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.registration.grids.problem import GridProblem, PoseWindow
from uw_dslam_ros2.core.registration.grids.signed_field import PAD
from uw_dslam_ros2.core.registration.result import Progress
from uw_dslam_ros2.core.registration.search.branch_and_bound import maximise
from uw_dslam_ros2.core.registration.search.outcome import SearchOutcome, SearchSettings
from uw_dslam_ros2.core.registration.search.problem import Problem

__all__ = ["search_poses", "whole_plane"]

FloatArray = NDArray[np.float64]
_NUM_REFINEMENTS = 2  # of the fields' lattices, for closer bounds
_MAX_CELLS = 600_000  # of a field refined
_RIM_CELLS = 32.0


def whole_plane(problem: GridProblem) -> PoseWindow:
    """All rotations, and all translations for which points of one side meet the other's field.

    And some more, by a rim: the verdict counts poses, and was fitted to counts that include it.
    """
    source_size, target_size = (
        np.array(field.coefficients.shape)[::-1] - 2.0 * PAD
        for field in (problem.source_field, problem.target_field)
    )
    farthest = _RIM_CELLS + np.maximum(problem.center, source_size - problem.center)
    farthest_point = math.sqrt(float((problem.source_points**2).sum(axis=1).max()))
    reach = max(farthest_point, float(np.hypot(*farthest)))
    low = np.minimum(problem.target_points.min(axis=0), -1.0) - reach
    high = np.maximum(problem.target_points.max(axis=0), target_size) + reach
    half = 0.5 * (high - low)
    return PoseWindow(np.array([0.0, *(0.5 * (low + high))]), np.array([math.pi, *half]))


def search_poses(
    problem: GridProblem,
    window: PoseWindow,
    start: FloatArray,
    settings: SearchSettings,
    *,
    clock: Callable[[], float] | None = None,
    progress: Callable[[Progress], None] | None = None,
    is_cancelled: Callable[[], bool] | None = None,
) -> SearchOutcome:
    """Bracket the objective's maximum over a window.

    ``start`` (3,) is a pose inside the window to beat. The outcome's motions are those of poses:
    from the source's points, which are about their mean, to the target's cells.
    """
    num_cells = max(f.coefficients.size for f in (problem.source_field, problem.target_field))
    num_refinements = 0
    while (
        num_refinements < _NUM_REFINEMENTS and 4 ** (num_refinements + 1) * num_cells <= _MAX_CELLS
    ):
        num_refinements += 1
    fine = Problem(problem.terms(num_refinements), np.zeros(2), np.zeros(2))
    # Of the window, where anything can meet; beyond, the objective is zero.
    low = np.maximum(window.middle - window.half, fine.window[:3] - fine.window[3:])[1:]
    high = np.minimum(window.middle + window.half, fine.window[:3] + fine.window[3:])[1:]
    fine.window[:] = np.concatenate([window.middle, window.half])
    if (low < high).all():
        fine.window[1:3], fine.window[4:] = 0.5 * (low + high), 0.5 * (high - low)
    return maximise(
        fine, settings, start=start, clock=clock, progress=progress, is_cancelled=is_cancelled
    )
