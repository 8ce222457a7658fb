"""Two maps made ready for matching: points and signed fields of both on one common lattice."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.features.grid_filter import FilteredCells
from uw_dslam_ros2.core.features.walls import wall_points
from uw_dslam_ros2.core.registration.grids.signed_field import signed_field
from uw_dslam_ros2.core.registration.search.field import Field
from uw_dslam_ros2.core.registration.search.problem import Problem, Term
from uw_dslam_ros2.core.se2 import SE2, wrap_angle

__all__ = ["GridProblem", "PoseWindow", "build_problem"]

FloatArray = NDArray[np.float64]
FloatGrid = NDArray[np.float32]
_LONGEST_STEP_CELLS = 2.0  # of a climb


@dataclass(frozen=True, slots=True, eq=False)
class PoseWindow:
    """Box of poses: middle and half-widths, each (3,) [theta, t_x, t_y] in [rad, cells, cells]."""

    middle: FloatArray
    half: FloatArray

    def holds(self, pose: FloatArray) -> bool:
        """Whether a pose (3,) lies within."""
        offset = pose - self.middle
        offset[0] = wrap_angle(float(offset[0]))
        return bool(np.all(np.abs(offset) <= self.half))


@dataclass(frozen=True, eq=False)
class GridProblem:
    """The objective of matching two maps, both directions summed.

    ``f(theta, t) = sum_i w_i F_target(R (x_i - c) + t) + sum_j v_j F_source(R^T (y_j - t) + c)``,
    where the weights of each side sum to one half, so that 1 is a perfect match. Positions in
    working cells of ``resolution_m``, cell centres at whole numbers; ``source_points`` are
    relative to their mean c (``center``). A pose is [theta, t_x, t_y].
    """

    resolution_m: float
    source_points: FloatArray
    source_weights: FloatArray
    source_field: Field
    target_points: FloatArray
    target_weights: FloatArray
    target_field: Field
    center: FloatArray

    @functools.cached_property
    def radius(self) -> float:
        """Root mean square distance of the source's points from their mean."""
        square = (self.source_points**2).sum(axis=1)
        return max(math.sqrt(float(square.mean())) if len(square) else 0.0, 1.0)

    def terms(self, num_refinements: int = 0) -> list[Term]:
        """Both directions, with fields on lattices so many times twice as fine."""
        target_field, source_field = self.target_field, self.source_field
        source_field = replace(source_field, origin=source_field.origin - self.center)
        for _ in range(num_refinements):
            target_field, source_field = target_field.refined(), source_field.refined()
        return [
            Term(self.source_points, self.source_weights, target_field),
            Term(self.target_points, self.target_weights, source_field, is_inverse=True),
        ]

    @functools.cached_property
    def _sum(self) -> Problem:
        problem = Problem(self.terms(), np.zeros(2), np.zeros(2))
        problem.window[3:] = math.inf  # climbs go where they like
        return problem

    def value(self, pose: FloatArray) -> float:
        """Objective at a pose (3,)."""
        return self._sum.value_at(pose)[0]

    def gradient(self, pose: FloatArray) -> FloatArray:
        """Gradient (3,) of the objective [1 / rad, 1 / cell, 1 / cell]."""
        return self._sum.value_at(pose)[1]

    def point_places(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Where the points lie in the other map's cells: source's (M, 2), and target's (N, 2)."""
        turn = SE2(0.0, 0.0, float(pose[0])).rotation()
        behind = (self.target_points - pose[1:]) @ turn + self.center
        return self.source_points @ turn.T + pose[1:], behind

    def point_values(self, pose: FloatArray) -> FloatArray:
        """Each point's part of the objective (M + N,), the source's points first."""
        ahead, behind = self.point_places(pose)
        return np.concatenate(
            [
                self.source_weights * self.target_field.values(ahead),
                self.target_weights * self.source_field.values(behind),
            ]
        )

    def point_gradients(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Each point's part of the gradient (M + N, 3), and its place in target cells (M + N, 2).

        The source's points come first.
        """
        turn = SE2(0.0, 0.0, float(pose[0])).rotation()
        moved = self.source_points @ turn.T
        places = np.concatenate([moved + pose[1:], self.target_points])
        slopes = self.source_weights[:, None] * self.target_field.slopes(places[: len(moved)])
        back = (self.target_points - pose[1:]) @ turn
        behind = self.source_field.slopes(back + self.center)
        behind = self.target_weights[:, None] * (behind @ turn.T)
        pulls = np.concatenate([slopes, -behind])
        arms = np.concatenate([moved, self.target_points - pose[1:]])
        turns = pulls[:, 1] * arms[:, 0] - pulls[:, 0] * arms[:, 1]
        return np.column_stack([turns, pulls]), places

    def ascend(self, pose: FloatArray, max_steps: int = 40) -> tuple[FloatArray, float]:
        """Local maximum that a pose (3,) climbs to, and its value."""
        value, found = self._sum.ascend(pose, max_steps, _LONGEST_STEP_CELLS)
        return found, value

    def ascend_all(self, poses: FloatArray, max_steps: int = 40) -> tuple[FloatArray, FloatArray]:
        """Local maxima (K, 3) that poses (K, 3) climb to, and their values (K,)."""
        climbed = [self.ascend(pose, max_steps) for pose in poses]
        found, values = zip(*climbed, strict=True) if climbed else ((), ())
        return np.array(found).reshape(-1, 3), np.array(values)

    def motion_of(self, pose: FloatArray) -> SE2:
        """Pose (3,) in working cells to the motion between the grids' own axes [m]."""
        shift = SE2(0.5 * self.resolution_m, 0.5 * self.resolution_m, 0.0)
        turned = SE2(
            float(pose[1]) * self.resolution_m, float(pose[2]) * self.resolution_m, float(pose[0])
        )
        center = self.center * self.resolution_m
        return shift @ turned @ SE2(-center[0], -center[1], 0.0) @ shift.inverse()

    def pose_of(self, T_target_source: SE2) -> FloatArray:
        """Undo `motion_of`."""
        shift = SE2(0.5 * self.resolution_m, 0.5 * self.resolution_m, 0.0)
        center = self.center * self.resolution_m
        turned = shift.inverse() @ T_target_source @ shift @ SE2(center[0], center[1], 0.0)
        return np.array([turned.yaw, turned.x / self.resolution_m, turned.y / self.resolution_m])


def build_problem(
    source: FilteredCells,
    target: FilteredCells,
    *,
    stride: int,
    sigma_cells: float,
    free_penalty: float,
    max_points: int,
    distances: tuple[FloatGrid | None, FloatGrid | None] = (None, None),
) -> GridProblem:
    """Problem on a lattice ``stride`` times coarser than the cells of both sides.

    ``sigma_cells`` (of the working lattice) is the kernel of the walls. ``distances`` are
    `wall_distance` of both sides where they are known already.
    """
    sides = []
    for cells, distance in zip((source, target), distances, strict=True):
        points, weights = wall_points(cells, max_points, spacing_cells=float(stride))
        wide = signed_field(cells, sigma_cells * stride, free_penalty, stride, distance)
        sides.append((_in_strips(points / stride - 0.5, weights), wide))
    (source_points, source_weights), source_field = sides[0]
    (target_points, target_weights), target_field = sides[1]
    center = np.average(source_points, axis=0, weights=source_weights)
    return GridProblem(
        source.resolution_m * stride,
        np.ascontiguousarray(source_points - center), 0.5 * source_weights, source_field,
        target_points, 0.5 * target_weights, target_field, center,
    )  # fmt: skip


def _in_strips(points: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Neighbours one after the other, so that kernels find their field values in the cache."""
    order = np.lexsort((points[:, 0], np.floor(points[:, 1] / 8.0)))
    return np.ascontiguousarray(points[order]), np.ascontiguousarray(weights[order])
