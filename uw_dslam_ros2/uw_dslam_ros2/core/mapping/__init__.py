"""Occupancy mapping, SLAM inside one vehicle, submaps."""

from uw_dslam_ros2.core.mapping.config import (
    LoopConfig,
    MatchConfig,
    OccupancyConfig,
    SubmapConfig,
    VehicleMapperConfig,
)
from uw_dslam_ros2.core.mapping.runs import RunBreak, VehicleRuns
from uw_dslam_ros2.core.mapping.vehicle_mapper import VehicleMapper
from uw_dslam_ros2.core.submap import Submap, SubmapId

__all__ = [
    "LoopConfig",
    "MatchConfig",
    "OccupancyConfig",
    "RunBreak",
    "Submap",
    "SubmapConfig",
    "SubmapId",
    "VehicleMapper",
    "VehicleMapperConfig",
    "VehicleRuns",
]
