"""Submaps: what a vehicle gives away of its map."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["Submap", "SubmapId"]

SubmapId = tuple[str, int]
"""``(vehicle_id, sequence)``."""


@dataclass(frozen=True, slots=True, eq=False)
class Submap:
    """One piece of one vehicle's map, short enough to be rigid; as in ``uw_dslam_msgs/Submap``.

    ``T_odom_submap`` places the submap's frame in the vehicle's odom frame; ``covariance`` (3,
    3), order x, y, yaw, is that of the pose relative to the vehicle's previous submap (to odom's
    origin for the first). ``points`` (N, 2) [m] are features in the submap's frame.
    ``trajectory`` (K, 3) [x, y, yaw] of base_link in the submap's frame at times
    ``trajectory_stamp_ns`` (K,).
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

    @property
    def submap_id(self) -> SubmapId:
        """The key under which revisions replace each other."""
        return self.vehicle_id, self.sequence
