"""Frames: fixed mounts read from /tf_static and /tf, and our own transforms sent to /tf.

tf2_ros is not needed (and not everywhere installed): mounts never move, and what does move we
send ourselves.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from builtin_interfaces.msg import Time as TimeMsg
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from tf2_msgs.msg import TFMessage

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.messages import matrix_of_transform
from uw_dslam_ros2.io.readings import TransformEvent
from uw_dslam_ros2.ros.convert.core_types import quaternion_to_msg
from uw_dslam_ros2.ros.plumbing.qos import STATIC_TF, TF

__all__ = ["FrameBroadcaster", "Transforms", "transform_to_msg"]

WARNING_PERIOD_S = 5.0
_MOVING = ("base_link", "base_footprint", "odom", "map")


class Transforms:
    """Fixed transforms of a vehicle as readings, from wherever they are sent.

    That is ``/tf_static``, ``tf_static`` below the node's namespace, and ``/tf``, where many
    drivers send their mountings again and again: of each frame there the first counts, and what
    one of the others says counts for more.
    """

    def __init__(
        self, node: Node, vehicle_id: str, take: Callable[[TransformEvent], None], **kwargs: Any
    ) -> None:
        self._node = node
        self._vehicle_id = vehicle_id
        self._take = take
        self._heard: set[str] = set()
        fixed = {"/tf_static", node.resolve_topic_name("tf_static")}
        for topic in sorted(fixed):
            node.create_subscription(
                TFMessage, topic, lambda msg: self._on_transforms(msg, is_fixed=True), STATIC_TF,
                **kwargs,
            )  # fmt: skip
        node.create_subscription(
            TFMessage, "/tf", lambda msg: self._on_transforms(msg, is_fixed=False), TF, **kwargs
        )

    def _on_transforms(self, msg: TFMessage, *, is_fixed: bool) -> None:
        for transform in msg.transforms:
            child_frame_id = transform.child_frame_id
            if not is_fixed and (child_frame_id in self._heard or _moves(child_frame_id)):
                continue
            try:
                T_parent_child = matrix_of_transform(transform.transform)
            except InvalidInputError as error:
                self._node.get_logger().warning(
                    f"transform {transform.header.frame_id} -> {child_frame_id} ignored: {error}",
                    throttle_duration_sec=WARNING_PERIOD_S,
                )
                continue
            self._heard.add(child_frame_id)
            stamp = transform.header.stamp
            self._take(
                TransformEvent(
                    self._vehicle_id,
                    stamp.sec * 1_000_000_000 + stamp.nanosec,
                    transform.header.frame_id,
                    child_frame_id,
                    T_parent_child,
                )
            )


def _moves(frame_id: str) -> bool:
    """Whether a frame is the vehicle's own or above it (REP 105): no instrument's."""
    return frame_id.rpartition("/")[2] in _MOVING


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
