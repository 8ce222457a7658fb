"""What a vehicle knows of its own submaps: their relative poses, and how sure it is of them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.merging.graph.submap_groups import StoredSubmap
from uw_dslam_ros2.core.merging.types import Edge
from uw_dslam_ros2.core.pose_graph import chained_covariance, invert_covariance
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId

__all__ = ["Odometry"]

FloatArray = NDArray[np.float64]


class Odometry:
    """Edges between each track's consecutive submaps, and what follows along them."""

    def __init__(self, submaps: Mapping[SubmapId, StoredSubmap]) -> None:
        self._submaps = submaps
        self.edges: list[Edge] = []
        """The later submap is the source."""
        self._step: dict[SubmapId, Edge] = {}
        self._previous: dict[SubmapId, SubmapId] = {}
        self._covariances: dict[tuple[SubmapId, SubmapId], FloatArray] = {}
        for before, after in itertools.pairwise(sorted(submaps)):
            if before.track == after.track:
                edge = self._edge(before, after)
                self.edges.append(edge)
                self._step[after] = edge
                self._previous[after] = before

    def T_odom_submap(self, submap_id: SubmapId) -> SE2:  # noqa: N802 (notation of motions)
        """Pose in the run's odom frame, by its newest revision."""
        return self._submaps[submap_id].submap.T_odom_submap

    def covariance(self, target: SubmapId, source: SubmapId) -> FloatArray:
        """Covariance (3, 3) of ``T_target_source`` of two submaps of one track."""
        if target == source:
            return np.zeros((3, 3))
        held = self._covariances.get((target, source))
        if held is not None:
            return held
        motion = self.T_odom_submap(target).inverse() @ self.T_odom_submap(source)
        if target > source:
            found = invert_covariance(self.covariance(source, target), motion.inverse())
        else:
            found = self._extended(target, source)
        self._covariances[target, source] = found
        return found

    def spread(self, submap_id: SubmapId, members: tuple[SubmapId, ...]) -> FloatArray:
        """Mean covariance of the track's members around one of them: how far a map is bent."""
        own = [member for member in members if member.track == submap_id.track]
        return np.mean([self.covariance(submap_id, member) for member in own], axis=0)

    def _extended(self, target: SubmapId, source: SubmapId) -> FloatArray:
        # Step by step from the target on: recursion would be as deep as the mission is long.
        chain = [source]
        while chain[-1] != target:
            chain.append(self._previous[chain[-1]])
        covariance, motion = np.zeros((3, 3)), SE2()
        for submap_id in reversed(chain[:-1]):
            step = self._step[submap_id]
            covariance = chained_covariance(
                motion, covariance, step.T_target_source, step.covariance
            )
            motion = motion @ step.T_target_source
            self._covariances[target, submap_id] = covariance
        return covariance

    def _edge(self, before: SubmapId, after: SubmapId) -> Edge:
        earlier, later = self._submaps[before].submap, self._submaps[after].submap
        turn = np.eye(3)
        turn[:2, :2] = earlier.T_odom_submap.rotation().T
        # Submaps that are missing in between count as much as the one that is there.
        covariance = turn @ later.covariance @ turn.T * (after.sequence - before.sequence)
        T_before_after = earlier.T_odom_submap.inverse() @ later.T_odom_submap
        return Edge(after, before, T_before_after, covariance)
