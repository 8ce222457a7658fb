"""The global map on the wire: whole now and then, and the changed window in between."""

from __future__ import annotations

import time

import numpy as np
from map_msgs.msg import OccupancyGridUpdate
from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node

from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.ros.convert.core_types import (
    bytes_to_int8_array,
    occupancy_to_msg,
    stamp_to_msg,
)
from uw_dslam_ros2.ros.plumbing.qos import DEFAULT, LATCHED

__all__ = ["MapPublisher"]


class MapPublisher:
    """Publishes ``map`` (latched) and ``map_updates``.

    A map whose outline is that of the last whole one goes out as an update; the whole one, for
    those who come late, follows within `full_period_s`.
    """

    def __init__(self, node: Node, frame_id: str, full_period_s: float) -> None:
        self._frame_id = frame_id
        self._full_period_s = full_period_s
        self._map_pub = node.create_publisher(OccupancyGrid, "map", LATCHED)
        self._update_pub = node.create_publisher(OccupancyGridUpdate, "map_updates", DEFAULT)
        self.clear()

    def set_full_period(self, full_period_s: float) -> None:
        """From now on."""
        self._full_period_s = full_period_s

    def clear(self) -> None:
        """Forget what was sent: the next map goes out whole."""
        self._sent_spec: GridSpec | None = None
        self._sent_s = float("-inf")
        self._owed: OccupancyMap | None = None

    def publish(self, occupancy: OccupancyMap, changed: GridSpec, stamp_ns: int) -> None:
        """Send a map of which only the cells of the grid `changed` differ from the last one."""
        if occupancy.spec != self._sent_spec:
            self._publish_whole(occupancy, stamp_ns)
            return
        self._publish_update(occupancy, changed, stamp_ns)
        self._owed = occupancy
        self.publish_overdue(stamp_ns)

    def publish_overdue(self, stamp_ns: int) -> None:
        """Send the whole map if only updates went out for long."""
        if self._owed is not None and time.monotonic() - self._sent_s >= self._full_period_s:
            self._publish_whole(self._owed, stamp_ns)

    def _publish_whole(self, occupancy: OccupancyMap, stamp_ns: int) -> None:
        self._map_pub.publish(occupancy_to_msg(occupancy, self._frame_id, stamp_ns))
        self._sent_spec = occupancy.spec
        self._sent_s = time.monotonic()
        self._owed = None

    def _publish_update(self, occupancy: OccupancyMap, changed: GridSpec, stamp_ns: int) -> None:
        first = occupancy.spec.cells_of(changed.centers_of([[0, 0]]))[0]
        last = first + np.array(changed.shape)
        row, col = np.maximum(first, 0)
        end_row, end_col = np.minimum(last, occupancy.spec.shape)
        if end_row <= row or end_col <= col:
            return
        msg = OccupancyGridUpdate(
            x=int(col), y=int(row), width=int(end_col - col), height=int(end_row - row)
        )
        msg.header.frame_id = self._frame_id
        msg.header.stamp = stamp_to_msg(stamp_ns)
        msg.data = bytes_to_int8_array(occupancy.values[row:end_row, col:end_col])
        self._update_pub.publish(msg)
