"""Evidence for the best of some poses, and against it: what the verdict judges by."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.registration.grids.finding.candidates import (
    Background,
    Candidate,
    climb,
    log_volume,
)
from uw_dslam_ros2.core.registration.grids.judging.agreement import WallMap, measure_agreement
from uw_dslam_ros2.core.registration.grids.judging.covariance import PoseSpread, pose_spread
from uw_dslam_ros2.core.registration.grids.judging.probability import (
    MatchEvidence,
    PoseEvidence,
    pose_logit,
)
from uw_dslam_ros2.core.registration.grids.preparation import (
    FINE_SIGMA_CELLS,
    Sides,
    on_cells_of,
)
from uw_dslam_ros2.core.registration.grids.problem import GridProblem, PoseWindow
from uw_dslam_ros2.core.registration.grids.pyramid import Pyramid, carried
from uw_dslam_ros2.core.se2 import SE2, wrap_angle

__all__ = ["Found", "Judge", "is_same_pose", "refine", "weigh"]

FloatArray = NDArray[np.float64]
_NUM_REFINED = 12
_PRICE = 0.5  # of cells twice as large: so much more must the best pose convince on them
_SAME_CELLS = 8.0  # poses nearer than that, in cells of their level, are one answer


@dataclass(frozen=True, slots=True, eq=False)
class Judge:
    """What two maps say about one pose after the other, on the cells of ``sides``."""

    sides: Sides
    pyramid: Pyramid
    background: Background

    def evidence(self, candidate: Candidate) -> PoseEvidence:
        """Evidence for a pose of the finest level."""
        scanned, finest = self.pyramid.scanned, self.pyramid.finest
        T_target_source = finest.motion_of(candidate.pose)
        scale = 1.0 / self.sides[0].cells.resolution_m
        in_cells = SE2(T_target_source.x * scale, T_target_source.y * scale, T_target_source.yaw)
        surprise = self.background.surprise(scanned.value(scanned.pose_of(T_target_source)))
        return PoseEvidence(measure_agreement(*self.sides, in_cells), candidate.score, surprise)


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Poses of the finest level, best first, how well the first is fixed, and the evidence.

    ``judge`` is who measured it.
    """

    refined: list[Candidate]
    spread: PoseSpread
    evidence: MatchEvidence
    judge: Judge


def weigh(
    scales: list[Sides],
    pyramid: Pyramid,
    window: PoseWindow,
    candidates: list[Candidate],
    background: Background,
) -> Found:
    """Refine candidates of the searched problem on the finest one, and compare them.

    ``scales`` are both maps on cells from fine to coarse. Maps that were made apart are bent
    against each other; they are judged on the cells on which their best pose convinces most. Large
    cells have their price: there is less detail on them, and more of the area is near a wall.
    ``window`` is in cells of the scanned problem.
    """
    finest, volume = pyramid.finest, log_volume(pyramid, window)

    def logit(pair: tuple[Candidate, PoseEvidence]) -> float:
        return pose_logit(pair[1], volume)

    # The objective counts what overlaps, so a pose that lays much on much may score above the true
    # one though the maps contradict it: evidence decides.
    refined = refine(pyramid, candidates, _NUM_REFINED)
    judged = []
    for judge in (Judge(sides, pyramid, background) for sides in scales):
        pairs = sorted(((c, judge.evidence(c)) for c in refined), key=logit, reverse=True)
        judged.append((judge, pairs))
    worth = [logit(pairs[0]) - _PRICE * k for k, (_, pairs) in enumerate(judged)]
    judge, weighed = judged[worth.index(max(worth))]
    best, _ = weighed[0]
    apart = [p for p in weighed[1:] if not is_same_pose(finest, p[0].pose, best.pose)]
    kept, poses = zip(weighed[0], *apart, strict=True)
    sides = on_cells_of(scales, finest.resolution_m)
    spread = pose_spread(finest, best.pose, FINE_SIGMA_CELLS, (sides[0].seen, sides[1].seen))
    evidence = MatchEvidence(
        best=poses[0],
        rivals=poses[1:],
        deviation_m=spread.weakest_cells * finest.resolution_m,
        extent_m=min(_extent(side) for side in sides) * finest.resolution_m,
        log_volume=volume,
        cell_m=judge.sides[0].cells.resolution_m,
    )
    return Found(list(kept), spread, evidence, judge)


def _extent(side: WallMap) -> float:
    """Root mean square distance of a map's walls from their mean [cells]."""
    return math.sqrt(float(side.points.var(axis=0).sum()))


def refine(pyramid: Pyramid, candidates: list[Candidate], limit: int) -> list[Candidate]:
    """The maxima of the searched problem's best candidates on the finest one, best first.

    All climb on the first finer problem, whose scores rank them far better; ``limit`` go on.
    """
    refined = candidates
    for coarse, fine in pyramid.steps_to_finest():
        poses = carried(coarse, fine, np.array([c.pose for c in refined]))
        refined = climb(fine, poses)[:limit]
    return refined[:limit]


def is_same_pose(problem: GridProblem, pose: FloatArray, other: FloatArray) -> bool:
    """Whether two poses (3,) of a level's problem are one answer."""
    offset = pose - other
    turn = abs(wrap_angle(float(offset[0]))) * problem.radius
    return turn <= _SAME_CELLS and math.hypot(offset[1], offset[2]) <= _SAME_CELLS
