"""Subscriptions that take all that has come when they are woken.

rclpy's executors build their wait set anew for each message of a callback group, which costs more
than most sensor messages do. Where messages come in bursts, as from a replay, one wake-up is
enough for all of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

__all__ = ["subscribe_batched"]


def subscribe_batched(
    node: Node,
    msg_type: Any,
    topic: str,
    on_message: Callable[[Any], None],
    qos: QoSProfile,
    group: CallbackGroup,
    max_at_once: int = 200,
) -> Subscription:
    """Subscribe; ``on_message`` is called for each message, in their order.

    After ``max_at_once`` messages the other topics of the group have their turn.
    """

    def take(msg: Any) -> None:
        on_message(msg)
        for _ in range(max_at_once - 1):
            with subscription.handle:
                taken = subscription.handle.take_message(msg_type, False)
            if taken is None:
                return
            on_message(taken[0])

    subscription = node.create_subscription(msg_type, topic, take, qos, callback_group=group)
    return subscription
