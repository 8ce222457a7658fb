"""What a sensor said, handed to a vehicle mapper with the place where the sensor sits."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.mapping import VehicleMapper, VehicleRuns
from uw_dslam_ros2.core.mounting import (
    fan_mount,
    level_rotation,
    rotation_of_quaternion,
)
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar import Beams
from uw_dslam_ros2.core.submap import Submap
from uw_dslam_ros2.io.readings import (
    PINGS,
    BeamsEvent,
    DepthEvent,
    ImageEvent,
    ImuEvent,
    PointsEvent,
    PoseEvent,
    Reading,
    ScanEvent,
    VelocityEvent,
)

__all__ = [
    "SensorEvent",
    "feed",
    "feed_runs",
    "in_stamp_order",
]

FloatArray = NDArray[np.float64]

SensorEvent = Reading

_HOLD_NS = 2_000_000_000


def in_stamp_order[EventT](events: Iterable[EventT]) -> Iterator[EventT]:
    """Bring a recording's messages, up to 2 s out of order, into that of their stamps.

    Of equal stamps the attitude comes first, since others are levelled by it, and pings last. What
    is no sensor's message is passed on at once.
    """
    waiting: list[tuple[int, int, int, EventT]] = []
    newest_ns = 0
    for number, event in enumerate(events):
        if not isinstance(event, SensorEvent):
            yield event
            continue
        newest_ns = max(newest_ns, event.stamp_ns)
        heapq.heappush(waiting, (event.stamp_ns, _rank(event), number, event))
        while waiting[0][0] < newest_ns - _HOLD_NS:
            yield heapq.heappop(waiting)[-1]
    while waiting:
        yield heapq.heappop(waiting)[-1]


def _rank(event: SensorEvent) -> int:
    return 0 if isinstance(event, ImuEvent) else 1 + isinstance(event, PINGS)


def feed(mapper: VehicleMapper, event: SensorEvent, T_base_sensor: FloatArray) -> list[Submap]:
    """Give one event to a mapper; return the submaps that it made or changed.

    Rotations are used whole: what an instrument says in its own axes is turned to base_link by
    its mounting, and to the level plane by roll and pitch where an attitude was measured.

    Raises
    ------
    InvalidInputError
        If a sonar's fan points up or down, so that it has no place in the plane.
    """
    stamp_ns = event.stamp_ns
    R_level_base = mapper.attitude_at(stamp_ns)
    match event:
        case ImageEvent():
            mount = fan_mount(T_base_sensor, event.forward, R_level_base)
            return mapper.add_image(event.image, mount.T_base_fan, mount.projection)
        case ScanEvent():
            mount = fan_mount(T_base_sensor, "x", R_level_base)
            return mapper.add_scan(
                stamp_ns, event.angles_rad, event.ranges_m, event.range_max_m,
                mount.T_base_fan, mount.projection,
            )  # fmt: skip
        case PointsEvent():
            return _feed_points(mapper, event, T_base_sensor, R_level_base)
        case BeamsEvent():
            mount = fan_mount(T_base_sensor, "x", R_level_base)
            beams = Beams(
                event.beam_stamp_ns, event.bearing_rad, event.range_m, event.range_max_m,
                event.intensity,
            )  # fmt: skip
            return mapper.add_beams(beams, mount.T_base_fan, mount.projection)
        case VelocityEvent():
            _feed_velocity(mapper, event, T_base_sensor, R_level_base)
        case ImuEvent():
            _feed_imu(mapper, event, T_base_sensor[:3, :3])
        case PoseEvent():
            T_base_child = _seen_from_above(T_base_sensor)
            mapper.add_pose(stamp_ns, event.T_frame_base @ T_base_child.inverse())
        case DepthEvent():
            mapper.add_depth(stamp_ns, event.depth_m)
    return []


def feed_runs(runs: VehicleRuns, event: SensorEvent, T_base_sensor: FloatArray) -> list[Submap]:
    """Give one event to the run that it belongs to; see `feed`."""
    issued: list[Submap] = []
    stamp_ns = event.stamp_ns
    if isinstance(event, PINGS) and runs.is_blind(stamp_ns):
        return issued
    if isinstance(event, PoseEvent) or (isinstance(event, ImuEvent) and _has_heading(event)):
        issued += runs.note_heading(stamp_ns)
    if isinstance(event, VelocityEvent) and np.isfinite(event.velocity_m_s).all():
        issued += runs.note_velocity(stamp_ns, float(np.hypot(*event.velocity_m_s[:2])))
    return issued + feed(runs.mapper, event, T_base_sensor)


def _has_heading(event: ImuEvent) -> bool:
    values = (event.yaw_rad, event.yaw_rate_rad_s)
    return any(value is not None and math.isfinite(value) for value in values)


def _seen_from_above(T_base_sensor: FloatArray) -> SE2:
    yaw = math.atan2(T_base_sensor[1, 0], T_base_sensor[0, 0])
    return SE2(float(T_base_sensor[0, 3]), float(T_base_sensor[1, 3]), yaw)


def _feed_points(
    mapper: VehicleMapper,
    event: PointsEvent,
    T_base_sensor: FloatArray,
    R_level_base: FloatArray | None,
) -> list[Submap]:
    """Points of the fan (N, 2), or of space (N, 3): these need no fan that is level."""
    if event.points.shape[1] == 2:
        mount = fan_mount(T_base_sensor, "x", R_level_base)
        return mapper.add_points(event.stamp_ns, event.points, mount.T_base_fan, mount.projection)
    T_level_sensor = T_base_sensor.copy()
    if R_level_base is not None:
        T_level_sensor[:3] = R_level_base @ T_level_sensor[:3]
    points = event.points @ T_level_sensor[:3, :3].T
    points = points[np.abs(points[:, 2]) <= event.max_height_m]
    T_base_points = SE2(float(T_level_sensor[0, 3]), float(T_level_sensor[1, 3]), 0.0)
    return mapper.add_points(event.stamp_ns, points[:, :2], T_base_points)


def _feed_velocity(
    mapper: VehicleMapper,
    event: VelocityEvent,
    T_base_sensor: FloatArray,
    R_level_base: FloatArray | None,
) -> None:
    rotation = T_base_sensor[:3, :3]
    if R_level_base is not None:
        rotation = R_level_base @ rotation
    covariance = event.covariance
    if covariance is not None:
        covariance = (rotation @ covariance @ rotation.T)[:2, :2]
    place = SE2(float(T_base_sensor[0, 3]), float(T_base_sensor[1, 3]), 0.0)
    mapper.add_velocity(event.stamp_ns, (rotation @ event.velocity_m_s)[:2], covariance, place)


def _feed_imu(mapper: VehicleMapper, event: ImuEvent, R_base_imu: FloatArray) -> None:
    sigma_rad = None if event.yaw_variance is None else math.sqrt(event.yaw_variance)
    rates, yaw_rad = event.angular_velocity_rad_s, None
    turned = None if rates is None else R_base_imu @ rates
    if event.orientation_xyzw is not None:
        R_world_base = rotation_of_quaternion(event.orientation_xyzw) @ R_base_imu.T
        yaw_rad = math.atan2(R_world_base[1, 0], R_world_base[0, 0]) - event.drift_rad
        R_level_base = level_rotation(R_world_base)
        mapper.add_attitude(event.stamp_ns, R_level_base)
        if turned is not None and R_level_base is not None:
            turned = R_level_base @ turned
    rate_rad_s = None if turned is None else float(turned[2]) - event.drift_rad_s
    mapper.add_imu(event.stamp_ns, yaw_rad, rate_rad_s, sigma_rad)
