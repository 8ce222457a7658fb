"""Registration of two occupancy maps: search, certificate, refinement, verdict."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.features.grid_blocks import shrink_blocks
from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.pose_graph import invert_covariance
from uw_dslam_ros2.core.registration.grids.config import GridRegistrationConfig
from uw_dslam_ros2.core.registration.grids.crop import (
    crop_to_known,
    precedes,
    turn_to_own_axes,
)
from uw_dslam_ros2.core.registration.grids.finding.candidates import merge_best, scan_candidates
from uw_dslam_ros2.core.registration.grids.finding.frames import GridFrames
from uw_dslam_ros2.core.registration.grids.finding.search import search_poses
from uw_dslam_ros2.core.registration.grids.judging.evidence import Found, weigh
from uw_dslam_ros2.core.registration.grids.judging.mirror import add_mirror_image
from uw_dslam_ros2.core.registration.grids.judging.probability import (
    MatchEvidence,
    PoseEvidence,
    probability_of,
)
from uw_dslam_ros2.core.registration.grids.judging.symmetry import add_symmetric_rivals
from uw_dslam_ros2.core.registration.grids.judging.verdict import Proof, decide
from uw_dslam_ros2.core.registration.grids.paper import register_grids_by_points
from uw_dslam_ros2.core.registration.grids.preparation import Sides, prepare_maps
from uw_dslam_ros2.core.registration.grids.problem import GridProblem, PoseWindow
from uw_dslam_ros2.core.registration.grids.pyramid import Pyramid
from uw_dslam_ros2.core.registration.result import (
    PriorWindow,
    Progress,
    RegistrationResult,
    Rival,
    Verdict,
)
from uw_dslam_ros2.core.registration.search.outcome import SearchOutcome, SearchSettings, Status
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["GridRegistrationConfig", "match_evidence", "register_grids"]

FloatArray = NDArray[np.float64]
Clock = Callable[[], float]

_NUM_BOXES_OF_REFUSED = 20_000
_RIVAL_SHARE = 0.5
_LOOK_FOR_DOUBTS = 0.5
_SAME_SCORE = 1e-6


def register_grids(
    source: OccupancyMap,
    target: OccupancyMap,
    config: GridRegistrationConfig | None = None,
    *,
    prior: PriorWindow | None = None,
    clock: Clock | None = None,
    progress: Callable[[Progress], None] | None = None,
    is_cancelled: Callable[[], bool] | None = None,
) -> RegistrationResult:
    """Find the motion that lays the source map on the target map.

    Parameters
    ----------
    source, target
        Maps of any sizes, resolutions and origins, rotated ones included.
    config
        Settings; the defaults where None.
    prior
        Search only there; all of SE(2) where None.
    clock
        Seconds from any start; without it there is no time limit and `RegistrationResult.seconds`
        is NaN.
    progress, is_cancelled
        Called some times a second from this thread; a cancelled search answers BUDGET_EXHAUSTED.

    Returns
    -------
    RegistrationResult
        ``T_target_source`` takes metres in the source grid's frame to metres in the target grid's
        frame.
    """
    config = config or GridRegistrationConfig()
    source, target = shrink_blocks(source), shrink_blocks(target)
    for name, occupancy in (("source", source), ("target", target)):
        rows, cols = occupancy.spec.shape
        if max(rows, cols) > config.max_side_cells:
            return RegistrationResult.refused(
                Verdict.BUDGET_EXHAUSTED,
                f"the {name} map has {rows} x {cols} cells, expected at most "
                f"{config.max_side_cells} on a side",
                seconds=0.0 if clock is not None else math.nan,
            )
    if config.method == "paper":
        return register_grids_by_points(
            source, target, config,
            prior=prior, clock=clock, progress=progress, is_cancelled=is_cancelled,
        )  # fmt: skip
    match = _GridMatch(source, target, config, prior, clock)
    return match.run(progress, is_cancelled)


def match_evidence(
    source: OccupancyMap,
    target: OccupancyMap,
    config: GridRegistrationConfig | None = None,
    *,
    prior: PriorWindow | None = None,
) -> tuple[MatchEvidence, list[tuple[PoseEvidence, SE2]]] | None:
    """What `register_grids` would judge by, without the proof; for studies.

    The list holds the evidence of each pose by itself, the best one first, and its
    ``T_target_source``. None where a map holds too little to be matched.
    """
    maps = shrink_blocks(source), shrink_blocks(target)
    match = _GridMatch(*maps, config or GridRegistrationConfig(), prior, None)
    return match.collect()


class _GridMatch:
    """One registration; the steps of the recipe in `run`.

    Which of two maps is laid on which does not depend on which the caller calls the source: here,
    the source is that which `precedes` the other. A prior window is a box in the target's frame
    alone, so with one the maps stay as they are.
    """

    def __init__(
        self,
        source: OccupancyMap,
        target: OccupancyMap,
        config: GridRegistrationConfig,
        prior: PriorWindow | None,
        clock: Clock | None,
    ) -> None:
        sides = [turn_to_own_axes(crop_to_known(side)) for side in (source, target)]
        self._names = ("source", "target")
        self._is_exchanged = prior is None and precedes(sides[1], sides[0])
        if self._is_exchanged:
            sides.reverse()
            self._names = ("target", "source")
        self._source, self._target = sides
        self._frames = GridFrames(self._source.spec, self._target.spec)
        self._config, self._prior, self._clock = config, prior, clock
        self._start_s = clock() if clock is not None else math.nan
        self._is_cancelled = False

    def run(
        self,
        progress: Callable[[Progress], None] | None,
        is_cancelled: Callable[[], bool] | None,
    ) -> RegistrationResult:
        """The recipe."""
        prepared = prepare_maps(self._source, self._target, self._config, self._names)
        if isinstance(prepared, str):
            return self._refused(Verdict.TOO_FEW_FEATURES, prepared)
        pyramid, scales = prepared
        searched = pyramid.searched
        window = self._frames.window(pyramid.scanned, self._prior)
        candidates, background = scan_candidates(pyramid, window)
        found = weigh(scales, pyramid, window, candidates, background)
        verdict, _, _ = decide(found.evidence, self._config)
        # What the evidence refuses anyway gets a short search, which may find better.
        num_boxes = self._config.max_boxes
        if verdict is not Verdict.ACCEPTED:
            num_boxes = min(num_boxes, _NUM_BOXES_OF_REFUSED)
        outcome = self._certify(
            searched,
            self._frames.window(searched, self._prior),
            candidates[0].pose,
            num_boxes,
            progress,
            is_cancelled,
        )
        is_better = outcome.lower_bound > candidates[0].score * (1.0 + 1e-6)
        if is_better or (verdict is Verdict.ACCEPTED and not outcome.is_complete):
            # Where the proof is open, the poses that it could not exclude are rivals like others.
            candidates = merge_best(searched, candidates, outcome)
            found = weigh(scales, pyramid, window, candidates, background)
        return self._answer(pyramid, outcome, self._doubted(found, scales, pyramid, window))

    def collect(self) -> tuple[MatchEvidence, list[tuple[PoseEvidence, SE2]]] | None:
        """Evidence, and that of each pose by itself; None where a map holds too little."""
        prepared = prepare_maps(self._source, self._target, self._config, self._names)
        if isinstance(prepared, str):
            return None
        pyramid, scales = prepared
        window = self._frames.window(pyramid.scanned, self._prior)
        found = weigh(scales, pyramid, window, *scan_candidates(pyramid, window))
        weighed = (found.evidence.best, *found.evidence.rivals)
        motions = [self._told(pyramid.finest.motion_of(c.pose)) for c in found.refined]
        evidence = self._doubted(found, scales, pyramid, window).evidence
        return evidence, list(zip(weighed, motions, strict=True))

    def _doubted(
        self, found: Found, scales: list[Sides], pyramid: Pyramid, window: PoseWindow
    ) -> Found:
        """With what explains the match otherwise: symmetries of a map, and a mirror.

        They only matter to a match that would be convincing without them.
        """
        if probability_of(found.evidence, is_alone=True) < _LOOK_FOR_DOUBTS:
            return found
        if self._config.may_be_mirrored:
            found = add_mirror_image(found, scales, pyramid, self._config)
        return add_symmetric_rivals(found, pyramid, window)

    def _certify(
        self,
        problem: GridProblem,
        window: PoseWindow,
        start: FloatArray,
        num_boxes: int,
        progress: Callable[[Progress], None] | None,
        is_cancelled: Callable[[], bool] | None,
    ) -> SearchOutcome:
        config = self._config
        left_s = math.inf
        if self._clock is not None:
            left_s = max(config.max_seconds - (self._clock() - self._start_s), 0.0)

        def report(told: Progress) -> None:
            if progress is not None:
                T = told.T_target_source
                motion = problem.motion_of(np.array([T.yaw, T.x, T.y]))
                progress(replace(told, T_target_source=self._told(motion)))

        outcome = search_poses(
            problem, window, start, SearchSettings(config.gap, num_boxes, left_s),
            clock=self._clock, progress=report, is_cancelled=is_cancelled,
        )  # fmt: skip
        self._is_cancelled = outcome.status is Status.CANCELLED
        return outcome

    def _answer(
        self, pyramid: Pyramid, outcome: SearchOutcome, found: Found
    ) -> RegistrationResult:
        work, finest = pyramid.searched, pyramid.finest
        pose, agreement = found.refined[0].pose, found.evidence.best.agreement
        at_work = work.pose_of(finest.motion_of(pose))
        score, (_, summit) = work.value(at_work), work.ascend(at_work)
        proof = Proof(
            is_complete=outcome.is_complete,
            is_optimum=summit >= (1.0 - self._config.gap) * outcome.lower_bound - _SAME_SCORE,
            is_cancelled=self._is_cancelled,
            num_boxes=outcome.num_boxes,
            score=score,
            lower_bound=outcome.lower_bound,
            upper_bound=outcome.upper_bound,
        )
        verdict, reason, probability = decide(found.evidence, self._config, proof=proof)
        if verdict is Verdict.TOO_FEW_FEATURES:
            return self._refused(verdict, reason)
        motion = self._frames.to_frames(finest.motion_of(pose))
        covariance = self._frames.covariance(finest, found.spread.covariance, motion)
        inlier_ratio = agreement.inlier_ratio
        source_points = self._frames.source_points(work.source_points + work.center, work)
        target_points = self._frames.target_points(work.target_points, work)
        if self._is_exchanged:
            covariance, motion = invert_covariance(covariance, motion), motion.inverse()
            inlier_ratio = agreement.target_inlier_ratio
            source_points, target_points = target_points, source_points
        bound = outcome.upper_bound / max(score, 1e-12)
        best_score = max(found.evidence.best.score, 1e-9)
        rivals = tuple(
            Rival(self._told(finest.motion_of(c.pose)), rival.score / best_score, bound)
            for c, rival in zip(found.refined[1:], found.evidence.rivals, strict=True)
            if rival.score > _RIVAL_SHARE * best_score or verdict is Verdict.AMBIGUOUS
        )
        return RegistrationResult(
            verdict=verdict,
            reason=reason,
            T_target_source=motion,
            covariance=covariance,
            probability=probability,
            score=score,
            lower_bound=outcome.lower_bound,
            upper_bound=outcome.upper_bound,
            is_certified=proof.is_complete and proof.is_optimum,
            num_boxes=outcome.num_boxes,
            seconds=self._elapsed(),
            overlap=agreement.overlap,
            conflict_ratio=agreement.conflict,
            inlier_ratio=inlier_ratio,
            num_source_points=len(source_points),
            num_target_points=len(target_points),
            rivals=rivals,
            source_points=source_points,
            target_points=target_points,
        )

    def _told(self, motion: SE2) -> SE2:
        """Motion between the grids' own axes to ``T_target_source`` as the caller calls them."""
        told = self._frames.to_frames(motion)
        return told.inverse() if self._is_exchanged else told

    def _elapsed(self) -> float:
        return self._clock() - self._start_s if self._clock is not None else math.nan

    def _refused(self, verdict: Verdict, reason: str) -> RegistrationResult:
        return RegistrationResult.refused(verdict, reason, seconds=self._elapsed())
