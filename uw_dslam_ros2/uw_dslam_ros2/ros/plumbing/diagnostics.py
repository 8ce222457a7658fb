"""What a node tells on /diagnostics, once a second."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from uw_dslam_ros2.core.findings import Severity
from uw_dslam_ros2.ros.plumbing.qos import DEFAULT

__all__ = ["Diagnostics"]

Report = tuple[Severity, str, Mapping[str, float | int | str]]
"""How bad it is ("info": all is well), a sentence, and the values."""
_LEVELS = {
    "info": DiagnosticStatus.OK,
    "warning": DiagnosticStatus.WARN,
    "error": DiagnosticStatus.ERROR,
}


class Diagnostics:
    """Publishes a node's status at a steady rate, also while simulated time stands still."""

    def __init__(
        self,
        node: Node,
        make_report: Callable[[], Report],
        hardware_id: str,
        period_s: float = 1.0,
    ) -> None:
        self._node = node
        self._make_report = make_report
        self._hardware_id = hardware_id
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", DEFAULT)
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(period_s, self.publish, clock=clock)

    def publish(self) -> None:
        """Send one status now."""
        severity, text, values = self._make_report()
        status = DiagnosticStatus(
            level=_LEVELS[severity],
            name=f"{self._node.get_fully_qualified_name().lstrip('/')}: {self._node.get_name()}",
            message=text,
            hardware_id=self._hardware_id,
            values=[KeyValue(key=key, value=_text(value)) for key, value in values.items()],
        )
        msg = DiagnosticArray(status=[status])
        msg.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(msg)


def _text(value: float | int | str) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
