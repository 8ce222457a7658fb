"""Evidence for the best of some poses, and against it: what the verdict judges by."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.registration.grid_candidates import Candidate, Chance, climb, log_volume
from uw_dslam_ros2.core.registration.grid_problem import GridProblem, PoseWindow
from uw_dslam_ros2.core.registration.refine_grids import (
    WallMap,
    measure_agreement,
    slide_share,
)
from uw_dslam_ros2.core.registration.verdict import MatchEvidence, PoseEvidence
from uw_dslam_ros2.core.se2 import SE2, wrap_angle

__all__ = ["Found", "weigh"]

FloatArray = NDArray[np.float64]
_NUM_REFINED = 8
_SLIDE_CELLS = 10.0
_SAME_CELLS = 8.0  # poses nearer than that, on the finest level, are one answer


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Poses of the finest level, best first, and the evidence."""

    refined: list[Candidate]
    evidence: MatchEvidence


def weigh(
    sides: tuple[WallMap, WallMap],
    levels: list[GridProblem],
    window: PoseWindow,
    candidates: list[Candidate],
    chance: Chance,
) -> Found:
    """Refine candidates of the searched lattice on the finest one, and compare them.

    ``levels`` are problems from the searched lattice to the finest one; ``sides`` are source and
    target on the finest.
    """
    work, finest = levels[0], levels[-1]
    refined = _apart(finest, _refine(levels, candidates))
    best = refined[0]
    poses = []
    for candidate in refined:
        T_grids = finest.to_motion(candidate.pose)
        scale = 1.0 / finest.resolution_m
        T_cells = SE2(T_grids.x * scale, T_grids.y * scale, T_grids.yaw)
        share = candidate.score / best.score if best.score > 0.0 else 1.0
        surprise = chance.surprise(work.value(work.to_pose(T_grids)))
        poses.append(PoseEvidence(measure_agreement(sides[0], sides[1], T_cells), share, surprise))
    evidence = MatchEvidence(
        best=poses[0],
        rivals=tuple(poses[1:]),
        slide_share=slide_share(finest, best.pose, _SLIDE_CELLS),
        log_volume=log_volume(work, window),
    )
    return Found(refined, evidence)


def _refine(levels: list[GridProblem], candidates: list[Candidate]) -> list[Candidate]:
    """The candidates' maxima on the finest level, best first."""
    refined = candidates[:_NUM_REFINED]
    for coarse, fine in itertools.pairwise(levels):
        poses = [fine.to_pose(coarse.to_motion(c.pose)) for c in refined]
        refined = climb(fine, np.array(poses))
    return refined


def _apart(problem: GridProblem, refined: list[Candidate]) -> list[Candidate]:
    """The best one, and those that are other answers than it."""
    best = refined[0].pose
    others = []
    for candidate in refined[1:]:
        offset = candidate.pose - best
        turn = abs(wrap_angle(float(offset[0]))) * problem.radius
        if turn > _SAME_CELLS or math.hypot(offset[1], offset[2]) > _SAME_CELLS:
            others.append(candidate)
    return [refined[0], *others]
