"""``sensor_msgs/NavSatFix`` and points of acoustic positioning, as fixes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.io.drivers.adapter import Adapter, covariance_or_none, key_of, vector_of
from uw_dslam_ros2.io.drivers.settings import ReadSettings
from uw_dslam_ros2.io.readings import FixEvent

__all__ = ["ADAPTERS", "read_point", "read_satellite"]

_NO_FIX = -1
_UNKNOWN = 0


def read_satellite(msg: Any, settings: ReadSettings) -> Sequence[FixEvent]:
    """Latitude and longitude of a ``NavSatFix``; nothing where the receiver has no fix."""
    position = np.array([msg.latitude, msg.longitude], dtype=np.float64)
    if int(msg.status.status) <= _NO_FIX or np.isnan(position).any():
        return ()
    if not (abs(position[0]) <= 90.0 and abs(position[1]) <= 360.0):
        raise InvalidInputError(
            f"latitude, longitude are {position.tolist()}, expected degrees within 90 and 360"
        )
    covariance = None
    if int(msg.position_covariance_type) != _UNKNOWN:
        covariance = covariance_or_none(msg.position_covariance)
    return (
        FixEvent(
            *key_of(msg, settings),
            position,
            None if covariance is None else covariance[:2, :2],
            is_geodetic=True,
        ),
    )


def read_point(msg: Any, settings: ReadSettings) -> Sequence[FixEvent]:
    """Position of a ``PointStamped``."""
    position = vector_of(msg.point)[:2]
    if np.isnan(position).any():
        return ()
    return (FixEvent(*key_of(msg, settings), position, None),)


ADAPTERS = (
    Adapter("sensor_msgs/msg/NavSatFix", ("fix",), read_satellite),
    Adapter("geometry_msgs/msg/PointStamped", ("fix",), read_point),
)
