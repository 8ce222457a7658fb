"""What cannot be right is set aside, with a reason: until a later revision, or others, mend it."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.merging.graph.answers import Answer, QueryKey
from uw_dslam_ros2.core.merging.graph.components import Component, Constraint
from uw_dslam_ros2.core.merging.graph.constraints import constraint_of
from uw_dslam_ros2.core.merging.graph.library import Library
from uw_dslam_ros2.core.merging.graph.memory import Memory
from uw_dslam_ros2.core.merging.graph.submap_groups import StoredSubmap
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap, SubmapId, Track

__all__ = ["Contest", "contested_track", "contradicting_track", "implausible_submaps"]

_SLACK_S = 1.0
"""Between the last ping of a submap and the first of the next one, beside what stamps say."""
_SIGMAS = 5.0
_MIN_TRACKS = 3
_MIN_BROKEN = 3
_LEAST_ODDS = 3.0
"""By which a place must be more likely than the next one; as `max_false_accept` of 0.25 says."""
_SURE = 0.97
"""A place that is likelier than that by itself is not contested: what most matches say counts."""
_ELSEWHERE_SHARE, _ELSEWHERE_RAD = 0.2, 0.35
"""Beyond this share of a submap's radius, or this turn, a pose is another place and no bend."""


@dataclass(frozen=True, slots=True)
class Contest:
    """A run that matches put in two places, and how far apart these are."""

    track: Track
    distance_m: float


def implausible_submaps(
    submaps: Mapping[SubmapId, StoredSubmap], max_speed_m_s: float, memory: Memory
) -> dict[SubmapId, str]:
    """Submaps that their run's odometry puts where the vehicle cannot have been, and why.

    A run is cut where it leaps further than the time in between and the covariance allow; its
    longest piece is believed, of equal ones the first.
    """
    found: dict[SubmapId, str] = {}
    for _, ids in itertools.groupby(sorted(submaps), key=lambda submap_id: submap_id.track):
        pieces: list[list[SubmapId]] = []
        reasons: list[str] = []
        for submap_id in ids:
            why = ""
            if pieces:
                before, after = submaps[pieces[-1][-1]], submaps[submap_id]
                key = ("leap", before.fingerprint, after.fingerprint, submap_id)
                work = functools.partial(_leap, before.submap, after.submap, max_speed_m_s)
                why = memory.remember(key, work)
            if why or not pieces:
                pieces.append([])
                reasons.append(why)
            pieces[-1].append(submap_id)
        kept = max(range(len(pieces)), key=lambda index: (len(pieces[index]), -index))
        for index, piece in enumerate(pieces):
            if index != kept:
                # The leap that parts it from what is believed.
                why = reasons[index] if index > kept else reasons[index + 1]
                found |= dict.fromkeys(piece, f"set aside: {why}")
    return found


def contradicting_track(
    library: Library, constraints: Sequence[Constraint], anchor: SubmapId
) -> Track | None:
    """The run that contradicts the rest, if there is one.

    Most of its own matches do not hold, or more of the others' would hold without it than it has
    itself. A single false match makes nobody a liar, and of two that are blamed alike nobody knows
    which one is.

    Parameters
    ----------
    library
        All submaps.
    constraints
        Of a plan in which nothing is open, and what became of them.
    anchor
        Any submap to solve the graph from.
    """
    outliers = [constraint for constraint in constraints if not constraint.is_inlier]
    tracks = {track for constraint in constraints for track in _ends(constraint)}
    if not outliers or len(tracks) < _MIN_TRACKS:
        return None
    blame: dict[Track, int] = {}
    for track in sorted({track for constraint in outliers for track in _ends(constraint)}):
        own = [constraint for constraint in constraints if track in _ends(constraint)]
        held = _num_inliers(own)
        if len(outliers) < max(_MIN_BROKEN, held + 1):
            continue  # even if all of them were its fault
        others = [constraint for constraint in constraints if track not in _ends(constraint)]
        solved = [c for c in library.solve(anchor, others)[0] if track not in _ends(c)]
        broken = len(own) - held + _num_inliers(solved) - _num_inliers(others)
        if broken >= _MIN_BROKEN and broken > held:
            blame[track] = broken - held
    worst = [track for track in blame if blame[track] == max(blame.values())]
    return worst[0] if len(worst) == 1 else None


def contested_track(
    library: Library,
    constraints: Sequence[Constraint],
    answers: Iterable[Answer],
    components: Sequence[Component],
) -> Contest | None:
    """The run that accepted matches put somewhere else about as likely as where it is.

    A graph keeps what most matches say. But matches of one submap with ten views of one place are
    one opinion, not ten: the submap looks like that place. So of all matches of each of the
    run's own submaps the most probable one counts, and submaps count together. Where the place
    that the graph has chosen is neither sure by itself nor clearly ahead, nobody knows where the
    run is.

    Parameters
    ----------
    library
        All submaps.
    constraints
        Of a plan in which nothing is open, and what became of them.
    answers
        Everything that was asked: what the checks of a match did not confirm was accepted all the
        same.
    components
        Poses by these constraints.
    """
    held = [c for c in constraints if c.is_inlier and _is_between_tracks(c)]
    against = _accepted_beside(library, answers, {c.key for c in held})
    found: list[tuple[float, Contest]] = []
    for component in components:
        here = [c for c in against if c.edge.source in component and c.edge.target in component]
        for track in sorted({track for c in here for track in _ends(c)}):
            rival, distance_m = _rival_place(
                library, component, track, [c for c in here if track in _ends(c)]
            )
            if not rival:
                continue
            own = [c for c in held if track in _ends(c)]
            log_odds = _log_odds(own, track), _log_odds(rival, track)
            lead = log_odds[0] - log_odds[1]
            if log_odds[0] < _logit(_SURE) and lead < math.log(_LEAST_ODDS):
                found.append((lead, Contest(track, distance_m)))
    if not found:
        return None
    # Where both sides of a match are in doubt alike, one of them stays.
    least = min(lead for lead, _ in found)
    return max((one for lead, one in found if lead == least), key=lambda one: one.track)


def _accepted_beside(
    library: Library, answers: Iterable[Answer], held: Container[QueryKey]
) -> list[Constraint]:
    """What was accepted between runs and does not hold."""
    beside = [
        answer
        for answer in answers
        if answer.is_accepted and answer.query.key not in held and library.holds(answer.query)
    ]
    beside.sort(key=lambda answer: answer.query.key)
    found = (constraint_of(library, answer) for answer in beside)
    return [constraint for constraint in found if _is_between_tracks(constraint)]


def _is_between_tracks(constraint: Constraint) -> bool:
    return constraint.edge.source.track != constraint.edge.target.track


def _rival_place(
    library: Library, component: Component, track: Track, others: Sequence[Constraint]
) -> tuple[list[Constraint], float]:
    """The matches that agree on the most likely other place of a run, and how far away it is."""
    best: tuple[float, list[Constraint], float] = (0.0, [], 0.0)
    moves = [(_own_end(c, track), _move(component, c, track), c) for c in others]
    away = [move for move in moves if _is_elsewhere(library, component, move[0], move[1])]
    for end, move, _ in away:
        back = move.inverse()
        same = [(e, c) for e, m, c in away if not _is_elsewhere(library, component, e, back @ m)]
        rival = [c for _, c in same]
        log_odds = _log_odds(rival, track)
        if log_odds > best[0]:
            best = log_odds, rival, component[end].distance_to(move @ component[end])[0]
    return best[1], best[2]


def _move(component: Component, constraint: Constraint, track: Track) -> SE2:
    """How the whole run would have to move for a match to hold."""
    edge = constraint.edge
    if edge.target.track == track:
        edge = edge.reversed()
    return component[edge.target] @ edge.T_target_source @ component[edge.source].inverse()


def _is_elsewhere(library: Library, component: Component, submap_id: SubmapId, move: SE2) -> bool:
    """Whether a move takes a submap to another place, beyond what maps bend."""
    way_m, turn_rad = component[submap_id].distance_to(move @ component[submap_id])
    reach_m = _ELSEWHERE_SHARE * library.submaps[submap_id].radius_m
    return way_m > reach_m or turn_rad > _ELSEWHERE_RAD


def _own_end(constraint: Constraint, track: Track) -> SubmapId:
    edge = constraint.edge
    return edge.source if edge.source.track == track else edge.target


def _log_odds(constraints: Sequence[Constraint], track: Track) -> float:
    """What a run's own submaps say together, each by its most probable match."""
    best: dict[SubmapId, float] = {}
    for constraint in constraints:
        end = _own_end(constraint, track)
        best[end] = max(best.get(end, 0.5), constraint.probability)
    return sum(_logit(probability) for probability in best.values())


def _logit(probability: float) -> float:
    return math.log(probability / max(1.0 - probability, 1e-9))


def _ends(constraint: Constraint) -> tuple[Track, Track]:
    return constraint.edge.source.track, constraint.edge.target.track


def _num_inliers(constraints: Sequence[Constraint]) -> int:
    return sum(constraint.is_inlier for constraint in constraints)


def _leap(before: Submap, after: Submap, max_speed_m_s: float) -> str:
    """Why the way from one submap to the next is impossible; empty where it is not.

    Without paths nothing is known of the way: pieces of others' maps lie anywhere.
    """
    if not len(before.trajectory) or not len(after.trajectory):
        return ""
    end_ns, T_odom_end = _pose(before, -1)
    start_ns, T_odom_start = _pose(after, 0)
    way_m = math.hypot(T_odom_start.x - T_odom_end.x, T_odom_start.y - T_odom_end.y)
    seconds = max(0.0, (start_ns - end_ns) * 1e-9)
    variance = float(np.linalg.eigvalsh(np.asarray(after.covariance)[:2, :2])[-1])
    sigma_m = math.sqrt(max(0.0, variance) * (after.sequence - before.sequence))
    if way_m <= max_speed_m_s * (seconds + _SLACK_S) + _SIGMAS * sigma_m:
        return ""
    return (
        f"odometry leaps {way_m:.0f} m in {seconds:.0f} s from {before.submap_id} to "
        f"{after.submap_id}, expected at most {max_speed_m_s:g} m/s"
    )


def _pose(submap: Submap, index: int) -> tuple[int, SE2]:
    poses: NDArray[np.float64] = submap.trajectory
    T_odom_base = submap.T_odom_submap @ SE2.from_array(poses[index])
    return int(submap.trajectory_stamp_ns[index]), T_odom_base
