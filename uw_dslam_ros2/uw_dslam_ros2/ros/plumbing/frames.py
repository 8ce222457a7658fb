"""Frames: fixed mounts read from /tf_static, and our own transforms sent to /tf.

tf2_ros is not needed (and not everywhere installed): mounts never move, and what does move we
send ourselves.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time as TimeMsg
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.node import Node
from tf2_msgs.msg import TFMessage

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.mounting import StaticFrames
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.messages import matrix_of_transform
from uw_dslam_ros2.ros.convert.core_types import quaternion_to_msg
from uw_dslam_ros2.ros.plumbing.qos import STATIC_TF, TF

__all__ = ["FrameBroadcaster", "Mounts", "transform_to_msg"]

WARNING_PERIOD_S = 5.0


class Mounts:
    """Fixed poses of instruments on a vehicle, as /tf_static tells them."""

    def __init__(
        self, node: Node, on_change: Callable[[], None] | None = None, **kwargs: Any
    ) -> None:
        self._node = node
        self._frames = StaticFrames()
        self._names: set[str] = set()
        self._lock = threading.Lock()
        self._on_change = on_change
        node.create_subscription(TFMessage, "/tf_static", self._on_transforms, STATIC_TF, **kwargs)

    @property
    def num_frames(self) -> int:
        """Frames that were told."""
        return len(self._names)

    def _on_transforms(self, msg: TFMessage) -> None:
        for transform in msg.transforms:
            parent, child = (
                transform.header.frame_id.lstrip("/"),
                transform.child_frame_id.lstrip("/"),
            )
            try:
                T_parent_child = matrix_of_transform(transform.transform)
            except InvalidInputError as error:
                self._node.get_logger().warning(
                    f"transform {parent} -> {child} ignored: {error}",
                    throttle_duration_sec=WARNING_PERIOD_S,
                )
                continue
            with self._lock:
                self._frames.add(parent, child, T_parent_child)
                self._names.add(child)
        if self._on_change is not None:
            self._on_change()

    def lookup(self, base_frame_id: str, frame_id: str) -> NDArray[np.float64] | None:
        """``T_base_frame`` (4, 4), or None when nobody has told it (yet).

        A message without a frame, or in the base frame, is taken as measured there.
        """
        frame_id = frame_id.lstrip("/")
        if frame_id in ("", base_frame_id):
            return np.eye(4)
        with self._lock:
            try:
                return self._frames.lookup(base_frame_id, frame_id)
            except InvalidInputError:
                return None


def transform_to_msg(
    stamp: TimeMsg, frame_id: str, child_frame_id: str, T_frame_child: SE2
) -> TransformStamped:
    """``T_<frame_id>_<child_frame_id>`` as a message."""
    msg = TransformStamped()
    msg.header.stamp = stamp
    msg.header.frame_id = frame_id
    msg.child_frame_id = child_frame_id
    msg.transform.translation.x = T_frame_child.x
    msg.transform.translation.y = T_frame_child.y
    msg.transform.rotation = quaternion_to_msg(T_frame_child.yaw)
    return msg


class FrameBroadcaster:
    """Sends transforms on /tf."""

    def __init__(self, node: Node) -> None:
        self._publisher = node.create_publisher(TFMessage, "/tf", TF)

    def send(self, *transforms: TransformStamped) -> None:
        """Send transforms in one message."""
        self._publisher.publish(TFMessage(transforms=list(transforms)))

    @property
    def num_readers(self) -> int:
        """Who listens."""
        return int(self._publisher.get_subscription_count())
