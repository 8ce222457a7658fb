"""``sensor_msgs/Imu``: orientation and rates, or one of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.findings import Finding
from uw_dslam_ros2.core.mounting import rotation_of_quaternion
from uw_dslam_ros2.io.drivers.adapter import Adapter, key_of, vector_of
from uw_dslam_ros2.io.drivers.settings import ReadSettings
from uw_dslam_ros2.io.readings import ImuEvent

__all__ = ["ADAPTERS", "read_imu"]

FloatArray = NDArray[np.float64]
_MAX_ROUNDING = 0.05


def read_imu(msg: Any, settings: ReadSettings) -> Sequence[ImuEvent]:
    """Orientation and rates in the IMU's own frame.

    The message says "no orientation" and "no rates" by -1 in the first element of the covariance;
    drivers also by NaN, or a quaternion of zeros. A variance of 0 means unknown. Of a
    quaternion whose norm is not 1, but always the same, only the scale is another.
    """
    q = msg.orientation
    orientation = np.array([q.x, q.y, q.z, q.w], dtype=np.float64)
    has_orientation = float(msg.orientation_covariance[0]) != -1.0
    if has_orientation and not np.isnan(orientation).any() and orientation.any():
        orientation = _scaled(orientation, settings)
        rotation_of_quaternion(orientation)  # refuses what is no rotation
    else:
        has_orientation = False
    value = float(msg.orientation_covariance[8])
    rates = vector_of(msg.angular_velocity)
    has_rates = float(msg.angular_velocity_covariance[0]) != -1.0 and np.isfinite(rates).all()
    if not has_orientation and not has_rates:
        return ()
    return (
        ImuEvent(
            *key_of(msg, settings),
            orientation if has_orientation else None,
            value if has_orientation and value > 0.0 else None,
            rates if has_rates else None,
        ),
    )


def _scaled(orientation: FloatArray, settings: ReadSettings) -> FloatArray:
    """A quaternion in units of the first one's norm, where that is none of rounding."""
    norm = float(settings.memory.setdefault("norm", float(np.linalg.norm(orientation))))
    if not np.isfinite(norm) or abs(norm - 1.0) < _MAX_ROUNDING:
        return orientation
    settings.tell_once(
        Finding(
            "imu_quaternion_norm",
            "imu",
            f"its first quaternion has a norm of {norm:.3g}, not 1: all are divided by that",
            severity="info",
        )
    )
    return orientation / norm


ADAPTERS = (Adapter("sensor_msgs/msg/Imu", ("imu",), read_imu),)
