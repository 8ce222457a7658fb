"""Hand-made places for tests of nodes, with messages of the sensors that look at them."""

import numpy as np

from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["room_map", "room_submap"]


def room_map(resolution_m=0.1, T_frame_grid=SE2()):
    """A closed room with an odd corner: 12 m x 8 m, free inside, walls known."""
    values = np.full((90, 130), -1, np.int8)
    values[5:85, 5:125] = 0
    values[5:85, [5, 124]] = values[[5, 84], 5:125] = 100
    values[5:40, 80] = values[40, 80:125] = 100
    values[60:62, 20:40] = 100
    return OccupancyMap(GridSpec(resolution_m, 90, 130, T_frame_grid), values)


def room_submap(vehicle_id, sequence=0, revision=0, T_room_submap=SE2(), T_odom_submap=SE2()):
    """A vehicle's submap of the whole room, whose frame lies at `T_room_submap` in it."""
    from uw_dslam_ros2.core.submap import Submap

    stamps_ns = np.arange(1, 4, dtype=np.int64) * 1_000_000_000 * (sequence + 1)
    return Submap(
        vehicle_id=vehicle_id,
        sequence=sequence,
        revision=revision,
        is_final=True,
        stamp_ns=int(stamps_ns[-1]),
        T_odom_submap=T_odom_submap,
        covariance=np.diag([0.01, 0.01, 0.001]),
        grid=room_map(T_frame_grid=T_room_submap.inverse()),
        trajectory=np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [1.0, 0.0, 0.1]]),
        trajectory_stamp_ns=stamps_ns,
    )
