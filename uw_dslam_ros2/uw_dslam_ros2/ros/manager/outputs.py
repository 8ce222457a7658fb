"""What a manager tells of its queue: status, the graph as markers, diagnostics, and frames."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.node import Node
from uw_dslam_msgs.msg import MergeStatus
from visualization_msgs.msg import MarkerArray

from uw_dslam_ros2.core.merging import (
    Constraint,
    ConstraintKind,
    MapQueue,
    SubmapRecord,
    SubmapState,
)
from uw_dslam_ros2.core.run_names import RunNames
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.ros.convert.graph_markers import graph_to_markers
from uw_dslam_ros2.ros.convert.merging import (
    constraint_to_msg,
    group_frame_ids,
    groups_to_msgs,
    record_to_msg,
)
from uw_dslam_ros2.ros.plumbing.frames import FrameBroadcaster, transform_to_msg
from uw_dslam_ros2.ros.plumbing.qos import LATCHED

__all__ = ["QueueFrames", "StatusPublisher"]

Values = dict[str, float | int | str]
_COUNTS = ("num_waiting", "num_merged", "num_set_aside", "num_components", "num_registrations")


class StatusPublisher:
    """Publishes ``merge_status`` and ``pose_graph``, both latched."""

    def __init__(self, node: Node, map_frame: str) -> None:
        self._node, self._map_frame = node, map_frame
        self._status_pub = node.create_publisher(MergeStatus, "merge_status", LATCHED)
        self._graph_pub = node.create_publisher(MarkerArray, "pose_graph", LATCHED)
        self.values: Values = {}
        """Of the last status, for the diagnostics."""
        self._aside: dict[str, str] = {}

    def publish(self, queue: MapQueue, num_in_flight: int, num_servers: int, message: str) -> None:
        """Tell how it stands."""
        stamp = self._node.get_clock().now().to_msg()
        records, constraints = queue.submaps(), queue.constraints()
        states = Counter(record.state for record in records)
        names = RunNames(record.submap for record in records)
        msg = MergeStatus(
            submaps=[record_to_msg(record) for record in records],
            constraints=[constraint_to_msg(constraint) for constraint in constraints],
            num_waiting=states[SubmapState.WAITING],
            num_merged=states[SubmapState.MERGED],
            num_set_aside=states[SubmapState.SET_ASIDE],
            num_components=len({record.component for record in records}),
            groups=groups_to_msgs(records, self._map_frame),
            num_registrations=queue.num_registrations,
            num_in_flight=num_in_flight,
            num_servers=num_servers,
            num_decisions=queue.num_decisions,
            message=names.in_text(message),
        )
        msg.header.stamp = stamp
        msg.header.frame_id = self._map_frame
        self._status_pub.publish(msg)
        decided = [record.decision for record in queue.decisions() if record.is_in_force]
        markers = graph_to_markers(records, constraints, self._map_frame, stamp, decided)
        self._graph_pub.publish(markers)
        self._tell_aside(records, names)
        self.values = {name: getattr(msg, name) for name in _COUNTS}
        self.values |= {"num_in_flight": num_in_flight, "num_servers": num_servers}
        self.values["num_submaps"] = len(records)
        self.values["is_growing"] = int(queue.is_growing)
        self.values["is_settled"] = int(queue.is_settled)
        self.values["map_digest"] = queue.map_digest().hex()
        self.values |= _residuals(queue, constraints)

    @property
    def aside(self) -> str:
        """Who is set aside, and why; empty: nobody is."""
        return "; ".join(f"{run}: {why}" for run, why in self._aside.items())

    def _tell_aside(self, records: Sequence[SubmapRecord], names: RunNames) -> None:
        """Say so when a run, or a part of it, is set aside, and when it is back."""
        aside: dict[str, str] = {}
        for record in records:
            if record.state is SubmapState.SET_ASIDE:
                run = names.track(record.submap.submap_id.track)
                aside.setdefault(run, names.in_text(record.reason))
        logger = self._node.get_logger()
        for run in aside.keys() - self._aside.keys():
            logger.warning(f"{run}: {aside[run]}")
        for run in self._aside.keys() - aside.keys():
            logger.info(f"{run} is not set aside any more")
        self._aside = aside


def _residuals(queue: MapQueue, constraints: Sequence[Constraint]) -> Values:
    """How well edges and cycles close."""
    edges = [c for c in constraints if c.kind is ConstraintKind.REGISTRATION]
    loops = queue.loops()
    return {
        "num_edges": sum(c.is_inlier for c in edges),
        "num_edges_unsure": sum(c.is_inlier and c.is_unsure for c in edges),
        "num_edges_rejected": sum(not c.is_inlier for c in edges),
        "num_loops": len(loops),
        "loop_error_max_m": max((loop.error_m for loop in loops), default=0.0),
        "loop_error_max_deg": math.degrees(max((loop.error_rad for loop in loops), default=0.0)),
    }


class QueueFrames:
    """Sends each group's frame -> <vehicle>/map: when the clock moves, or a new reader comes.

    A vehicle that leaves the global map gets another parent, which ends its old transform.

    Parameters
    ----------
    frame_of
        Gives the frame of a vehicle's own map, from its name and the frame of its group.
    """

    def __init__(self, node: Node, map_frame: str, frame_of: Callable[[str, str], str]) -> None:
        self._node, self._map_frame, self._frame_of = node, map_frame, frame_of
        self._broadcaster = FrameBroadcaster(node)
        self._sent: tuple[Any, ...] = ()

    def publish(self, queue: MapQueue) -> None:
        """Send what is new."""
        now = self._node.get_clock().now()
        places = self._places(queue)
        state = (now.nanoseconds, tuple(places), self._broadcaster.num_readers)
        if not places or now.nanoseconds == 0 or state == self._sent:
            return
        self._sent = state
        stamp = now.to_msg()
        self._broadcaster.send(
            *(
                transform_to_msg(stamp, frame_id, self._frame_of(name, frame_id), T)
                for frame_id, name, T in places
            )
        )

    def _places(self, queue: MapQueue) -> list[tuple[str, str, SE2]]:
        """Of each vehicle's newest run: frame of its group, vehicle, place of its map there."""
        records = queue.submaps()
        frames = group_frame_ids(records, self._map_frame)
        newest: dict[str, SubmapRecord] = {}
        for record in records:
            submap = record.submap
            is_newest_run = submap.run_id == queue.newest_run(submap.vehicle_id)
            if is_newest_run and record.state is not SubmapState.SET_ASIDE:
                newest[submap.vehicle_id] = record
        return [
            (
                frames[record.component],
                vehicle_id,
                record.T_component_submap @ record.submap.T_odom_submap.inverse(),
            )
            for vehicle_id, record in sorted(newest.items())
        ]
