"""What the queue says of each submap: where it is, and why."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet

from uw_dslam_ros2.core.merging.asking.plan import Plan, component_numbers
from uw_dslam_ros2.core.merging.graph.answers import Answer
from uw_dslam_ros2.core.merging.graph.components import Component
from uw_dslam_ros2.core.merging.graph.submap_groups import StoredSubmap
from uw_dslam_ros2.core.merging.types import (
    Constraint,
    ConstraintKind,
    Edge,
    SubmapRecord,
    SubmapState,
)
from uw_dslam_ros2.core.pose_graph import residual
from uw_dslam_ros2.core.submap import SubmapId, Track

__all__ = ["constraints_of", "records_of"]


def records_of(
    submaps: Mapping[SubmapId, StoredSubmap],
    withdrawn: AbstractSet[SubmapId],
    plan: Plan,
    anchor: SubmapId | None,
    answers: Sequence[Answer],
    aside: Mapping[SubmapId, str],
    undrawn: Mapping[SubmapId, str],
    confirmed: Sequence[Edge],
) -> list[SubmapRecord]:
    """All submaps, by vehicle, run and sequence.

    `aside` and `undrawn` are those that are set aside, and those that are not in the map although
    they are joined, with the reasons; `confirmed` is what a person says.
    """
    is_pinned = bool(plan.components) and anchor in plan.components[0]
    components = [*plan.components, *_groups_aside(submaps, aside)]
    first = 0 if is_pinned else 1
    number = component_numbers(components)
    tries = _num_tries(answers)
    # The same for all submaps of a track, and there are many of them.
    why_merged = functools.cache(lambda track: _merge_reason(track, anchor, plan, confirmed))
    why_waiting = functools.cache(lambda track: _wait_reason(track, answers))
    records = []
    for submap_id in sorted(submaps):
        component = first + number[submap_id]
        if submap_id in withdrawn:
            state, reason = SubmapState.WITHDRAWN, "taken out by a person"
        elif submap_id in aside:
            state, reason = SubmapState.SET_ASIDE, aside[submap_id]
        elif component == 0:
            state, reason = SubmapState.MERGED, why_merged(submap_id.track)
            if submap_id == anchor:
                reason = "pins the global frame"
            if submap_id in undrawn:
                reason = f"{reason}; {undrawn[submap_id]}"
        else:
            state, reason = SubmapState.WAITING, why_waiting(submap_id.track)
        records.append(
            SubmapRecord(
                submaps[submap_id].submap,
                state,
                component,
                components[number[submap_id]][submap_id],
                tries.get(submap_id.track, 0),
                reason,
            )
        )
    return records


def _groups_aside(
    submaps: Mapping[SubmapId, StoredSubmap], aside: Iterable[SubmapId]
) -> list[Component]:
    """What is set aside, each run in the frame of its first submap, by its odometry."""
    groups: list[Component] = []
    for _, ids in itertools.groupby(sorted(aside), key=lambda submap_id: submap_id.track):
        poses = {i: submaps[i].submap.T_odom_submap for i in ids}
        T_first_odom = next(iter(poses.values())).inverse()
        groups.append({i: T_first_odom @ T_odom_submap for i, T_odom_submap in poses.items()})
    return groups


def constraints_of(plan: Plan, confirmed: Sequence[Edge]) -> list[Constraint]:
    """All edges of the pose graph with what is left of them after optimisation."""
    where = component_numbers(plan.components)
    found: list[Constraint] = []
    edges = [(ConstraintKind.ODOMETRY, edge, True, False) for edge in plan.odometry]
    edges += [
        (ConstraintKind.REGISTRATION, constraint.edge, constraint.is_inlier, constraint.is_unsure)
        for constraint in plan.constraints
    ]
    edges += [
        (ConstraintKind.CONFIRMED, edge, True, False)
        for edge in confirmed
        if edge.source in where and edge.target in where
    ]
    for kind, edge, is_inlier, is_unsure in edges:
        is_joined = where[edge.source] == where[edge.target]
        poses = plan.components[where[edge.source]] if is_joined else {}
        found.append(
            Constraint(
                kind,
                edge.source,
                edge.target,
                edge.T_target_source,
                edge.covariance,
                *residual(edge, poses),
                is_inlier,
                is_unsure,
            )
        )
    return found


def _merge_reason(
    track: Track, anchor: SubmapId | None, plan: Plan, confirmed: Sequence[Edge]
) -> str:
    assert anchor is not None
    if track == anchor.track:
        return "odometry from the submap that pins the global frame"
    own = [
        constraint
        for constraint in plan.constraints
        if constraint.is_inlier
        and track in (constraint.edge.source.track, constraint.edge.target.track)
    ]
    edges = [constraint.edge for constraint in own]
    by_hand = [e for e in confirmed if track in (e.source.track, e.target.track)]
    ends = {i for edge in edges or by_hand for i in (edge.source, edge.target)}
    partners = {i.track for i in ends} - {track}
    names = sorted({t.vehicle_id for t in partners if t.vehicle_id != track.vehicle_id})
    if any(t.vehicle_id == track.vehicle_id for t in partners):
        names.append("another run of its own")
    reason = f"registered with {', '.join(names)}"
    if by_hand and not own:
        reason = f"laid on {', '.join(names)} by a person"
    if own and all(constraint.is_unsure for constraint in own):
        reason += ", by several answers that are unsure alone and agree"
    return reason


def _wait_reason(track: Track, answers: Sequence[Answer]) -> str:
    reasons = [
        answer.why
        for answer in answers
        if not answer.is_accepted
        and track in (answer.query.source.reference.track, answer.query.target.reference.track)
    ]
    return reasons[-1] if reasons else "not matched yet"


def _num_tries(answers: Sequence[Answer]) -> dict[Track, int]:
    tries: dict[Track, int] = {}
    for answer in answers:
        for group in (answer.query.source, answer.query.target):
            for track in {submap_id.track for submap_id in group.ids}:
                tries[track] = tries.get(track, 0) + 1
    return tries
