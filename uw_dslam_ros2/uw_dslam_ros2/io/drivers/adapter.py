"""What an adapter is, and what all of them need."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.io.drivers.settings import ReadSettings
from uw_dslam_ros2.io.readings import Reading

__all__ = ["Adapter", "as_bytes", "covariance_or_none", "key_of", "stamp_of", "vector_of"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Adapter:
    """Turns the messages of one type into readings.

    ``read`` takes any object with the message's fields: rclpy's, or one that `rosbags` made. It
    raises `InvalidInputError` that names the field, and gives nothing where the message says that
    it holds nothing. A message without a header gives a reading with stamp 0 and frame "": the
    time of its receipt and the vehicle's own frame are meant.

    ``roles`` are what a topic of this type can be, most likely first.
    """

    msgtype: str
    roles: tuple[str, ...]
    read: Callable[[Any, ReadSettings], Sequence[Reading]]


def stamp_of(msg: Any) -> int:
    """Time of a message's header [ns]; 0 without a header."""
    if not hasattr(msg, "header"):
        return 0
    stamp = msg.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def key_of(msg: Any, settings: ReadSettings) -> tuple[str, int, str]:
    """Vehicle, stamp [ns] and frame: how every reading begins."""
    frame_id = str(msg.header.frame_id) if hasattr(msg, "header") else ""
    return settings.vehicle_id, stamp_of(msg), frame_id


def vector_of(vector: Any) -> FloatArray:
    """Array (3,) of a Vector3 or Point."""
    return np.array([vector.x, vector.y, vector.z], dtype=np.float64)


def covariance_or_none(covariance: ArrayLike, size: int = 3) -> FloatArray | None:
    """Leading block (3, 3) of a covariance (size, size); None where it is not filled in.

    What is not known is -1, 0 or not finite in practice. Along z that is no reason to refuse.
    """
    values = np.asarray(covariance, dtype=np.float64).reshape(size, size)[:3, :3]
    is_usable = np.isfinite(values).all() and (np.diag(values)[:2] > 0.0).all()
    return values.copy() if is_usable else None


def as_bytes(data: Any, field: str) -> NDArray[np.uint8]:
    """Bytes (N,) of what rclpy or rosbags hand out: arrays, bytes, or a list of integers."""
    try:
        return np.frombuffer(bytes(data) if isinstance(data, list) else data, dtype=np.uint8)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"{field} is no array of bytes: {error}") from error
