"""Compile the kernels of the registration of grids, with the types they are called with."""

from __future__ import annotations

import numpy as np

from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.registration.grids.config import GridRegistrationConfig
from uw_dslam_ros2.core.registration.grids.register import register_grids

__all__ = ["warm_up"]


def warm_up() -> None:
    """Match two small rooms."""
    values = np.zeros((40, 48), np.int8)
    values[4, 4:40], values[4:30, 4], values[30, 4:20], values[12:20, 30] = 100, 100, 100, 100
    room = OccupancyMap(GridSpec(0.1, *values.shape), values)
    register_grids(room, room, GridRegistrationConfig(max_boxes=30_000))
