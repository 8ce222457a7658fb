"""State of the map queue as messages."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from uw_dslam_msgs.msg import (
    AnsweredRegistration,
    MergeGroup,
    Registration,
    SubmapInfo,
    SubmapPose,
)
from uw_dslam_msgs.msg import Constraint as ConstraintMsg

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.merging.graph.answers import Answer, Query
from uw_dslam_ros2.core.merging.graph.submap_groups import SubmapGroup
from uw_dslam_ros2.core.merging.types import (
    Constraint,
    ConstraintKind,
    SubmapRecord,
    SubmapState,
)
from uw_dslam_ros2.core.registration.result import PriorWindow, Verdict
from uw_dslam_ros2.core.run_names import RunNames
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap, SubmapId
from uw_dslam_ros2.ros.convert.core_types import (
    covariance_to_list,
    transform2d_from_msg,
    transform2d_to_msg,
)

__all__ = [
    "answer_from_msg",
    "answer_to_msg",
    "constraint_from_msg",
    "constraint_to_msg",
    "group_frame_ids",
    "groups_to_msgs",
    "record_from_msg",
    "record_to_msg",
]


def record_to_msg(record: SubmapRecord) -> SubmapInfo:
    """What the queue knows of one submap."""
    return SubmapInfo(
        vehicle_id=record.submap.vehicle_id,
        run_id=int(record.submap.run_id),
        sequence=int(record.submap.sequence),
        revision=int(record.submap.revision),
        is_final=bool(record.submap.is_final),
        state=int(record.state),
        component=int(record.component),
        t_component_submap=transform2d_to_msg(record.T_component_submap),
        num_tries=int(record.num_tries),
        reason=record.reason,
    )


def record_from_msg(msg: SubmapInfo, submap: Submap) -> SubmapRecord:
    """What the queue knows of a submap that was asked for besides.

    Raises
    ------
    InvalidInputError
        If the state is none.
    """
    if msg.state not in {int(state) for state in SubmapState}:
        raise InvalidInputError(f"submap_info.state is {msg.state}, expected one of SubmapInfo's")
    return SubmapRecord(
        submap,
        SubmapState(msg.state),
        int(msg.component),
        transform2d_from_msg(msg.t_component_submap, "submap_info.t_component_submap"),
        int(msg.num_tries),
        msg.reason,
    )


def constraint_from_msg(msg: ConstraintMsg) -> Constraint:
    """One edge of the pose graph.

    Raises
    ------
    InvalidInputError
        If its kind is none, or its motion not finite.
    """
    if msg.kind not in {int(kind) for kind in ConstraintKind}:
        raise InvalidInputError(f"constraint.kind is {msg.kind}, expected one of Constraint's")
    return Constraint(
        ConstraintKind(msg.kind),
        SubmapId(msg.source_vehicle_id, int(msg.source_run_id), int(msg.source_sequence)),
        SubmapId(msg.target_vehicle_id, int(msg.target_run_id), int(msg.target_sequence)),
        transform2d_from_msg(msg.t_target_source, "constraint.t_target_source"),
        np.array(msg.covariance, dtype=np.float64).reshape(3, 3),
        float(msg.residual_m),
        float(msg.residual_rad),
        bool(msg.is_inlier),
        bool(msg.is_unsure),
    )


def answer_to_msg(answer: Answer, is_used: bool) -> AnsweredRegistration:
    """One answer of the queue's."""
    prior, numbers = answer.query.prior, answer.numbers
    msg = AnsweredRegistration(has_prior=prior is not None, is_used=bool(is_used))
    for name in ("source", "target"):
        group: SubmapGroup = getattr(answer.query, name)
        setattr(msg, name, [_submap_pose(i, T) for i, T in group.T_reference_submap.items()])
        setattr(msg, f"{name}_reference", group.ids.index(group.reference))
    if prior is not None:
        msg.prior = transform2d_to_msg(prior.T_target_source)
        msg.prior_half_width_m = float(prior.half_width_m)
        msg.prior_half_width_rad = float(prior.half_width_rad)
    msg.answer = Registration(verdict=int(answer.verdict), reason=answer.why)
    msg.answer.t_target_source = transform2d_to_msg(answer.T_target_source)
    msg.answer.covariance = covariance_to_list(answer.covariance)
    msg.answer.probability = float(answer.probability)
    for name in _ANSWER_FLOATS:
        setattr(msg.answer, name, float(numbers.get(name, math.nan)))
    upper = numbers.get("upper_bound", math.nan)
    msg.answer.gap = (upper - numbers.get("lower_bound", math.nan)) / upper if upper else math.nan
    msg.answer.seconds = math.nan
    msg.answer.is_certified = bool(numbers.get("is_certified", False))
    for name in _ANSWER_COUNTS:
        setattr(msg.answer, name, int(numbers.get(name, 0)))
    return msg


def answer_from_msg(msg: AnsweredRegistration) -> tuple[Answer, bool]:
    """One answer, and whether it holds.

    Raises
    ------
    InvalidInputError
        If a reference or the verdict is none.
    """
    if msg.answer.verdict not in {int(verdict) for verdict in Verdict}:
        raise InvalidInputError(f"answer.verdict is {msg.answer.verdict}, expected Registration's")
    prior = None
    if msg.has_prior:
        prior = PriorWindow(
            transform2d_from_msg(msg.prior, "prior"),
            float(msg.prior_half_width_m),
            float(msg.prior_half_width_rad),
        )
    groups = [
        _group_from_msg(getattr(msg, name), int(getattr(msg, f"{name}_reference")), name)
        for name in ("source", "target")
    ]
    found = msg.answer.t_target_source
    has_pose = all(math.isfinite(value) for value in (found.x, found.y, found.yaw))
    numbers = {name: float(getattr(msg.answer, name)) for name in _ANSWER_FLOATS}
    numbers = {name: value for name, value in numbers.items() if math.isfinite(value)}
    numbers["is_certified"] = float(msg.answer.is_certified)
    numbers |= {name: float(getattr(msg.answer, name)) for name in _ANSWER_COUNTS}
    answer = Answer(
        Query(groups[0], groups[1], prior),
        Verdict(msg.answer.verdict),
        msg.answer.reason,
        transform2d_from_msg(found, "answer.t_target_source") if has_pose else None,
        np.array(msg.answer.covariance, dtype=np.float64).reshape(3, 3),
        float(msg.answer.probability),
        numbers,
    )
    return answer, bool(msg.is_used)


_ANSWER_FLOATS = (
    "score", "lower_bound", "upper_bound", "overlap", "conflict_ratio", "inlier_ratio",
)  # fmt: skip
_ANSWER_COUNTS = ("num_boxes", "num_source_points", "num_target_points")


def _submap_pose(submap_id: SubmapId, motion: SE2) -> SubmapPose:
    return SubmapPose(
        vehicle_id=submap_id.vehicle_id,
        run_id=int(submap_id.run_id),
        sequence=int(submap_id.sequence),
        t_frame_submap=transform2d_to_msg(motion),
    )


def _group_from_msg(poses: Sequence[SubmapPose], reference: int, name: str) -> SubmapGroup:
    members = {
        SubmapId(p.vehicle_id, int(p.run_id), int(p.sequence)): transform2d_from_msg(
            p.t_frame_submap, f"{name}.t_frame_submap"
        )
        for p in poses
    }
    if not 0 <= reference < len(members):
        raise InvalidInputError(
            f"{name}_reference is {reference}, expected an index of {len(members)} submaps"
        )
    # Equal groups have equal keys; what the queue's own key is, the message does not say.
    key = repr([(str(i), T) for i, T in members.items()]).encode()
    return SubmapGroup(list(members)[reference], members, key)


def group_frame_ids(records: Sequence[SubmapRecord], map_frame: str) -> dict[int, str]:
    """Frame of each group: the map's own, or one that is named after its first vehicle and run."""
    names = RunNames(record.submap for record in records)
    frames = {0: map_frame}
    for record in records:
        first = names.file(record.submap.submap_id.track)
        frames.setdefault(record.component, f"{map_frame}_{first}")
    return frames


def groups_to_msgs(records: Sequence[SubmapRecord], map_frame: str) -> list[MergeGroup]:
    """Which submaps share a frame, by component."""
    members: dict[int, list[SubmapRecord]] = {}
    for record in records:
        members.setdefault(record.component, []).append(record)
    frames = group_frame_ids(records, map_frame)
    return [
        MergeGroup(
            component=component,
            frame_id=frames[component],
            vehicle_ids=sorted({record.submap.vehicle_id for record in own}),
            num_submaps=len(own),
        )
        for component, own in sorted(members.items())
    ]


def constraint_to_msg(constraint: Constraint) -> ConstraintMsg:
    """One edge of the pose graph."""
    return ConstraintMsg(
        kind=int(constraint.kind),
        source_vehicle_id=constraint.source.vehicle_id,
        source_run_id=int(constraint.source.run_id),
        source_sequence=int(constraint.source.sequence),
        target_vehicle_id=constraint.target.vehicle_id,
        target_run_id=int(constraint.target.run_id),
        target_sequence=int(constraint.target.sequence),
        t_target_source=transform2d_to_msg(constraint.T_target_source),
        covariance=covariance_to_list(constraint.covariance),
        residual_m=float(constraint.residual_m),
        residual_rad=float(constraint.residual_rad),
        is_inlier=bool(constraint.is_inlier),
        is_unsure=bool(constraint.is_unsure),
    )
