"""Compiles the kernels of the merging."""

from __future__ import annotations

import numpy as np

from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging.graph.submap_groups import StoredSubmap, shared_area_m2
from uw_dslam_ros2.core.mosaic import fuse_maps
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap

__all__ = ["warm_up"]


def warm_up() -> None:
    """Run every kernel on tiny input."""
    values = np.array([[0, 100], [-1, 0]], dtype=np.int8)
    occupancy = OccupancyMap(GridSpec(0.1, 2, 2), values)
    fuse_maps(GridSpec(0.1, 1, 1), [(occupancy, SE2(0.0, 0.0, 0.5))], 8.0)
    stored = StoredSubmap.of(Submap("auv", 0, 0, True, 0, SE2(), np.zeros((3, 3)), occupancy), 4)
    shared_area_m2(stored, stored, SE2())
