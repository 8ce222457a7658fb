"""What people decided, which managers tell each other over an acoustic link."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from rclpy.node import Node
from std_msgs.msg import UInt8MultiArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.merging import MapQueue
from uw_dslam_ros2.core.merging.steering.told_decisions import ToldDecisions
from uw_dslam_ros2.ros.manager.link_topic import link_topic

__all__ = ["SharedDecisions"]


class _Owner(Protocol):
    @property
    def queue(self) -> MapQueue: ...

    def changed(self, message: str) -> None: ...

    def complain(self, text: str) -> None: ...


class SharedDecisions:
    """Keeps the queue's log the same as that of all vehicles; without a link it does nothing.

    Parameters
    ----------
    node
        Whose topics they are.
    link
        Namespace of the acoustic link's node; empty: there is none.
    owner
        Has the queue, and is told when its log has become another.
    post
        Hands a function to the thread that owns this object.
    """

    def __init__(
        self, node: Node, link: str, owner: _Owner, post: Callable[[Callable[[], None]], None]
    ) -> None:
        self._owner = owner
        self._told = ToldDecisions()
        self._is_worth_a_look = True
        self._output = link_topic(node, link, "decisions", post, self._take)

    def note_change(self) -> None:
        """The queue's log may be another than before."""
        self._is_worth_a_look = True

    def look(self) -> None:
        """Tell what was decided here, and take over what was decided elsewhere."""
        if self._output is None or not self._is_worth_a_look:
            return
        self._is_worth_a_look = False
        queue = self._owner.queue
        before = tuple(queue.decision_log)
        try:
            log, told = self._told.settle(queue.decision_log)
            queue.take_decisions(log)
        except InvalidInputError as error:
            self._owner.complain(f"decisions cannot be shared: {error}")
            return
        for data in told:
            self._output.publish(UInt8MultiArray(data=data))
        if tuple(log) != before:
            self._owner.changed(f"{len(log)} decisions of all vehicles")

    def _take(self, data: bytes) -> None:
        try:
            self._told.take(data)
        except InvalidInputError as error:
            self._owner.complain(f"decision refused: {error}")
            return
        self._is_worth_a_look = True
