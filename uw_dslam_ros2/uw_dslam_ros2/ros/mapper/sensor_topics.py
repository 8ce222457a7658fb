"""Which topics a mapper listens to, and how they are found on the graph."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.subscription import Subscription

from uw_dslam_ros2.core.findings import Finding
from uw_dslam_ros2.ros.plumbing.batched_subscription import subscribe_batched
from uw_dslam_ros2.ros.plumbing.node_settings import SonarMapperConfig
from uw_dslam_ros2.ros.plumbing.qos import sensor_qos
from uw_dslam_ros2.ros.plumbing.sensor_inputs import SensorInput, default_inputs, found_inputs

__all__ = ["SensorTopics"]


class SensorTopics:
    """Subscribes to one topic for each role: under its usual name first, then as it is found.

    Parameters
    ----------
    node
        Whose subscriptions they are.
    on_message
        Called with the input and each message.
    on_finding
        Told what is strange about messages.
    own
        Names of topics that the node itself publishes.
    group
        Of the subscriptions' callbacks.
    """

    def __init__(
        self,
        node: Node,
        config: SonarMapperConfig,
        vehicle_id: str,
        on_message: Callable[[SensorInput, Any], None],
        on_finding: Callable[[Finding], None],
        own: Collection[str],
        group: CallbackGroup,
    ) -> None:
        self._node, self._config, self._vehicle_id = node, config, vehicle_id
        self._on_message, self._on_finding, self._group = on_message, on_finding, group
        self._own = {node.resolve_topic_name(name) for name in own}
        self._inputs: dict[str, SensorInput] = {}
        self._subscriptions: dict[str, Subscription] = {}
        for sensor in default_inputs(config, vehicle_id, on_finding):
            self._subscribe(sensor)

    def inputs(self) -> list[SensorInput]:
        """What is listened to."""
        return list(self._inputs.values())

    def _subscribe(self, sensor: SensorInput) -> None:
        """Listen to a topic, and no more to the one that had its role before."""
        msg_type = sensor.msg_type
        if old := self._subscriptions.pop(sensor.role, None):
            self._node.destroy_subscription(old)
        self._inputs[sensor.role] = sensor
        qos = sensor_qos(sensor.queue_depth, is_reliable=self._config.is_reliable)
        take = functools.partial(self._on_message, sensor)
        self._subscriptions[sensor.role] = subscribe_batched(
            self._node, msg_type, sensor.topic, take, qos, self._group
        )

    def discover(self) -> None:
        """Find sensors whose topics have other names or types than the usual ones.

        Raises
        ------
        DataError
            If two topics could play a role, or one that is set is not there.
        """
        node = self._node
        namespace = node.get_namespace().strip("/")
        wanted = self._config.topics.chosen().values()
        table = {}
        for topic, _ in node.get_topic_names_and_types():
            is_mine = not namespace or topic.startswith(f"/{namespace}/") or topic in wanted
            senders = node.get_publishers_info_by_topic(topic) if is_mine else []
            if senders and topic not in self._own:
                table[topic] = senders[0].topic_type
        found = found_inputs(self._config, self._vehicle_id, namespace, table, self._on_finding)
        for sensor in found:
            if not self._is_sent(self._inputs.get(sensor.role)):
                self._subscribe(sensor)
                node.get_logger().info(f"{sensor.name} is {sensor.topic} ({sensor.msgtype})")

    def _is_sent(self, sensor: SensorInput | None) -> bool:
        """Whether somebody sends what is listened to."""
        if sensor is None:
            return False
        senders = self._node.get_publishers_info_by_topic(
            self._node.resolve_topic_name(sensor.topic)
        )
        return any(info.topic_type == sensor.msgtype for info in senders)

    def stop(self) -> None:
        """Listen no more."""
        while self._subscriptions:
            self._node.destroy_subscription(self._subscriptions.popitem()[1])

    def misfits(self) -> list[str]:
        """Sentences on topics that somebody sends with another type than is listened for."""
        found = []
        for sensor in self.inputs():
            topic = self._node.resolve_topic_name(sensor.topic)
            found += [
                f"topic {topic} has type {info.topic_type}, expected {sensor.msgtype}"
                for info in self._node.get_publishers_info_by_topic(topic)
                if info.topic_type != sensor.msgtype
            ]
        return found
