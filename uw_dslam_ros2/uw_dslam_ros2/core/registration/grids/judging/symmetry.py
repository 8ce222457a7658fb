"""Where a map looks like itself, and for which poses a match of it may therefore be mistaken.

A place that looks the same after a half turn has two poses for every match. Where the two maps
share too little to judge the other pose, the symmetry shows in one map laid on itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from uw_dslam_ros2.core.registration.grids.finding.candidates import (
    Candidate,
    log_volume,
    scan_candidates,
)
from uw_dslam_ros2.core.registration.grids.finding.search import whole_plane
from uw_dslam_ros2.core.registration.grids.judging.agreement import WallMap
from uw_dslam_ros2.core.registration.grids.judging.evidence import (
    Found,
    Judge,
    is_same_pose,
    refine,
)
from uw_dslam_ros2.core.registration.grids.judging.probability import PoseEvidence, pose_logit
from uw_dslam_ros2.core.registration.grids.problem import GridProblem, PoseWindow
from uw_dslam_ros2.core.registration.grids.pyramid import Pyramid, carried
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["add_symmetric_rivals"]

_NUM_SELF_MATCHES = 3
_NUM_PEAKS = 40  # a likeness worth a doubt stands out
_MARGIN_RAD = 0.2  # past the half turn, the likeliest symmetry of all
_LEAST_LOGIT = 0.0  # a likeness less convincing makes no rival
_REFUTED_SHARE = 0.8  # of the match's agreement: with less, the maps themselves say no


@dataclass(frozen=True, slots=True)
class _Likeness:
    """A motion that lays a map on itself, between the grid's own axes [m], and its evidence."""

    T_self: SE2
    evidence: PoseEvidence


def add_symmetric_rivals(
    found: Found,
    pyramid: Pyramid,
    window: PoseWindow,
) -> Found:
    """Evidence with the rivals that likenesses within either map make.

    ``pyramid`` and ``window``, beyond which nothing is a rival, as for `evidence.weigh`. Where a
    map is laid on itself by S, a match T has the rival T S (or S T, on the target's side). Unless
    the two maps refute it, that rival is as convincing as the likeness, and at most as the match.
    """
    finest, evidence = pyramid.finest, found.evidence
    T_target_source = finest.motion_of(found.refined[0].pose)
    aliases = []
    for is_source, walls in zip((True, False), found.judge.sides, strict=True):
        itself = replace(
            pyramid, problems=tuple(_on_itself(p, is_source) for p in pyramid.problems)
        )
        for likeness in _likenesses(walls, itself):
            for T_self in (likeness.T_self, likeness.T_self.inverse()):
                aliases.append(
                    (T_target_source @ T_self if is_source else T_self @ T_target_source, likeness)
                )
    if not aliases:
        return found

    def logit(pose: PoseEvidence) -> float:
        return pose_logit(pose, evidence.log_volume)

    refined, rivals = list(found.refined), list(evidence.rivals)
    for T_alias, likeness in aliases:
        if not window.holds(pyramid.scanned.pose_of(T_alias)):
            continue
        candidate = _climbed(finest, T_alias)
        same = [k for k, c in enumerate(refined) if is_same_pose(finest, c.pose, candidate.pose)]
        if same and same[0] == 0:
            continue
        seen = found.judge.evidence(candidate)
        if seen.agreement.agreement >= _REFUTED_SHARE * evidence.best.agreement.agreement:
            weaker = min(likeness.evidence, evidence.best, key=logit)
            seen = max(seen, replace(weaker, score=seen.score), key=logit)
        if same:
            rivals[same[0] - 1] = seen
        else:
            refined.append(candidate)
            rivals.append(seen)
    return replace(found, refined=refined, evidence=replace(evidence, rivals=tuple(rivals)))


def _climbed(problem: GridProblem, T_alias: SE2) -> Candidate:
    """The maximum near a pose, or the pose where there is none."""
    start = problem.pose_of(T_alias)
    candidate = Candidate(*problem.ascend(start))
    if is_same_pose(problem, candidate.pose, start):
        return candidate
    return Candidate(start, problem.value(start))


def _on_itself(problem: GridProblem, is_source: bool) -> GridProblem:
    """The problem of laying one map of a problem on itself."""
    if is_source:
        points, weights = problem.source_points + problem.center, problem.source_weights
        field = problem.source_field
    else:
        points, weights = problem.target_points, problem.target_weights
        field = problem.target_field
    center = np.average(points, axis=0, weights=weights)
    relative = np.ascontiguousarray(points - center)
    return GridProblem(
        problem.resolution_m, relative, weights, field, points, weights, field, center
    )


def _likenesses(walls: WallMap, pyramid: Pyramid) -> list[_Likeness]:
    """Convincing motions of a map onto itself; half of all turns, the rest are their inverses."""
    scanned, searched, finest = pyramid.scanned, pyramid.searched, pyramid.finest
    plane = whole_plane(scanned)
    half_rad = 0.5 * math.pi + _MARGIN_RAD
    window = PoseWindow(
        np.array([0.5 * math.pi, *plane.middle[1:]]), np.array([half_rad, *plane.half[1:]])
    )
    candidates, background = scan_candidates(pyramid, window, _NUM_PEAKS)
    identity = scanned.pose_of(SE2())
    poses = carried(searched, scanned, np.array([c.pose for c in candidates]))
    others = [
        candidate
        for candidate, pose in zip(candidates, poses, strict=True)
        if not is_same_pose(scanned, pose, identity)
    ]
    if not others:
        return []
    judge = Judge((walls, walls), pyramid, background)
    found = []
    volume = log_volume(pyramid, plane)
    for candidate in refine(pyramid, others, _NUM_SELF_MATCHES):
        likeness = _Likeness(finest.motion_of(candidate.pose), judge.evidence(candidate))
        if pose_logit(likeness.evidence, volume) > _LEAST_LOGIT:
            found.append(likeness)
    return found
