"""What a vehicle knows of its own submaps: their relative poses, and how sure it is of them."""

from __future__ import annotations

import functools
import hashlib
import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.merging.graph.memory import Memory
from uw_dslam_ros2.core.merging.graph.submap_groups import StoredSubmap
from uw_dslam_ros2.core.merging.types import Edge
from uw_dslam_ros2.core.pose_graph import chained_covariance, invert_covariance
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId, Track

__all__ = ["Odometry"]

FloatArray = NDArray[np.float64]

_MAX_COVARIANCES = 100_000
"""Kept of one track: all pairs of some three hundred submaps."""


class Odometry:
    """Edges between each track's consecutive submaps, and what follows along them."""

    def __init__(self, submaps: Mapping[SubmapId, StoredSubmap], memory: Memory) -> None:
        self._submaps = submaps
        self._states: dict[Track, bytes] = {}
        self._tracks: dict[Track, _TrackOdometry] = {}
        self.edges: list[Edge] = []
        """The later submap is the source."""
        for track, members in itertools.groupby(sorted(submaps), key=lambda i: i.track):
            ids = list(members)
            hasher = hashlib.blake2b(repr(track).encode(), digest_size=16)
            for submap_id in ids:
                hasher.update(b"%d" % submap_id.sequence + submaps[submap_id].fingerprint)
            state = hasher.digest()
            work = functools.partial(_TrackOdometry, ids, submaps, memory)
            own = memory.remember(("odometry", state), work)
            self._states[track], self._tracks[track] = state, own
            self.edges += own.edges

    def state(self, track: Track) -> bytes:
        """All that is known of a track's submaps, in short: equal ones have equal submaps."""
        return self._states[track]

    def states(self) -> bytes:
        """That of all tracks."""
        return b"".join(self._states.values())

    def T_odom_submap(self, submap_id: SubmapId) -> SE2:  # noqa: N802 (notation of motions)
        """Pose in the run's odom frame, by its newest revision."""
        return self._submaps[submap_id].submap.T_odom_submap

    def covariance(self, target: SubmapId, source: SubmapId) -> FloatArray:
        """Covariance (3, 3) of ``T_target_source`` of two submaps of one track."""
        return self._tracks[target.track].covariance(target, source)

    def spread(self, submap_id: SubmapId, members: Sequence[SubmapId]) -> FloatArray:
        """Mean covariance of the track's members around one of them: how far a map is bent."""
        track = submap_id.track
        own = [member for member in members if member.track == track]
        return np.mean([self.covariance(submap_id, member) for member in own], axis=0)


class _TrackOdometry:
    """Of one track, whose submaps do not change."""

    def __init__(
        self, ids: Sequence[SubmapId], submaps: Mapping[SubmapId, StoredSubmap], memory: Memory
    ) -> None:
        self._pose = {i: submaps[i].submap.T_odom_submap for i in ids}
        self._place = {submap_id: place for place, submap_id in enumerate(ids)}
        self._covariances: dict[tuple[SubmapId, SubmapId], FloatArray] = {}
        self.edges: list[Edge] = []
        for before, after in itertools.pairwise(ids):
            ends = submaps[before], submaps[after]
            key = ("edge", before, after, ends[0].fingerprint, ends[1].fingerprint)
            self.edges.append(memory.remember(key, functools.partial(_edge, *ends)))

    def covariance(self, target: SubmapId, source: SubmapId) -> FloatArray:
        if target == source:
            return np.zeros((3, 3))
        held = self._covariances.get((target, source))
        if held is not None:
            return held
        if len(self._covariances) > _MAX_COVARIANCES:
            self._covariances.clear()
        if target > source:
            motion = self._pose[target].inverse() @ self._pose[source]
            found = invert_covariance(self.covariance(source, target), motion.inverse())
        else:
            found = self._extended(target, source)
        self._covariances[target, source] = found
        return found

    def _extended(self, target: SubmapId, source: SubmapId) -> FloatArray:
        # Step by step from the target on: recursion would be as deep as the mission is long.
        covariance, motion = np.zeros((3, 3)), SE2()
        for step in self.edges[self._place[target] : self._place[source]]:
            covariance = chained_covariance(
                motion, covariance, step.T_target_source, step.covariance
            )
            motion = motion @ step.T_target_source
            self._covariances[target, step.source] = covariance
        return covariance


def _edge(before: StoredSubmap, after: StoredSubmap) -> Edge:
    earlier, later = before.submap, after.submap
    turn = np.eye(3)
    turn[:2, :2] = earlier.T_odom_submap.rotation().T
    # Submaps that are missing in between count as much as the one that is there.
    covariance = turn @ later.covariance @ turn.T * (later.sequence - earlier.sequence)
    T_before_after = earlier.T_odom_submap.inverse() @ later.T_odom_submap
    return Edge(later.submap_id, earlier.submap_id, T_before_after, covariance)
