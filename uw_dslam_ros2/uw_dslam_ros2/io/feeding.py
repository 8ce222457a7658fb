"""What a sensor said, handed to a vehicle mapper with the place where the sensor sits."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.mapping import VehicleMapper
from uw_dslam_ros2.core.mounting import planar_mount
from uw_dslam_ros2.core.submap import Submap
from uw_dslam_ros2.io.readings import (
    DepthEvent,
    ImageEvent,
    ImuEvent,
    PointsEvent,
    Reading,
    ScanEvent,
    VelocityEvent,
)

__all__ = ["SensorEvent", "feed", "in_stamp_order"]

SensorEvent = Reading

_PINGS = (ImageEvent, ScanEvent, PointsEvent)
_HOLD_NS = 2_000_000_000


def in_stamp_order[EventT](events: Iterable[EventT]) -> Iterator[EventT]:
    """Bring a recording's messages, up to 2 s out of order, into that of their stamps.

    Of equal stamps the pings come last. What is no sensor's message is passed on at once.
    """
    waiting: list[tuple[int, bool, int, EventT]] = []
    newest_ns = 0
    for number, event in enumerate(events):
        if not isinstance(event, SensorEvent):
            yield event
            continue
        newest_ns = max(newest_ns, event.stamp_ns)
        heapq.heappush(waiting, (event.stamp_ns, isinstance(event, _PINGS), number, event))
        while waiting[0][0] < newest_ns - _HOLD_NS:
            yield heapq.heappop(waiting)[-1]
    while waiting:
        yield heapq.heappop(waiting)[-1]


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
            mapper.add_velocity(stamp_ns, *event.horizontal(), mount)
        case ImuEvent():
            _feed_imu(mapper, event, planar_mount(T_base_sensor).yaw)
        case DepthEvent():
            mapper.add_depth(stamp_ns, event.depth_m)
    return []


def _feed_imu(mapper: VehicleMapper, event: ImuEvent, mount_yaw_rad: float) -> None:
    yaw_rad = None if event.yaw_rad is None else event.yaw_rad - mount_yaw_rad
    sigma_rad = None if event.yaw_variance is None else math.sqrt(event.yaw_variance)
    mapper.add_imu(event.stamp_ns, yaw_rad, event.yaw_rate_rad_s, sigma_rad)
