"""From the poses found to the result of a match of points."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from uw_dslam_ros2.core.registration.config import RegistrationConfig
from uw_dslam_ros2.core.registration.points.evidence import EvidenceModel
from uw_dslam_ros2.core.registration.points.input import Cloud, Pair
from uw_dslam_ros2.core.registration.points.refinement import Refinement
from uw_dslam_ros2.core.registration.points.rivals import log_contributions, log_odds
from uw_dslam_ros2.core.registration.points.verdict import (
    PointCase,
    PoseHypothesis,
    decide_points,
    posterior,
)
from uw_dslam_ros2.core.registration.result import RegistrationResult, Rival, Verdict
from uw_dslam_ros2.core.registration.search.branch_and_bound import SearchOutcome, Status, Term
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["Candidate", "KernelSearch", "result_of", "too_few"]

FloatArray = NDArray[np.float64]

_MAX_COMPARED = 20  # poses that are compared with the best one, point by point

Candidate = tuple[float, Refinement]  # evidence, and what it is for


@dataclass(frozen=True, slots=True, eq=False)
class KernelSearch:
    """One search, and the refined poses it led to, best evidence first."""

    sigma_m: float
    terms: list[Term]
    outcome: SearchOutcome
    unit: float  # what a perfect match of all source weight scores
    error: float  # between the field and its formula, for all source weight
    candidates: list[Candidate]


def result_of(
    pair: Pair,
    found: KernelSearch,
    candidates: Sequence[Candidate],
    config: RegistrationConfig,
    *,
    evidence: EvidenceModel,
    num_boxes: int,
    seconds: float,
) -> RegistrationResult:
    """Verdict, pose and certificate; the bounds are of `found`, the pose is the first one."""
    outcome, best = found.outcome, candidates[0][1]
    values = _values(found, [r.pose() for _, r in candidates[: 1 + config.max_rivals]])
    lower = (outcome.lower_bound - found.error) / found.unit
    upper = (outcome.upper_bound + found.error) / found.unit
    gap = max(0.0, 1.0 - lower / upper) if upper > 0.0 else 0.0
    covariance = evidence.repetition * best.covariance()
    verdict, reason, probability = decide_points(
        PointCase(
            _hypotheses(candidates, evidence, config.min_posterior),
            is_complete=outcome.status is Status.CERTIFIED,
            gap=gap,
            spacing_m=evidence.spacing_m,
            arm_m=evidence.arm_m,
            is_line=_is_line(evidence.source) and _is_line(evidence.target),
            min_posterior=config.min_posterior,
        )
    )
    if verdict is Verdict.TOO_FEW_FEATURES:
        return _undecided(pair.caller_points(), reason, seconds)
    pose = pair.full_pose(best.pose())
    source_points, target_points = pair.caller_points()
    is_inlier = _has_partner(pose.apply(source_points), target_points, best, evidence.spacing_m)
    return RegistrationResult(
        verdict=verdict,
        reason=reason,
        T_target_source=pose,
        covariance=pair.full_covariance(covariance, best.pose()),
        probability=probability,
        score=min(values[0] / found.unit, upper),
        lower_bound=lower,
        upper_bound=upper,
        is_certified=outcome.status is Status.CERTIFIED,
        num_boxes=num_boxes,
        seconds=seconds,
        overlap=math.nan,
        conflict_ratio=math.nan,
        inlier_ratio=float(is_inlier.mean()),
        num_source_points=len(source_points),
        num_target_points=len(target_points),
        rivals=_rivals(pair, found, candidates, values),
        source_points=source_points,
        target_points=target_points,
        is_inlier=is_inlier,
    )


def _hypotheses(
    candidates: Sequence[Candidate], evidence: EvidenceModel, min_posterior: float
) -> list[PoseHypothesis]:
    """What the verdict asks of the poses, the best first."""
    area_m2 = evidence.target_outline.area_m2
    most = min(len(evidence.source), len(evidence.target))

    def contributions(refinement: Refinement) -> FloatArray:
        return log_contributions(evidence.source, evidence.target, refinement, area_m2)

    found: list[PoseHypothesis] = []
    first: FloatArray | None = None
    is_poor = posterior([candidates[0][0]]) < min_posterior
    for k, (own, refinement) in enumerate(candidates):
        odds = -math.inf
        # Only a rival that convinces by itself counts, or any where the best does not.
        if 0 < k < _MAX_COMPARED and (is_poor or posterior([own]) >= min_posterior):
            first = contributions(candidates[0][1]) if first is None else first
            odds = log_odds(first, contributions(refinement), evidence.repetition)
        is_independent = evidence.repetition == 1.0
        found.append(
            PoseHypothesis(
                evidence=own,
                covariance=evidence.repetition * refinement.covariance(),
                independent_evidence=own if is_independent else evidence.of(refinement, 1.0),
                pair_share=refinement.num_pairs / most,
                log_odds=odds,
            )
        )
    return found


def _is_line(points: FloatArray) -> bool:
    """Whether the points spread less across than they lie apart along."""
    across, along = np.linalg.eigvalsh(np.cov(points.T))
    return bool(across * len(points) ** 2 < along)


def _values(found: KernelSearch, poses: Sequence[SE2]) -> list[float]:
    """What the search's objective says of poses."""
    problem = found.outcome.neighborhoods.problem
    return [problem.value_at(problem.pose_of(pose))[0] for pose in poses]


def _rivals(
    pair: Pair, found: KernelSearch, candidates: Sequence[Candidate], values: Sequence[float]
) -> tuple[Rival, ...]:
    """The other poses, scored as shares of the best one's objective, bounded around each."""
    best = max(values[0], 1e-300)
    others = [r.pose() for _, r in candidates[1 : len(values)]]
    return tuple(
        Rival(
            pair.full_pose(pose),
            max(value, 0.0) / best,
            max(found.outcome.upper_bound_near(pose), value) / best,
        )
        for pose, value in zip(others, values[1:], strict=True)
    )


def _has_partner(
    moved: FloatArray, target: FloatArray, best: Refinement, spacing_m: float
) -> NDArray[np.bool_]:
    """Source points with a target within three standard deviations of a pair."""
    reach = max(3.0 * best.sigma_m, 1e-3 * spacing_m)
    distances, _ = scipy.spatial.cKDTree(target).query(moved)
    return np.asarray(distances <= reach)


def too_few(
    source: Cloud, target: Cloud, config: RegistrationConfig, seconds: float
) -> RegistrationResult:
    """Answer to sets that no pose can be told from."""
    m, n = len(source.points), len(target.points)
    reason = f"{m} source and {n} target points, at least {config.min_points} of each needed"
    return _undecided((source.original(), target.original()), reason, seconds)


def _undecided(
    points: tuple[FloatArray, FloatArray], reason: str, seconds: float
) -> RegistrationResult:
    source, target = points
    refused = RegistrationResult.refused(
        Verdict.TOO_FEW_FEATURES, reason, seconds=seconds, num_points=(len(source), len(target))
    )
    nowhere = np.zeros(len(source), dtype=np.bool_)
    return replace(refused, source_points=source, target_points=target, is_inlier=nowhere)
