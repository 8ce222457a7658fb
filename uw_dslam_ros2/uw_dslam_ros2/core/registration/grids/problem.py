"""Two maps made ready for matching: points and signed fields of both on one common lattice."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.features.grid_filter import CellEvidence
from uw_dslam_ros2.core.features.walls import wall_points
from uw_dslam_ros2.core.registration.grids import kernels as grid_kernels
from uw_dslam_ros2.core.registration.grids.signed_field import PAD, SignedField, signed_field
from uw_dslam_ros2.core.se2 import SE2, wrap_angle

__all__ = ["GridProblem", "PoseWindow", "build_problem"]

FloatArray = NDArray[np.float64]
FloatGrid = NDArray[np.float32]


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


@dataclass(frozen=True, slots=True, eq=False)
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
    source_field: SignedField
    target_points: FloatArray
    target_weights: FloatArray
    target_field: SignedField
    center: FloatArray
    radius: float = field(init=False)  # of the source's points about their mean, root mean square

    def __post_init__(self) -> None:
        square = (self.source_points**2).sum(axis=1)
        radius = math.sqrt(float(square.mean())) if len(square) else 0.0
        object.__setattr__(self, "radius", max(radius, 1.0))

    @property
    def arguments(self) -> tuple[Any, ...]:
        """Arguments of the kernels after the pose."""
        return (
            self.source_points, self.source_weights, self.target_field.coefficients,
            self.target_points, self.target_weights, self.source_field.coefficients,
            self.center, float(PAD),
        )  # fmt: skip

    def value(self, pose: FloatArray) -> float:
        """Objective at a pose (3,)."""
        return float(grid_kernels.objective(pose, *self.arguments)[0])

    def ascend(self, pose: FloatArray, max_steps: int = 40) -> tuple[FloatArray, float]:
        """Local maximum that a pose (3,) climbs to, and its value."""
        found, values = self.ascend_all(np.asarray(pose)[None, :], max_steps)
        return found[0], float(values[0])

    def ascend_all(self, poses: FloatArray, max_steps: int = 40) -> tuple[FloatArray, FloatArray]:
        """Local maxima (K, 3) that poses (K, 3) climb to, and their values (K,)."""
        starts = np.array(poses, dtype=np.float64, order="C")
        found, values = grid_kernels.ascend_all(starts, self.radius, max_steps, *self.arguments)
        return found, values

    def to_motion(self, pose: FloatArray) -> SE2:
        """Pose (3,) in working cells to the motion between the grids' own axes [m]."""
        shift = SE2(0.5 * self.resolution_m, 0.5 * self.resolution_m, 0.0)
        turned = SE2(
            float(pose[1]) * self.resolution_m, float(pose[2]) * self.resolution_m, float(pose[0])
        )
        center = self.center * self.resolution_m
        return shift @ turned @ SE2(-center[0], -center[1], 0.0) @ shift.inverse()

    def to_pose(self, T_target_source: SE2) -> FloatArray:
        """Undo `to_motion`."""
        shift = SE2(0.5 * self.resolution_m, 0.5 * self.resolution_m, 0.0)
        center = self.center * self.resolution_m
        turned = shift.inverse() @ T_target_source @ shift @ SE2(center[0], center[1], 0.0)
        return np.array([turned.yaw, turned.x / self.resolution_m, turned.y / self.resolution_m])


def build_problem(
    source: CellEvidence,
    target: CellEvidence,
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
