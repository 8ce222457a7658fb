"""Maps of the groups of vehicles that are not joined with the global map."""

from __future__ import annotations

import re
from collections.abc import Sequence

from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node
from rclpy.publisher import Publisher

from uw_dslam_ros2.core.grid import MAX_MAP_SIDE
from uw_dslam_ros2.core.merging import SubmapRecord, SubmapState
from uw_dslam_ros2.core.merging.config import LOG_ODDS_MAX
from uw_dslam_ros2.core.merging.drawn.global_map import Piece, draw_pieces, pinned_lattice
from uw_dslam_ros2.core.mosaic import Mosaic
from uw_dslam_ros2.ros.convert.core_types import occupancy_to_msg, stamp_to_msg
from uw_dslam_ros2.ros.convert.merging import group_frame_ids
from uw_dslam_ros2.ros.plumbing.qos import LATCHED

__all__ = ["GroupMaps"]

_NOT_IN_A_NAME = re.compile(r"[^A-Za-z0-9_/]")


class GroupMaps:
    """Publishes each group's map, latched, on a topic that is called like its frame.

    So nobody vanishes from view who is not joined yet. The map of a group that is joined, or all
    of whose submaps are withdrawn or set aside, is followed by an empty one.
    """

    def __init__(self, node: Node, map_frame: str) -> None:
        self._node, self._map_frame = node, map_frame
        self._publishers: dict[str, Publisher] = {}
        self._drawn: dict[str, Mosaic] = {}

    def publish(self, records: Sequence[SubmapRecord], stamp_ns: int) -> None:
        """Send what has changed."""
        frames = group_frame_ids(records, self._map_frame)
        shown: dict[str, list[SubmapRecord]] = {}
        for record in records:
            is_out = record.state in (SubmapState.WITHDRAWN, SubmapState.SET_ASIDE)
            if record.component != 0 and not is_out:
                shown.setdefault(frames[record.component], []).append(record)
        for frame_id in self._drawn.keys() - shown.keys():
            del self._drawn[frame_id]
            self._send(frame_id, _empty(frame_id, stamp_ns))
        for frame_id, group in shown.items():
            mosaic = self._draw(frame_id, group)
            window = mosaic.window()
            is_changed = mosaic.take_changed() is not None
            if is_changed and window is not None and max(window.shape) <= MAX_MAP_SIDE:
                occupancy = mosaic.occupancy(LOG_ODDS_MAX)
                if occupancy is not None:
                    self._send(frame_id, occupancy_to_msg(occupancy, frame_id, stamp_ns))

    def clear(self) -> None:
        """Forget what was drawn: the submaps are others now."""
        for frame_id in self._drawn:
            self._send(frame_id, _empty(frame_id, 0))
        self._drawn.clear()

    def _draw(self, frame_id: str, group: Sequence[SubmapRecord]) -> Mosaic:
        spec = group[0].submap.grid.spec
        lattice = pinned_lattice(spec, spec.resolution_m)
        mosaic = self._drawn.get(frame_id)
        if mosaic is None or mosaic.lattice != lattice:
            mosaic = self._drawn[frame_id] = Mosaic(lattice)
        pieces = {}
        for record in group:
            submap = record.submap
            pieces[submap.submap_id] = Piece(
                submap.grid,
                record.T_component_submap,
                version=submap.revision,
                radius_m=submap.grid.spec.reach_m,
            )
        draw_pieces(mosaic, pieces)
        return mosaic

    def _send(self, frame_id: str, msg: OccupancyGrid) -> None:
        if frame_id not in self._publishers:
            topic = _NOT_IN_A_NAME.sub("_", frame_id)
            self._publishers[frame_id] = self._node.create_publisher(OccupancyGrid, topic, LATCHED)
            self._node.get_logger().info(f"the map of a group that is not joined: {topic}")
        self._publishers[frame_id].publish(msg)


def _empty(frame_id: str, stamp_ns: int) -> OccupancyGrid:
    msg = OccupancyGrid()
    msg.header.frame_id = frame_id
    msg.header.stamp = stamp_to_msg(stamp_ns)
    return msg
