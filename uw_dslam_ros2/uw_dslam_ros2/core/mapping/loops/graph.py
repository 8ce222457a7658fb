"""The pose graph over one vehicle's submaps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.pose_graph import Edge, Marginals, chained_covariance, solve_graph
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["SubmapGraph"]

FloatArray = NDArray[np.float64]
_INLIER_PROBABILITY = 0.99
# Information of nothing, a kilometre: a loop may say nothing of a direction.
_NOTHING = 1e-6 * np.eye(3)


class SubmapGraph:
    """Submaps as poses, odometry and loops as edges; a loop may be wrong, and is left out then."""

    def __init__(self) -> None:
        self._odometry: list[Edge[int]] = []
        self._loops: dict[tuple[int, int], Edge[int]] = {}
        self._believed: list[Edge[int]] = []
        self._first_covariance = np.zeros((3, 3))
        self._poses: list[SE2] = []
        self._marginals: Marginals[int] | None = None

    @property
    def poses(self) -> list[SE2]:
        """``T_odom_submap`` of every submap."""
        return list(self._poses)

    @property
    def num_loops(self) -> int:
        """Loops, believed or not."""
        return len(self._loops)

    @property
    def num_loops_believed(self) -> int:
        """Loops that act on the poses."""
        return len(self._believed)

    def add_first(self, T_odom_submap: SE2, covariance: FloatArray) -> None:
        """Begin with the first submap, which stays where it is; covariance (3, 3) in odom."""
        self._poses = [T_odom_submap]
        self._first_covariance = covariance

    def add_next(self, T_previous_new: SE2, covariance: FloatArray) -> None:
        """Append a submap by odometry; covariance (3, 3) in the previous submap's frame."""
        new = len(self._poses)
        self._odometry.append(Edge(new, new - 1, T_previous_new, covariance))
        self._poses.append(self._poses[-1] @ T_previous_new)
        self._marginals = None

    def add_loop(
        self, target: int, source: int, T_target_source: SE2, information: FloatArray
    ) -> None:
        """A match between two submaps, believed until `optimize` says otherwise.

        Information (3, 3) is in the target frame.
        """
        covariance = np.linalg.inv(information + _NOTHING)
        loop = Edge(source, target, T_target_source, covariance)
        self._loops[target, source] = loop
        self._believed.append(loop)
        self._marginals = None

    def covariance(self) -> FloatArray:
        """Covariance (3, 3) of the newest submap's pose in odom, order x, y, yaw."""
        T_first_newest = self.relative(0, len(self._poses) - 1)
        return chained_covariance(self._poses[0], self._first_covariance, *T_first_newest)

    def relative(self, target: int, source: int) -> tuple[SE2, FloatArray]:
        """``T_target_source`` now and its covariance (3, 3) in the target frame."""
        if self._marginals is None:
            edges = [*self._odometry, *self._believed]
            self._marginals = Marginals(0, edges, dict(enumerate(self._poses)))
        T_target_source = self._poses[target].inverse() @ self._poses[source]
        return T_target_source, self._marginals.covariance(target, source)

    def optimize(self) -> bool:
        """Solve; True if any submap moved by more than a hundredth of a metre or milliradian."""
        before, loops = self._poses, list(self._loops.values())
        solution = solve_graph(
            0, self._odometry, loops, dict(enumerate(before)), _INLIER_PROBABILITY
        )
        self._poses = list(solution.T_anchor_pose.values())
        agreeing = zip(loops, solution.is_inlier, strict=True)
        self._believed = [loop for loop, agrees in agreeing if agrees]
        self._marginals = None
        distances = [a.distance_to(b) for a, b in zip(self._poses, before, strict=True)]
        return any(metres > 0.01 or radians > 0.001 for metres, radians in distances)
