"""Bytes that managers tell each other over an acoustic link."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_msgs.msg import UInt8MultiArray

from uw_dslam_ros2.ros.plumbing.qos import ANSWERS

__all__ = ["link_topic"]


def link_topic(
    node: Node,
    link: str,
    name: str,
    post: Callable[[Callable[[], None]], None],
    take: Callable[[bytes], None],
) -> Publisher | None:
    """Publisher of what is told to the others; None without a link.

    Parameters
    ----------
    node
        Whose topics they are.
    link
        Namespace of the acoustic link's node; empty: there is none.
    name
        Last part of the topic; what is heard comes on ``<name>_heard``.
    post
        Hands a function to the thread that owns the caller.
    take
        Called in that thread with what is heard.
    """
    if not link:
        return None
    topic = f"/{link.strip('/')}/link/{name}"
    node.create_subscription(
        UInt8MultiArray,
        f"{topic}_heard",
        lambda msg: post(lambda: take(bytes(msg.data))),
        ANSWERS,
        callback_group=ReentrantCallbackGroup(),
    )
    return node.create_publisher(UInt8MultiArray, topic, ANSWERS)
