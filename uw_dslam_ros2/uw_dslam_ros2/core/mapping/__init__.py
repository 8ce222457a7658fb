"""Occupancy mapping, SLAM inside one vehicle, submaps."""

from uw_dslam_ros2.core.mapping.config import (
    LoopConfig,
    MatchConfig,
    OccupancyConfig,
    SubmapConfig,
    VehicleMapperConfig,
)
from uw_dslam_ros2.core.mapping.submap import Submap, SubmapId
from uw_dslam_ros2.core.mapping.vehicle_mapper import VehicleMapper

__all__ = [
    "LoopConfig",
    "MatchConfig",
    "OccupancyConfig",
    "Submap",
    "SubmapConfig",
    "SubmapId",
    "VehicleMapper",
    "VehicleMapperConfig",
]
