"""Where vehicles went, in the frame that their submaps share."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.merging.graph.submap_groups import StoredSubmap
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId

__all__ = ["Trajectory", "trajectories_of"]

Trajectory = tuple[NDArray[np.int64], NDArray[np.float64]]
"""Stamps (K,) [ns] and poses (K, 3) [x, y, yaw]."""


def trajectories_of(
    submaps: Mapping[SubmapId, StoredSubmap], T_map_submap: Mapping[SubmapId, SE2]
) -> dict[str, Trajectory]:
    """Of each vehicle, in "map"; all its runs that have a place there are in it."""
    parts: dict[str, list[Trajectory]] = {}
    for submap_id in sorted(T_map_submap):
        submap = submaps[submap_id].submap
        if len(submap.trajectory):
            poses = _moved(T_map_submap[submap_id], submap.trajectory)
            parts.setdefault(submap_id.vehicle_id, []).append((submap.trajectory_stamp_ns, poses))
    return {vehicle: _by_time(pieces) for vehicle, pieces in parts.items()}


def _moved(motion: SE2, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    moved = np.empty_like(poses)
    moved[:, :2] = motion.apply(poses[:, :2])
    moved[:, 2] = (poses[:, 2] + motion.yaw + math.pi) % (2.0 * math.pi) - math.pi
    return moved


def _by_time(pieces: Iterable[Trajectory]) -> Trajectory:
    stamps, poses = (np.concatenate(part) for part in zip(*pieces, strict=True))
    # A ping at the seam belongs to two submaps: the later one's word counts.
    order = np.argsort(stamps, kind="stable")
    stamps, poses = stamps[order], poses[order]
    is_last = np.append(np.diff(stamps) > 0, True)
    return stamps[is_last], poses[is_last]
