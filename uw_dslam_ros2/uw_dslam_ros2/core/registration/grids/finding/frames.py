"""Between the frames that callers speak of and the grids' own axes, which the search knows."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.grid import GridSpec
from uw_dslam_ros2.core.registration.grids.finding.search import whole_plane
from uw_dslam_ros2.core.registration.grids.problem import GridProblem, PoseWindow
from uw_dslam_ros2.core.registration.result import PriorWindow
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["GridFrames"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class GridFrames:
    """The grids of a match in their frames."""

    source: GridSpec
    target: GridSpec

    def to_grids(self, T_target_source: SE2) -> SE2:
        """Motion between frames to motion between the grids' own axes."""
        return self.target.T_frame_grid.inverse() @ T_target_source @ self.source.T_frame_grid

    def to_frames(self, T_target_source: SE2) -> SE2:
        """Undo `to_grids`."""
        return self.target.T_frame_grid @ T_target_source @ self.source.T_frame_grid.inverse()

    def source_points(self, cells: FloatArray, problem: GridProblem) -> FloatArray:
        """Points (N, 2) in a problem's cells of the source to metres in its frame."""
        return self.source.T_frame_grid.apply((cells + 0.5) * problem.resolution_m)

    def target_points(self, cells: FloatArray, problem: GridProblem) -> FloatArray:
        """Points (N, 2) in a problem's cells of the target to metres in its frame."""
        return self.target.T_frame_grid.apply((cells + 0.5) * problem.resolution_m)

    def window(self, problem: GridProblem, prior: PriorWindow | None) -> PoseWindow:
        """Poses that a prior allows, or all."""
        plane = whole_plane(problem)
        if prior is None:
            return plane
        middle = problem.pose_of(self.to_grids(prior.T_target_source))
        half_rad = min(prior.half_width_rad, math.pi)
        # The prior speaks of where the source's frame lands, the pose of where its centre does.
        T_grid_frame = self.source.T_frame_grid.inverse()
        origin = np.array([T_grid_frame.x, T_grid_frame.y]) / problem.resolution_m - 0.5
        arm = float(np.hypot(*(problem.center - origin)))
        yaw = self.target.T_frame_grid.yaw
        spread = (abs(math.cos(yaw)) + abs(math.sin(yaw))) * prior.half_width_m
        half = spread / problem.resolution_m + 2.0 * arm * math.sin(0.5 * half_rad)
        low = np.maximum(middle[1:] - half, plane.middle[1:] - plane.half[1:])
        high = np.minimum(middle[1:] + half, plane.middle[1:] + plane.half[1:])
        high = np.maximum(high, low + 1.0)
        return PoseWindow(
            np.array([middle[0], *(0.5 * (low + high))]),
            np.array([half_rad, *(0.5 * (high - low))]),
        )

    def covariance(
        self, problem: GridProblem, pose_covariance: FloatArray, T_target_source: SE2
    ) -> FloatArray:
        """Covariance (3, 3) of a motion between frames [m, m, rad], from that of its pose."""
        center = self.source_points(problem.center[None, :], problem)[0]
        arm = T_target_source.rotation() @ center
        jacobian = np.zeros((3, 3))
        jacobian[:2, 1:] = self.target.T_frame_grid.rotation() * problem.resolution_m
        jacobian[:2, 0] = (arm[1], -arm[0])  # d(t - R c) / d theta
        jacobian[2, 0] = 1.0
        return jacobian @ pose_covariance @ jacobian.T
