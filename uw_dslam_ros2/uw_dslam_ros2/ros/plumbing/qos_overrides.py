"""Quality of service by parameters ``qos_overrides.<topic>.<entity>.<policy>``, as in rclcpp."""

from __future__ import annotations

import copy
from typing import Any

from rclpy.exceptions import InvalidParameterTypeException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSPolicyKind
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

from uw_dslam_ros2.core.errors import ConfigError

__all__ = ["QOS_HEAD", "QosOverrides", "given_parameters"]

QOS_HEAD = "qos_overrides"
_KINDS = (
    QoSPolicyKind.HISTORY,
    QoSPolicyKind.DEPTH,
    QoSPolicyKind.RELIABILITY,
    QoSPolicyKind.DURABILITY,
)
_POLICIES = tuple(kind.name.lower() for kind in _KINDS)
_ENTITIES = ("publisher", "subscription")


class QosOverrides(Node):
    """A node whose publishers and subscriptions take their quality of service from parameters.

    Only where one is given: a parameter of its own for each policy of each topic would bury those
    that people set.
    """

    def create_publisher(
        self, msg_type: Any, topic: str, qos_profile: Any, **kwargs: Any
    ) -> Publisher:
        """As the base class, with the overrides that were given."""
        kwargs |= self._options(topic, "publisher")
        qos_profile = copy.copy(qos_profile)  # rclpy writes the overrides into what it is given
        try:
            return super().create_publisher(msg_type, topic, qos_profile, **kwargs)
        except (RuntimeError, InvalidParameterTypeException) as error:
            raise ConfigError(f"parameters {QOS_HEAD} of {topic}: {error}") from error

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Any, qos_profile: Any, **kwargs: Any
    ) -> Subscription:
        """As the base class, with the overrides that were given."""
        kwargs |= self._options(topic, "subscription")
        qos_profile = copy.copy(qos_profile)
        try:
            return super().create_subscription(msg_type, topic, callback, qos_profile, **kwargs)
        except (RuntimeError, InvalidParameterTypeException) as error:
            raise ConfigError(f"parameters {QOS_HEAD} of {topic}: {error}") from error

    def _options(self, topic: str, entity: str) -> dict[str, QoSOverridingOptions]:
        head = f"{QOS_HEAD}.{self.resolve_topic_name(topic)}.{entity}."
        if not any(name.startswith(head) for name in given_parameters(self)):
            return {}
        return {"qos_overriding_options": QoSOverridingOptions(_KINDS)}

    def check_qos_overrides(self) -> None:
        """Raise `ConfigError` where an override that was given can change nothing.

        A subscription may still come, when its topic is found.
        """
        published = {publisher.topic_name for publisher in self.publishers}
        for name in sorted(given_parameters(self)):
            if name.split(".")[0] != QOS_HEAD or self.has_parameter(name):
                continue
            topic, entity, policy = ("", *name.split(".")[1:])[-3:]
            if entity not in _ENTITIES or policy not in _POLICIES or not topic.startswith("/"):
                raise ConfigError(
                    f"parameter {name} is unknown, expected {QOS_HEAD}.<topic>.<publisher or "
                    f"subscription>.<{', '.join(_POLICIES)}> with the topic's whole name"
                )
            if entity == "publisher":
                raise ConfigError(
                    f"parameter {name} would change nothing: {self.get_name()} publishes "
                    f"{', '.join(sorted(published))}"
                )


def given_parameters(node: Node) -> dict[str, Parameter]:
    """What a node was started with; rclpy has no public name for it."""
    return getattr(node, "_parameter_overrides", {})
