"""Poses of the vehicle's own filter; the same types as depth and as position fixes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.mounting import rotation_of_quaternion
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.drivers.adapter import Adapter, covariance_or_none, key_of, vector_of
from uw_dslam_ros2.io.drivers.settings import ReadSettings
from uw_dslam_ros2.io.readings import DepthEvent, FixEvent, PoseEvent, Reading, VelocityEvent

__all__ = ["ADAPTERS", "planar_pose", "read_odometry", "read_pose", "read_pose_with_covariance"]

FloatArray = NDArray[np.float64]
_XY_YAW = np.ix_([0, 1, 5], [0, 1, 5])


def read_odometry(msg: Any, settings: ReadSettings) -> Sequence[Reading]:
    """Pose and velocity of an ``Odometry``, or its depth where that is the role.

    Drivers of DVLs send it for its twist alone: that is a velocity.
    """
    readings = _readings(msg, msg.pose.pose, msg.pose.covariance, settings)
    if settings.role in ("depth", "fix"):
        return readings
    velocity = vector_of(msg.twist.twist.linear)
    is_filled = bool(np.isfinite(velocity).all() and velocity.any())
    frame_id = str(msg.child_frame_id)
    if readings and isinstance(readings[0], PoseEvent):
        known = velocity if is_filled else None
        return (replace(readings[0], child_frame_id=frame_id, velocity_m_s=known),)
    if not is_filled or not _is_unset(msg.pose.pose, vector_of(msg.pose.pose.position)):
        return readings
    vehicle_id, stamp_ns, _ = key_of(msg, settings)
    covariance = covariance_or_none(msg.twist.covariance, 6)
    return (VelocityEvent(vehicle_id, stamp_ns, frame_id, velocity, covariance),)


def read_pose(msg: Any, settings: ReadSettings) -> Sequence[Reading]:
    """Pose of a ``PoseStamped``."""
    return _readings(msg, msg.pose, None, settings)


def read_pose_with_covariance(msg: Any, settings: ReadSettings) -> Sequence[Reading]:
    """Pose, fix or depth of a ``PoseWithCovarianceStamped``."""
    return _readings(msg, msg.pose.pose, msg.pose.covariance, settings)


def _readings(
    msg: Any, pose: Any, covariance: ArrayLike | None, settings: ReadSettings
) -> Sequence[Reading]:
    position = vector_of(pose.position)
    key = key_of(msg, settings)
    if settings.role == "depth":
        # z up in one convention, down in the other: a vehicle in the water is below its surface.
        return () if math.isnan(position[2]) else (DepthEvent(*key, abs(float(position[2]))),)
    if np.isnan(position[:2]).any():
        return ()
    values = None if covariance is None else np.asarray(covariance, np.float64).reshape(6, 6)
    if settings.role == "fix":
        return (FixEvent(*key, position[:2], _filled(values, np.ix_([0, 1], [0, 1]))),)
    if _is_unset(pose, position):
        return ()
    height_m = float(position[2])
    return (PoseEvent(*key, "", planar_pose(pose), _filled(values, _XY_YAW), height_m=height_m),)


def _is_unset(pose: Any, position: FloatArray) -> bool:
    """Whether nobody filled a pose in."""
    q = pose.orientation
    return not position.any() and not any((q.x, q.y, q.z)) and q.w in (0.0, 1.0)


def _filled(values: FloatArray | None, block: tuple[NDArray[np.intp], ...]) -> FloatArray | None:
    """Block of a covariance; None where the driver leaves it at 0 or says -1."""
    if values is None:
        return None
    part = values[block]
    return part if np.isfinite(part).all() and (np.diag(part) > 0.0).all() else None


def planar_pose(pose: Any) -> SE2:
    """Horizontal pose of a ``geometry_msgs/Pose`` in its header's frame."""
    position, q = vector_of(pose.position), pose.orientation
    if not np.isfinite(position[:2]).all():
        raise InvalidInputError(f"position is {position.tolist()}, expected finite numbers")
    rotation = rotation_of_quaternion((q.x, q.y, q.z, q.w))
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    return SE2(float(position[0]), float(position[1]), yaw)


ADAPTERS = (
    Adapter("nav_msgs/msg/Odometry", ("odometry", "depth", "fix"), read_odometry),
    Adapter(
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        ("odometry", "fix", "depth"),
        read_pose_with_covariance,
    ),
    Adapter("geometry_msgs/msg/PoseStamped", ("odometry", "fix", "depth"), read_pose),
)
