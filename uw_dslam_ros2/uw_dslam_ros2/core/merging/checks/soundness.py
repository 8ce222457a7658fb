"""What cannot be right is set aside, with a reason: until a later revision, or others, mend it."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.merging.graph.components import Constraint
from uw_dslam_ros2.core.merging.graph.library import Library
from uw_dslam_ros2.core.merging.graph.memory import Memory
from uw_dslam_ros2.core.merging.graph.submap_groups import StoredSubmap
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap, SubmapId, Track

__all__ = ["contradicting_track", "implausible_submaps"]

_SLACK_S = 1.0
"""Between the last ping of a submap and the first of the next one, beside what stamps say."""
_SIGMAS = 5.0
_MIN_TRACKS = 3
_MIN_BROKEN = 3


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
