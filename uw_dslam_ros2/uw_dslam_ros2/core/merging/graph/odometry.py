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
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId, Track

__all__ = ["Odometry"]

FloatArray = NDArray[np.float64]

_MAX_VARIANCE = 1e10
"""[m^2 or rad^2] Of one step: who knows less knows nothing, and sums with it stay exact."""


class Odometry:
    """Edges between each track's consecutive submaps, and what follows along them."""

    def __init__(self, submaps: Mapping[SubmapId, StoredSubmap], memory: Memory) -> None:
        self._submaps = submaps
        self._states: dict[Track, bytes] = {}
        self._row: dict[SubmapId, int] = {}
        self.edges: list[Edge] = []
        """The later submap is the source."""
        tracks: list[_TrackOdometry] = []
        for track, members in itertools.groupby(sorted(submaps), key=lambda i: i.track):
            ids = list(members)
            hasher = hashlib.blake2b(repr(track).encode(), digest_size=16)
            for submap_id in ids:
                hasher.update(b"%d" % submap_id.sequence + submaps[submap_id].fingerprint)
            state = hasher.digest()
            work = functools.partial(_TrackOdometry, ids, submaps, memory)
            tracks.append(memory.remember(("odometry", state), work))
            self._states[track] = state
            self._row |= {i: row for row, i in enumerate(ids, start=len(self._row))}
            self.edges += tracks[-1].edges
        self._poses = np.concatenate([track.poses for track in tracks] or [np.zeros((0, 3))])
        self._sums = np.concatenate([track.sums for track in tracks] or [np.zeros((0, 3, 3))])

    def state(self, track: Track) -> bytes:
        """All that is known of a track's submaps, in short: equal ones have equal submaps."""
        return self._states[track]

    def states(self) -> bytes:
        """That of all tracks."""
        return b"".join(self._states.values())

    def T_odom_submap(self, submap_id: SubmapId) -> SE2:  # noqa: N802 (notation of motions)
        """Pose in the run's odom frame, by its newest revision."""
        return self._submaps[submap_id].submap.T_odom_submap

    def covariances(self, targets: Sequence[SubmapId], sources: Sequence[SubmapId]) -> FloatArray:
        """Covariances (N, 3, 3) of ``T_target_source`` of N times two submaps of one track."""
        target = np.fromiter(map(self._row.__getitem__, targets), np.int64, len(targets))
        source = np.fromiter(map(self._row.__getitem__, sources), np.int64, len(sources))
        between = self._sums[np.maximum(target, source)] - self._sums[np.minimum(target, source)]
        turned = -self._poses[target, 2]
        return _carried(between, turned, _turned(self._poses[source, :2], turned))

    def spread(self, submap_id: SubmapId, members: Sequence[SubmapId]) -> FloatArray:
        """Mean covariance of the track's members around one of them: how far a map is bent."""
        own = [member for member in members if member.track == submap_id.track]
        mean: FloatArray = self.covariances([submap_id] * len(own), own).mean(axis=0)
        return mean


class _TrackOdometry:
    """Of one track, whose submaps do not change.

    Each step errs independently, by a shift and a turn about its end. Carried to the origin of
    the odometry frame such errors add up, so that the covariance over any steps is a difference
    of two sums, carried to where the source lies and seen in the target's frame.
    """

    def __init__(
        self, ids: Sequence[SubmapId], submaps: Mapping[SubmapId, StoredSubmap], memory: Memory
    ) -> None:
        self.edges: list[Edge] = []
        for before, after in itertools.pairwise(ids):
            ends = submaps[before], submaps[after]
            key = ("edge", before, after, ends[0].fingerprint, ends[1].fingerprint)
            self.edges.append(memory.remember(key, functools.partial(_edge, *ends)))
        self.poses = np.array([submaps[i].submap.T_odom_submap.as_array() for i in ids])
        # From the first one on: an odometry frame may be that of a map projection.
        self.poses[:, :2] -= self.poses[0, :2].copy()
        steps = np.array([edge.covariance for edge in self.edges]).reshape(-1, 3, 3)
        steps /= np.maximum(1.0, np.trace(steps, axis1=1, axis2=2) / _MAX_VARIANCE)[:, None, None]
        self.sums = np.zeros((len(ids), 3, 3))
        carried = _carried(steps, self.poses[:-1, 2], -self.poses[1:, :2])
        np.cumsum(carried, axis=0, out=self.sums[1:])


def _carried(covariances: FloatArray, yaw: FloatArray, arm: FloatArray) -> FloatArray:
    """Covariances (N, 3, 3) of motions: turned by (N,), then seen from the end of arms (N, 2)."""
    jacobian = np.zeros((len(yaw), 3, 3))
    cos, sin = np.cos(yaw), np.sin(yaw)
    jacobian[:, 0, 0], jacobian[:, 0, 1], jacobian[:, 0, 2] = cos, -sin, -arm[:, 1]
    jacobian[:, 1, 0], jacobian[:, 1, 1], jacobian[:, 1, 2] = sin, cos, arm[:, 0]
    jacobian[:, 2, 2] = 1.0
    return jacobian @ covariances @ np.swapaxes(jacobian, 1, 2)


def _turned(points: FloatArray, yaw: FloatArray) -> FloatArray:
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.column_stack(
        [cos * points[:, 0] - sin * points[:, 1], sin * points[:, 0] + cos * points[:, 1]]
    )


def _edge(before: StoredSubmap, after: StoredSubmap) -> Edge:
    earlier, later = before.submap, after.submap
    turn = np.eye(3)
    turn[:2, :2] = earlier.T_odom_submap.rotation().T
    # Submaps that are missing in between count as much as the one that is there.
    covariance = turn @ later.covariance @ turn.T * (later.sequence - earlier.sequence)
    T_before_after = earlier.T_odom_submap.inverse() @ later.T_odom_submap
    return Edge(later.submap_id, earlier.submap_id, T_before_after, covariance)
