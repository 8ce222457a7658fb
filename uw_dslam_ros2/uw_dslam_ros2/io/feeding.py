"""What a sensor said, handed to a vehicle mapper with the place where the sensor sits."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.mapping import VehicleMapper
from uw_dslam_ros2.core.mounting import planar_mount
from uw_dslam_ros2.core.submap import Submap
from uw_dslam_ros2.io.events import (
    DepthEvent,
    ImageEvent,
    ImuEvent,
    PointsEvent,
    ScanEvent,
    VelocityEvent,
)

__all__ = ["SensorEvent", "feed"]

SensorEvent = ImageEvent | ImuEvent | VelocityEvent | DepthEvent | ScanEvent | PointsEvent


def feed(
    mapper: VehicleMapper, event: SensorEvent, T_base_sensor: NDArray[np.float64]
) -> list[Submap]:
    """Give one event to a mapper; return the submaps that it made or changed.

    Raises
    ------
    InvalidInputError
        If the instrument's forward axis points up or down, so that it has no place in the plane.
    """
    stamp_ns = event.stamp_ns
    match event:
        case ImageEvent():
            return mapper.add_image(event.image, planar_mount(T_base_sensor, "z"))
        case ScanEvent():
            mount = planar_mount(T_base_sensor)
            return mapper.add_scan(
                stamp_ns, event.angles_rad, event.ranges_m, event.range_max_m, mount
            )
        case PointsEvent():
            return mapper.add_points(stamp_ns, event.points, planar_mount(T_base_sensor))
        case VelocityEvent():
            mount = planar_mount(T_base_sensor)
            return mapper.add_velocity(stamp_ns, event.velocity_m_s, event.covariance, mount)
        case ImuEvent():
            return _feed_imu(mapper, event, planar_mount(T_base_sensor).yaw)
        case DepthEvent():
            mapper.add_depth(stamp_ns, event.depth_m)
    return []


def _feed_imu(mapper: VehicleMapper, event: ImuEvent, mount_yaw_rad: float) -> list[Submap]:
    yaw_rad = None if event.yaw_rad is None else event.yaw_rad - mount_yaw_rad
    sigma_rad = None if event.yaw_variance is None else math.sqrt(event.yaw_variance)
    return mapper.add_imu(event.stamp_ns, yaw_rad, event.yaw_rate_rad_s, sigma_rad)
