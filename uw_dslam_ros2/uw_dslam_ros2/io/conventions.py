"""Readings as they are meant: corrected where a driver follows another convention."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.conventions import Conventions
from uw_dslam_ros2.core.mounting import rotation_of_quaternion, rotation_of_roll_pitch
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.readings import (
    BeamsEvent,
    Event,
    ImageEvent,
    ImuEvent,
    PointsEvent,
    PoseEvent,
    ScanEvent,
    VelocityEvent,
)

__all__ = ["CorrectedMountings", "correct"]

FloatArray = NDArray[np.float64]

_HALF = math.sqrt(0.5)
# Quaternions [x, y, z, w]: of north-east-down in east-north-up, of forward-right-down in
# forward-left-up.
_Q_ENU_NED = (_HALF, _HALF, 0.0, 0.0)
_Q_FRD_FLU = (1.0, 0.0, 0.0, 0.0)

_Ping = ImageEvent | ScanEvent | PointsEvent | BeamsEvent


def correct[EventT: Event](event: EventT, conventions: Conventions) -> EventT | None:
    """What a reading says in the usual conventions; None where it says nothing then.

    All but the angles of mounting, which `CorrectedMountings` takes.
    """
    result: Event | None = event
    if isinstance(event, ImuEvent):
        result = _imu(event, conventions)
    elif isinstance(event, VelocityEvent):
        result = _velocity(event, conventions)
    elif isinstance(event, PoseEvent) and conventions.odometry == "ned":
        result = _pose_in_enu(event)
    elif isinstance(event, _Ping):
        result = _ping(event, conventions)
    return cast("EventT | None", result)


class CorrectedMountings:
    """Mountings of the instruments of one vehicle, as its conventions say.

    Readings are shown in the order of their stamps: velocities along the world's axes are turned
    by the last heading.
    """

    def __init__(self, conventions: Conventions) -> None:
        self._conventions = conventions
        self._yaw_rad = self._yaw_rate_rad_s = 0.0
        self._yaw_ns: int | None = None

    def of(self, event: Event, T_base_sensor: FloatArray) -> FloatArray | None:
        """``T_base_sensor`` (4, 4) with the instrument turned; None: it cannot be used yet.

        A mirrored velocity makes it a reflection: its forward and left become those of the body.
        """
        conventions = self._conventions
        if isinstance(event, ImuEvent):
            T_base_sensor = self._of_imu(T_base_sensor)
            self._note_heading(event, T_base_sensor[:3, :3])
        yaw_rad, side = 0.0, 1.0
        if isinstance(event, VelocityEvent):
            yaw_rad = conventions.velocity_yaw_offset_rad
            side = -1.0 if conventions.velocity_is_mirrored else 1.0
            if conventions.velocity_axes == "world":
                if self._yaw_ns is None:
                    return None
                since_s = (event.stamp_ns - self._yaw_ns) * 1e-9
                yaw_rad -= self._yaw_rad + since_s * self._yaw_rate_rad_s
        elif isinstance(event, _Ping):
            yaw_rad = conventions.sonar_yaw_offset_rad
            if 0.0 < conventions.sonar_knocked_at_s <= event.stamp_ns * 1e-9:
                yaw_rad += conventions.sonar_knocked_yaw_rad
        if yaw_rad == 0.0 and side == 1.0:
            return T_base_sensor
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        turn = np.array([[cos, -sin * side, 0.0], [sin, cos * side, 0.0], [0.0, 0.0, 1.0]])
        turned = T_base_sensor.copy()
        turned[:3, :3] = turn @ T_base_sensor[:3, :3]
        return turned

    def _of_imu(self, T_base_imu: FloatArray) -> FloatArray:
        roll, pitch = self._conventions.imu_roll_rad, self._conventions.imu_pitch_rad
        if roll == 0.0 and pitch == 0.0:
            return T_base_imu
        turned = T_base_imu.copy()
        turned[:3, :3] = rotation_of_roll_pitch(roll, pitch) @ T_base_imu[:3, :3]
        return turned

    def _note_heading(self, event: ImuEvent, R_base_imu: FloatArray) -> None:
        if event.orientation_xyzw is None:
            return
        R_world_base = rotation_of_quaternion(event.orientation_xyzw) @ R_base_imu.T
        self._yaw_rad = math.atan2(R_world_base[1, 0], R_world_base[0, 0])
        rates = event.angular_velocity_rad_s
        self._yaw_rate_rad_s = 0.0 if rates is None else float((R_base_imu @ rates)[2])
        self._yaw_ns = event.stamp_ns


def _earlier(stamp_ns: int, delay_s: float) -> int:
    return stamp_ns - round(delay_s * 1e9)


def _imu(event: ImuEvent, conventions: Conventions) -> ImuEvent | None:
    orientation, rates = event.orientation_xyzw, event.angular_velocity_rad_s
    if conventions.imu_orientation == "none":
        orientation = None
    elif conventions.imu_orientation == "wxyz" and orientation is not None:
        orientation = np.roll(orientation, -1)
    elif conventions.imu_orientation == "ned" and orientation is not None:
        orientation = _product(_product(_Q_ENU_NED, tuple(orientation)), _Q_FRD_FLU)
    if conventions.imu_rates == "none":
        rates = None
    elif rates is not None:
        axes = (1.0, -1.0, -1.0) if conventions.imu_rates == "frd" else (1.0, 1.0, 1.0)
        unit = math.pi / 180.0 if conventions.imu_rates_in_degrees else 1.0
        rates = rates * np.array(axes) * unit
    if orientation is None and rates is None:
        return None
    stamp_ns = _earlier(event.stamp_ns, conventions.imu_delay_s)
    drift_rad_s = conventions.imu_drift_rad_s
    return replace(
        event,
        stamp_ns=stamp_ns,
        orientation_xyzw=orientation,
        angular_velocity_rad_s=rates,
        drift_rad=drift_rad_s * (stamp_ns * 1e-9 - conventions.imu_drift_since_s),
        drift_rad_s=drift_rad_s,
    )


def _product(a: tuple[float, ...] | FloatArray, b: tuple[float, ...]) -> FloatArray:
    """Product of two quaternions [x, y, z, w]."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return np.array(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ]
    )


def _velocity(event: VelocityEvent, conventions: Conventions) -> VelocityEvent | None:
    if conventions.velocity_zero_is_invalid and not event.velocity_m_s[:2].any():
        return None
    scale, covariance = conventions.velocity_scale, event.covariance
    return replace(
        event,
        stamp_ns=_earlier(event.stamp_ns, conventions.velocity_delay_s),
        velocity_m_s=event.velocity_m_s * scale,
        covariance=None if covariance is None else covariance * scale**2,
    )


def _pose_in_enu(event: PoseEvent) -> PoseEvent:
    """Of a pose in north-east-down: its yaw is a heading, from north and clockwise."""
    pose = event.T_frame_base
    # Of [x, y, yaw] in east-north-up by those in north-east-down.
    swap = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    velocity = event.velocity_m_s
    return replace(
        event,
        T_frame_base=SE2(pose.y, pose.x, 0.5 * math.pi - pose.yaw),
        covariance=None if event.covariance is None else swap @ event.covariance @ swap.T,
        velocity_m_s=None if velocity is None else velocity * np.array([1.0, -1.0, -1.0]),
        height_m=-event.height_m,
    )


def _ping(event: _Ping, conventions: Conventions) -> _Ping:
    stamp_ns = _earlier(event.stamp_ns, conventions.sonar_delay_s)
    side = -1.0 if conventions.sonar_is_mirrored else 1.0
    bearing_scale = side * conventions.sonar_bearing_scale
    scale = conventions.sonar_range_scale
    match event:
        case ImageEvent(image=image):
            image = replace(
                image,
                stamp_ns=stamp_ns,
                range_m=image.range_m * scale,
                bearing_rad=image.bearing_rad * bearing_scale,
            )
            return replace(event, stamp_ns=stamp_ns, image=image)
        case ScanEvent():
            return replace(
                event,
                stamp_ns=stamp_ns,
                angles_rad=event.angles_rad * bearing_scale,
                ranges_m=event.ranges_m * scale,
                range_max_m=event.range_max_m * scale,
            )
        case PointsEvent(points=points):
            factors = np.ones(points.shape[1])
            factors[1] = side
            return replace(event, stamp_ns=stamp_ns, points=points * factors * scale)
        case BeamsEvent():
            return replace(
                event,
                stamp_ns=stamp_ns,
                beam_stamp_ns=event.beam_stamp_ns - round(conventions.sonar_delay_s * 1e9),
                bearing_rad=event.bearing_rad * bearing_scale,
                range_m=event.range_m * scale,
                range_max_m=event.range_max_m * scale,
            )
