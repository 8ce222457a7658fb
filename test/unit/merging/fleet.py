"""Shared by the tests of the merging."""

import math

from uw_dslam_ros2.core.merging import MapQueue
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.maps.fleets import Fleet, line_of_poses, make_walls


def three_vehicles(seed: int = 0, num_submaps: int = 4) -> Fleet:
    """Three parallel lines, overlapping with their neighbours; the outer two hardly meet."""
    fleet = Fleet(make_walls(120.0, 0.5, seed))
    fleet.add_vehicle("auv_1", line_of_poses(SE2(30.0, 40.0), num_submaps, 8.0), seed + 1)
    back = SE2(22.0 + 8.0 * num_submaps, 52.0, math.pi)
    fleet.add_vehicle("auv_2", line_of_poses(back, num_submaps, 8.0), seed + 2)
    fleet.add_vehicle("auv_3", line_of_poses(SE2(30.0, 64.0, 0.1), num_submaps, 8.0), seed + 3)
    return fleet


def map_bytes(queue: MapQueue) -> bytes:
    """Everything that the global map is, as bytes."""
    fused = queue.global_map()
    return b"" if fused is None else repr(fused.spec).encode() + fused.values.tobytes()
