"""Position fixes of vehicles, as they come."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.subscription import Subscription
from sensor_msgs.msg import NavSatFix

from uw_dslam_ros2.core.errors import ConfigError, InvalidInputError
from uw_dslam_ros2.core.merging import Fix
from uw_dslam_ros2.core.submap import Submap
from uw_dslam_ros2.io.drivers import ADAPTERS, Adapter, ReadSettings
from uw_dslam_ros2.io.readings import FixEvent, Reading
from uw_dslam_ros2.io.sensor_settings import SensorConfig
from uw_dslam_ros2.ros.plumbing.qos import sensor_qos
from uw_dslam_ros2.ros.plumbing.sensor_inputs import check_stamp

if TYPE_CHECKING:
    from uw_dslam_ros2.io.fixes import FixLog

__all__ = ["FixInputs"]

_TYPES = {
    "sensor_msgs/msg/NavSatFix": NavSatFix,
    "geometry_msgs/msg/PoseWithCovarianceStamped": PoseWithCovarianceStamped,
    "geometry_msgs/msg/PointStamped": PointStamped,
}
_QUEUE_DEPTH = 100
_PERIOD_S = 5.0
"""Between two looks at what fixes say: each is a solution of the whole graph."""


class FixInputs:
    """Takes fixes from topics; all methods belong to one thread.

    A topic is of the vehicle whose name it begins with: ``/auv_1/usbl`` is of ``auv_1``.

    Parameters
    ----------
    node
        Whose subscriptions they are.
    topics
        None: nothing is done.
    sigma_m
        No fix is taken for surer.
    post
        Hands a function to the thread that owns this object.
    complain
        Called with what is wrong with a topic or a message.

    Raises
    ------
    ConfigError
        If there are topics, and `sigma_m` is 0.
    """

    def __init__(
        self,
        node: Node,
        topics: Sequence[str],
        sigma_m: float,
        post: Callable[[Callable[[], None]], None],
        complain: Callable[[str], None],
    ) -> None:
        if topics and not sigma_m > 0.0:
            raise ConfigError(
                f"parameter fix_sigma_m is {sigma_m}, expected metres > 0 where fix_topics names "
                "topics: how far off fixes are that agree with each other"
            )
        self._node, self._post, self._complain = node, post, complain
        self._topics = [f"/{topic.strip('/')}" for topic in topics]
        self._subscriptions: dict[str, Subscription] = {}
        self._group = ReentrantCallbackGroup()
        self._log: FixLog | None = None
        if topics:
            # What knows of places on earth is large, and most managers never meet a fix.
            from uw_dslam_ros2.io.fixes import FixLog

            self._log = FixLog(sigma_m)
        self._looked_s = float("-inf")
        self._is_new = False

    def look(self) -> None:
        """Listen to topics that are sent."""
        lacking = [topic for topic in self._topics if topic not in self._subscriptions]
        table = dict(self._node.get_topic_names_and_types()) if lacking else {}
        for topic in lacking:
            msgtype = next((name for name in table.get(topic, ()) if name in _TYPES), None)
            if msgtype is not None:
                self._subscribe(topic, msgtype)
            elif topic in table:
                self._complain(
                    f"{topic} has type {', '.join(table[topic])}, expected a fix: one of "
                    f"{', '.join(sorted(_TYPES))}"
                )

    def _subscribe(self, topic: str, msgtype: str) -> None:
        settings = SensorConfig().read_settings(topic.strip("/"), "fix", lambda _: None)
        adapter = ADAPTERS[msgtype]
        self._subscriptions[topic] = self._node.create_subscription(
            _TYPES[msgtype],
            topic,
            lambda msg: self._on_message(topic, adapter, settings, msg),
            sensor_qos(_QUEUE_DEPTH, is_reliable=False),
            callback_group=self._group,
        )
        self._node.get_logger().info(f"taking position fixes from {topic}")

    def _on_message(self, topic: str, adapter: Adapter, settings: ReadSettings, msg: Any) -> None:
        try:
            check_stamp(msg, int(self._node.get_clock().now().nanoseconds))
            events = adapter.read(msg, settings)
        except InvalidInputError as error:
            self._complain(f"bad fix on {topic}: {error}")
            return
        self._post(lambda: self._take(events))

    def _take(self, events: Sequence[Reading]) -> None:
        for event in events:
            if isinstance(event, FixEvent) and self._log is not None:
                self._log.note(event)
                self._is_new = True

    def note_change(self) -> None:
        """Submaps have changed."""
        self._is_new = True

    def due(self, submaps: Callable[[], Iterable[Submap]]) -> list[Fix]:
        """What is said of submaps; none while nothing is new, or soon after the last time."""
        now_s = time.monotonic()
        if self._log is None or not self._is_new or now_s - self._looked_s < _PERIOD_S:
            return []
        self._looked_s, self._is_new = now_s, False
        return self._log.fixes(submaps())

    def stop(self) -> None:
        """Listen no more, until `look` is called again."""
        for subscription in self._subscriptions.values():
            self._node.destroy_subscription(subscription)
        self._subscriptions.clear()
