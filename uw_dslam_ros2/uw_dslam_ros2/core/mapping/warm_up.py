"""Compile the mapping kernels."""

from __future__ import annotations

import numpy as np

from uw_dslam_ros2.core.mapping.config import VehicleMapperConfig
from uw_dslam_ros2.core.mapping.drawing.occupancy import GrowingGrid
from uw_dslam_ros2.core.mapping.scans.matcher import LikelihoodField, Prior, match_points
from uw_dslam_ros2.core.mosaic import fuse_maps
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar.detect import detections_from_points

__all__ = ["warm_up"]


def warm_up() -> None:
    """Run every kernel on a tiny scene."""
    config = VehicleMapperConfig()
    points = np.column_stack([np.full(9, 3.0), np.linspace(-1.0, 1.0, 9)])
    grid = GrowingGrid(config.occupancy)
    grid.add(detections_from_points(0, points), SE2())
    fuse_maps(grid.trimmed().spec, [(grid.trimmed().compressed(), SE2(0.1, 0.0, 0.1))], 4.0)
    field = LikelihoodField(points, np.ones(9), 0.2)
    match_points([field], points, np.ones(9), Prior(SE2(), np.eye(3) * 0.01), (0.2, 0.2, 0.1), 0.1)
