"""Submaps: what a vehicle gives away of its map."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["MAX_RUN_ID", "Submap", "SubmapId", "Track", "track_name"]

MAX_RUN_ID = 2**32 - 1


class Track(NamedTuple):
    """One run of one vehicle: all submaps that hang together by its odometry.

    A mapper that starts again has a new odometry frame; two runs of one vehicle are joined by
    registration only, like two vehicles.
    """

    vehicle_id: str
    run_id: int
    """Drawn at random when the mapper starts, 1 .. 2^32 - 1; 0 where it is not known."""


def track_name(track: Track) -> str:
    """As people read it: the vehicle, and from the second run on ``auv_1#2``."""
    vehicle_id, run_id = track
    return vehicle_id if run_id <= 1 else f"{vehicle_id}#{run_id}"


class SubmapId(NamedTuple):
    """The key under which revisions of a submap replace each other."""

    vehicle_id: str
    run_id: int
    sequence: int

    @property
    def track(self) -> Track:
        """The run that it belongs to."""
        return Track(self.vehicle_id, self.run_id)

    def __str__(self) -> str:
        """As people read it: ``auv_1/3``, and from the second run on ``auv_1#2/3``."""
        return f"{track_name(self.track)}/{self.sequence}"

    @property
    def stable_name(self) -> str:
        """For digests; without a run it is what it was before there were runs."""
        own = (self.vehicle_id, self.sequence)
        return repr(own if self.run_id == 0 else (*own, self.run_id))


@dataclass(frozen=True, slots=True, eq=False)
class Submap:
    """One piece of one vehicle's map, short enough to be rigid; as in ``uw_dslam_msgs/Submap``.

    ``T_odom_submap`` places the submap's frame in the run's odom frame; ``covariance`` (3,
    3), order x, y, yaw, is that of the pose relative to the run's previous submap (to odom's
    origin for the first). ``points`` (N, 2) [m] are features in the submap's frame.
    ``trajectory`` (K, 3) [x, y, yaw] of base_link in the submap's frame at times
    ``trajectory_stamp_ns`` (K,). ``run_id`` is 0 where it is not known.
    """

    vehicle_id: str
    sequence: int
    revision: int
    is_final: bool
    stamp_ns: int
    T_odom_submap: SE2
    covariance: NDArray[np.float64]
    grid: OccupancyMap
    points: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 2)))
    trajectory: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))
    trajectory_stamp_ns: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    run_id: int = 0

    @property
    def submap_id(self) -> SubmapId:
        """The key under which revisions replace each other."""
        return SubmapId(self.vehicle_id, self.run_id, self.sequence)
