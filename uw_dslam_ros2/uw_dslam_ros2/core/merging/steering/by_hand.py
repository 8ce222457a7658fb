"""What a person's decisions do to a plan, and what the plan says of them."""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Mapping

import numpy as np

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.merging.asking.plan import Plan, component_numbers
from uw_dslam_ros2.core.merging.config import INLIER_PROBABILITY
from uw_dslam_ros2.core.merging.graph.answers import Answer, AnswerBook, Query, QueryKey
from uw_dslam_ros2.core.merging.graph.components import Constraint
from uw_dslam_ros2.core.merging.graph.constraints import constraint_of
from uw_dslam_ros2.core.merging.graph.library import Library
from uw_dslam_ros2.core.merging.graph.submap_groups import SubmapGroup
from uw_dslam_ros2.core.merging.steering.decisions import Decision, DecisionKind, DecisionLog
from uw_dslam_ros2.core.merging.steering.georeference import Georeference
from uw_dslam_ros2.core.pose_graph import (
    chi2_threshold,
    compose_covariance,
    mahalanobis,
    residual,
)
from uw_dslam_ros2.core.registration.result import PriorWindow
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId, Track, track_name

__all__ = ["check_decision", "matches_by_hand", "remarks", "stated_pose"]

_NOT_PAIRWISE = DecisionKind.FORBID, DecisionKind.CONFIRM, DecisionKind.REGISTER
"""The paper's queue of maps takes nothing back, and has no graph to put a constraint into."""


def check_decision(decision: Decision, known: Container[SubmapId] | None, mode: str) -> None:
    """Refuse what a queue cannot do.

    Parameters
    ----------
    decision
        Any.
    known
        Submaps that have come; None: those that it names may come later.
    mode
        Of the queue.

    Raises
    ------
    InvalidInputError
        If it names a submap that is not known, or what a mode does not have.
    """
    for name in ("source", "target"):
        end = getattr(decision, name)
        if known is not None and end is not None and end not in known:
            raise InvalidInputError(f"decision.{name} is {end}, which was never received")
    if mode == "pairwise" and decision.kind in _NOT_PAIRWISE:
        raise InvalidInputError(
            f"decision.kind is {decision.kind.name}, expected another in mode pairwise"
        )


def matches_by_hand(
    library: Library, answers: Mapping[QueryKey, Answer], *, is_growing: bool
) -> tuple[list[Constraint], list[Query]]:
    """Constraints in windows that a person laid, and the questions that are open there.

    What is accepted in such a window is believed without checks at other places: that it lies
    there was said by somebody who looked.
    """
    book = AnswerBook(answers, is_lenient=is_growing)
    constraints: list[Constraint] = []
    wanted: list[Query] = []
    for decision, query in _questions(library):
        answer = book.find_similar(query) or book.find(query)
        if answer is None:
            wanted.append(query)
        elif answer.is_accepted:
            constraint = constraint_of(library, answer)
            ends = constraint.edge.source, constraint.edge.target
            if not library.decisions.is_forbidden(*ends, since=decision.number):
                constraints.append(constraint)
    return constraints, wanted


def stated_pose(
    answers: Iterable[Answer], source: SubmapId, target: SubmapId
) -> tuple[SE2, float, float]:
    """What the most probable answer about two submaps says, accepted or not.

    Returns
    -------
    tuple
        ``T_target_source`` of the two submaps, and its standard deviations [m], [rad].

    Raises
    ------
    InvalidInputError
        If there is no answer with a pose.
    """
    best: tuple[float, SE2, float, float] | None = None
    for answer in answers:
        query, motion = answer.query, answer.T_target_source
        for own, other, is_turned in (
            (query.source, query.target, False),
            (query.target, query.source, True),
        ):
            has_both = source in own.T_reference_submap and target in other.T_reference_submap
            if motion is None or not answer.is_finite or not has_both:
                continue
            if best is not None and answer.probability <= best[0]:
                continue
            ends = (target, source) if is_turned else (source, target)
            left = query.target.T_reference_submap[ends[1]].inverse()
            right = query.source.T_reference_submap[ends[0]]
            covariance = compose_covariance(answer.covariance, left, motion, right)
            between = left @ motion @ right
            sigma_m = math.sqrt(max(0.0, float(np.linalg.eigvalsh(covariance[:2, :2])[-1])))
            sigma_rad = math.sqrt(max(0.0, float(covariance[2, 2])))
            if is_turned:
                # The heading's error moves what is far away, seen from the other side.
                sigma_m = math.hypot(sigma_m, sigma_rad * math.hypot(between.x, between.y))
                between = between.inverse()
            best = answer.probability, between, sigma_m, sigma_rad
    if best is None:
        raise InvalidInputError(
            f"no registration of {source} with {target} has a pose; say which one is confirmed"
        )
    return best[1:]


def remarks(
    log: DecisionLog,
    library: Library,
    plan: Plan,
    answers: Mapping[QueryKey, Answer],
    georeference: Georeference | str,
    doubts: Mapping[Track, str],
) -> dict[int, str]:
    """What became of each decision, for people; empty where there is nothing to say."""
    told = {decision.number: "" for decision in log}
    placed = component_numbers(plan.components)
    questions = {decision.number: query for decision, query in _questions(library)}
    for decision in log:
        number = decision.number
        if by := log.undone_by(number):
            told[number] = f"undone by {by}"
        elif decision.kind is DecisionKind.CONFIRM:
            told[number] = _of_confirmed(decision, log, library, plan, doubts)
        elif decision.kind is DecisionKind.REGISTER:
            if decision not in log.windows:
                told[number] = "replaced by a later decision"
            elif number not in questions:
                told[number] = _why_idle(decision, library)
            else:
                answer = answers.get(questions[number].key)
                told[number] = (
                    "not answered yet"
                    if answer is None
                    else f"{answer.verdict.name}: {answer.why}"
                )
        elif decision.kind is DecisionKind.PIN:
            if decision.source != log.pin:
                told[number] = "replaced by a later decision"
            elif decision.source not in placed:
                told[number] = f"waits: {decision.source} is set aside"
        elif decision.kind is DecisionKind.FIX:
            told[number] = _of_fix(decision, georeference)
    return told


def _questions(library: Library) -> list[tuple[Decision, Query]]:
    """What is to be registered in windows that were laid by hand."""
    wholes = library.whole_groups() if any(d.is_run for d in library.decisions.windows) else {}
    found: list[tuple[Decision, Query]] = []
    for decision in library.decisions.windows:
        if any(end not in library.active for end in decision.pair):
            continue
        groups: list[SubmapGroup] = []
        for end in decision.pair:
            closed = library.closed(end.track)
            nearest = min(closed, key=lambda i: (abs(i.sequence - end.sequence), i))
            groups.append(wholes[end.track] if decision.is_run else library.window(nearest))
        if not any(map(library.why_too_large, groups)):
            window = _window(library, decision, groups)
            found.append((decision, Query(groups[0], groups[1], window)))
    return found


def _window(library: Library, decision: Decision, groups: list[SubmapGroup]) -> PriorWindow:
    """The window of a decision, between the references of what is matched."""
    assert decision.T_target_source is not None
    shifts = [
        library.odometry.T_odom_submap(end).inverse()
        @ library.odometry.T_odom_submap(group.reference)
        for end, group in zip(decision.pair, groups, strict=True)
    ]
    T_target_source = shifts[1].inverse() @ decision.T_target_source @ shifts[0]
    # A wrong heading moves what lies far from where the person laid the maps.
    arm_m = math.hypot(shifts[0].x, shifts[0].y)
    return PriorWindow(
        SE2.from_array(np.round(T_target_source.as_array(), 6)),
        decision.half_width_m + decision.half_width_rad * arm_m,
        min(decision.half_width_rad, math.pi),
    )


def _of_confirmed(
    decision: Decision,
    log: DecisionLog,
    library: Library,
    plan: Plan,
    doubts: Mapping[Track, str],
) -> str:
    if decision not in log.confirmed:
        return "replaced by a later decision"
    where = component_numbers(plan.components)
    edge = decision.edge()
    if any(end not in library.active or end not in where for end in decision.pair):
        return _why_idle(decision, library)
    parts = []
    poses = plan.components[where[edge.source]]
    left = edge.T_target_source.inverse() @ poses[edge.target].inverse() @ poses[edge.source]
    (off,) = mahalanobis(left.as_array()[None], edge.covariance[None])
    if off > chi2_threshold(INLIER_PROBABILITY):
        metres, radians = residual(edge, poses)
        parts.append(
            f"odometry or other decisions contradict it: the map is {metres:.2f} m and "
            f"{math.degrees(radians):.1f} degrees off what was confirmed"
        )
    tracks = {edge.source.track, edge.target.track}
    against = [
        c
        for c in plan.constraints
        if not c.is_inlier and {c.edge.source.track, c.edge.target.track} == tracks
    ]
    if against:
        matches = "match" if len(against) == 1 else "matches"
        parts.append(f"{len(against)} {matches} of the same runs contradict it and do not count")
    parts += [
        f"{track_name(track)} is in the map because of it, {doubts[track]}"
        for track in sorted(tracks & doubts.keys())
    ]
    return "; ".join(parts)


def _why_idle(decision: Decision, library: Library) -> str:
    idle = [str(end) for end in decision.pair if end not in library.active]
    if not idle:
        return "waits: the maps are too large, or were set aside"
    return f"waits: {' and '.join(idle)} is withdrawn, set aside, or holds nothing"


def _of_fix(decision: Decision, georeference: Georeference | str) -> str:
    if isinstance(georeference, str):
        return georeference
    fits = [fit for fit in georeference.fits if fit.fix.number == decision.number]
    if not fits:
        return "its submap is not in the map"
    (fit,) = fits
    text = f"{fit.metres_off:.2f} m off, {fit.sigmas_off:.1f} of its standard deviations"
    if fit.is_used:
        return text
    return f"set aside, for the other fixes or the map contradict it: {text}"
