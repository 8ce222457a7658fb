"""``geometry_msgs``: Twist, TwistStamped and TwistWithCovarianceStamped as velocities."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.io.drivers.adapter import Adapter, covariance_or_none, key_of, vector_of
from uw_dslam_ros2.io.drivers.settings import ReadSettings
from uw_dslam_ros2.io.readings import VelocityEvent

__all__ = ["ADAPTERS", "read_stamped", "read_twist", "read_with_covariance"]


def read_twist(msg: Any, settings: ReadSettings) -> Sequence[VelocityEvent]:
    """Velocity of a ``Twist``, which has no header: mostly a command, so only where asked for."""
    return _event(msg, msg, None, settings)


def read_stamped(msg: Any, settings: ReadSettings) -> Sequence[VelocityEvent]:
    """Velocity of a ``TwistStamped`` in its frame's axes, x forward."""
    return _event(msg, msg.twist, None, settings)


def read_with_covariance(msg: Any, settings: ReadSettings) -> Sequence[VelocityEvent]:
    """Velocity of a ``TwistWithCovarianceStamped``; a negative variance means that it has none."""
    return _event(msg, msg.twist.twist, msg.twist.covariance, settings)


def _event(
    msg: Any, twist: Any, covariance: ArrayLike | None, settings: ReadSettings
) -> Sequence[VelocityEvent]:
    velocity = vector_of(twist.linear)
    if np.isnan(velocity[:2]).any():
        return ()
    if not np.isfinite(velocity).all():
        raise InvalidInputError(f"twist.linear is {velocity.tolist()}, expected finite numbers")
    if covariance is not None and float(np.asarray(covariance, np.float64).reshape(36)[0]) < 0.0:
        return ()
    known = None if covariance is None else covariance_or_none(covariance, 6)
    return (VelocityEvent(*key_of(msg, settings), velocity, known, is_z_down=False),)


ADAPTERS = (
    Adapter("geometry_msgs/msg/TwistWithCovarianceStamped", ("velocity",), read_with_covariance),
    Adapter("geometry_msgs/msg/TwistStamped", ("velocity",), read_stamped),
    Adapter("geometry_msgs/msg/Twist", ("velocity",), read_twist),
)
