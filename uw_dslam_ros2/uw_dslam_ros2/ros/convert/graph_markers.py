"""Markers of the pose graph for RViz."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

from builtin_interfaces.msg import Duration as DurationMsg
from builtin_interfaces.msg import Time as TimeMsg
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from uw_dslam_ros2.core.merging import Decision, DecisionKind
from uw_dslam_ros2.core.merging.types import (
    Constraint,
    ConstraintKind,
    SubmapRecord,
    SubmapState,
)
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId

__all__ = ["graph_to_markers"]

_NODE_SIZE_M = 0.8
_LINE_WIDTH_M = 0.15
_TEXT_HEIGHT_M = 1.2
_ODOMETRY_COLOR = (0.6, 0.6, 0.6, 1.0)
_INLIER_COLOR = (0.1, 0.7, 0.2, 1.0)
_UNSURE_COLOR = (0.95, 0.75, 0.1, 1.0)
_OUTLIER_COLOR = (0.9, 0.1, 0.1, 0.6)
_VEHICLE_COLORS = (
    (0.12, 0.47, 0.71, 1.0),
    (1.00, 0.50, 0.05, 1.0),
    (0.58, 0.40, 0.74, 1.0),
    (0.09, 0.75, 0.81, 1.0),
    (0.89, 0.47, 0.76, 1.0),
    (0.74, 0.74, 0.13, 1.0),
)
_DECIDED_COLOR = (0.80, 0.47, 0.65, 1.0)
_DASH_M = 0.6
_CROSS_M = 0.8


def graph_to_markers(
    records: Iterable[SubmapRecord],
    constraints: Iterable[Constraint],
    frame_id: str,
    stamp: TimeMsg,
    decisions: Sequence[Decision] = (),
) -> MarkerArray:
    """Merged submaps as spheres in their vehicle's colour, edges as lines.

    Odometry is grey, registrations are green, yellow where the answer was unsure alone, red where
    rejected. What a person decided has dashes and marks of its own: a cube on what is confirmed, a
    cross on what is forbidden, a word where the frame is pinned and where a fix is.

    Parameters
    ----------
    records, constraints
        As `MapQueue` gives them.
    frame_id, stamp
        Of all markers.
    decisions
        Those in force.
    """
    merged = {
        record.submap.submap_id: record.T_component_submap
        for record in records
        if record.component == 0 and record.state == SubmapState.MERGED
    }
    markers = [_marker(frame_id, stamp, "clear", 0, Marker.DELETEALL)]
    vehicles = sorted({submap_id.vehicle_id for submap_id in merged})
    for index, vehicle_id in enumerate(vehicles):
        color = _VEHICLE_COLORS[index % len(_VEHICLE_COLORS)]
        nodes = _marker(frame_id, stamp, "submaps", index, Marker.ADD, Marker.SPHERE_LIST)
        nodes.scale.x = nodes.scale.y = nodes.scale.z = _NODE_SIZE_M
        nodes.color = _color(color)
        nodes.points = [_point(T) for i, T in merged.items() if i.vehicle_id == vehicle_id]
        label = _marker(frame_id, stamp, "names", index, Marker.ADD, Marker.TEXT_VIEW_FACING)
        first = min(submap_id for submap_id in merged if submap_id.vehicle_id == vehicle_id)
        label.pose.position.x = merged[first].x
        label.pose.position.y = merged[first].y
        label.pose.position.z = _TEXT_HEIGHT_M
        label.scale.z = _TEXT_HEIGHT_M
        label.color = _color(color)
        label.text = vehicle_id
        markers += [nodes, label]
    markers += _edge_markers(constraints, merged, frame_id, stamp)
    markers += _decision_markers(decisions, merged, frame_id, stamp)
    return MarkerArray(markers=markers)


def _edge_markers(
    constraints: Iterable[Constraint],
    merged: Mapping[SubmapId, SE2],
    frame_id: str,
    stamp: TimeMsg,
) -> list[Marker]:
    lines: dict[str, tuple[tuple[float, float, float, float], list[Point]]] = {
        "odometry": (_ODOMETRY_COLOR, []),
        "registrations": (_INLIER_COLOR, []),
        "unsure": (_UNSURE_COLOR, []),
        "rejected": (_OUTLIER_COLOR, []),
        "confirmed": (_DECIDED_COLOR, []),
    }
    for constraint in constraints:
        if constraint.source not in merged or constraint.target not in merged:
            continue
        ends = merged[constraint.source], merged[constraint.target]
        if constraint.kind == ConstraintKind.CONFIRMED:
            lines["confirmed"][1].extend(_dashes(*ends))
            continue
        name = "odometry" if constraint.kind == ConstraintKind.ODOMETRY else "registrations"
        if constraint.is_unsure:
            name = "unsure"
        points = lines[name if constraint.is_inlier else "rejected"][1]
        points += [_point(ends[0]), _point(ends[1])]
    markers = []
    for index, (name, (color, points)) in enumerate(lines.items()):
        if points:
            marker = _marker(frame_id, stamp, name, index, Marker.ADD, Marker.LINE_LIST)
            marker.scale.x = _LINE_WIDTH_M
            marker.color = _color(color)
            marker.points = points
            markers.append(marker)
    return markers


def _dashes(start: SE2, end: SE2) -> list[Point]:
    """Ends of the dashes of a line."""
    length_m = math.hypot(end.x - start.x, end.y - start.y)
    count = max(1, round(0.5 * length_m / _DASH_M))
    places = []
    for index in range(2 * count):
        share = index / (2 * count - 1)
        x, y = start.x + share * (end.x - start.x), start.y + share * (end.y - start.y)
        places.append(Point(x=x, y=y, z=0.0))
    return places


def _decision_markers(
    decisions: Sequence[Decision],
    merged: Mapping[SubmapId, SE2],
    frame_id: str,
    stamp: TimeMsg,
) -> list[Marker]:
    markers = []
    for decision in decisions:
        source, target = merged.get(decision.source), merged.get(decision.target)  # type: ignore[arg-type]
        if source is None:
            continue
        number, kind = decision.number, decision.kind
        if target is not None and kind in (DecisionKind.CONFIRM, DecisionKind.FORBID):
            middle = SE2(0.5 * (source.x + target.x), 0.5 * (source.y + target.y))
            is_confirmed = kind is DecisionKind.CONFIRM
            shape = Marker.CUBE if is_confirmed else Marker.LINE_LIST
            mark = _marker(frame_id, stamp, "decisions", number, Marker.ADD, shape)
            if is_confirmed:
                mark.pose.position = _point(middle)
                mark.pose.orientation.z = math.sin(math.pi / 8.0)
                mark.pose.orientation.w = math.cos(math.pi / 8.0)
                mark.scale.x = mark.scale.y = mark.scale.z = _NODE_SIZE_M
            else:
                mark.scale.x = 2.0 * _LINE_WIDTH_M
                for side in (1.0, -1.0):
                    arm = SE2(_CROSS_M / 2.0, side * _CROSS_M / 2.0)
                    mark.points += [_point(middle @ arm), _point(middle @ arm.inverse())]
        elif kind in (DecisionKind.PIN, DecisionKind.FIX):
            text = Marker.TEXT_VIEW_FACING
            mark = _marker(frame_id, stamp, "decisions", number, Marker.ADD, text)
            mark.pose.position = _point(source @ SE2(*decision.point))
            mark.scale.z = _TEXT_HEIGHT_M
            mark.text = "pinned" if kind is DecisionKind.PIN else "fix"
        else:
            continue
        mark.color = _color(_DECIDED_COLOR)
        markers.append(mark)
    return markers


def _marker(
    frame_id: str, stamp: TimeMsg, namespace: str, number: int, action: int, kind: int = 0
) -> Marker:
    marker = Marker(ns=namespace, id=number, action=action, type=kind, lifetime=DurationMsg())
    marker.header.frame_id = frame_id
    marker.header.stamp = stamp
    return marker


def _color(rgba: tuple[float, float, float, float]) -> ColorRGBA:
    return ColorRGBA(r=rgba[0], g=rgba[1], b=rgba[2], a=rgba[3])


def _point(T_map_submap: SE2) -> Point:
    return Point(x=T_map_submap.x, y=T_map_submap.y, z=0.0)
