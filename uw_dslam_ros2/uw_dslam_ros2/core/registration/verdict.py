"""From measured quantities to a verdict on a match of two maps."""

from __future__ import annotations

import math
from dataclasses import dataclass

from uw_dslam_ros2.core.registration.grid_config import GridRegistrationConfig
from uw_dslam_ros2.core.registration.refine_grids import Agreement
from uw_dslam_ros2.core.registration.result import Verdict

__all__ = ["FEATURE_NAMES", "MatchEvidence", "decide", "evidence_features", "probability_of"]


@dataclass(frozen=True, slots=True)
class MatchEvidence:
    """What is known about the best pose of two maps.

    ``surprise`` is how far the best score lies above what chance alignments of these two maps
    reach, in standard deviations of such. ``rival_share`` is the best other pose's score after
    refinement over the best one's. ``stiffness`` is the objective's least curvature over its
    greatest.
    """

    agreement: Agreement
    score: float
    surprise: float
    rival_share: float
    stiffness: float


FEATURE_NAMES = ("agreement", "conflict", "log_agreeing", "log_surprise", "rival_share", "overlap")

# Logistic model: intercept, then one coefficient for each of `FEATURE_NAMES`.
_COEFFICIENTS = (-9.0, 6.0, -6.0, 0.8, 2.0, -6.0, 0.0)


def evidence_features(evidence: MatchEvidence) -> tuple[float, ...]:
    """Quantities of which the probability is made, as `FEATURE_NAMES`."""
    agreement = evidence.agreement
    return (
        agreement.agreement,
        agreement.conflict,
        math.log1p(agreement.agreement * agreement.num_walls),
        math.log(min(max(evidence.surprise, 0.5), 30.0)),
        evidence.rival_share,
        agreement.overlap,
    )


def probability_of(evidence: MatchEvidence) -> float:
    """Probability in [0, 1] that the best pose is right, of a model fitted on simulated pairs."""
    logit = _COEFFICIENTS[0] + sum(
        c * x for c, x in zip(_COEFFICIENTS[1:], evidence_features(evidence), strict=True)
    )
    return 1.0 / (1.0 + math.exp(-max(min(logit, 50.0), -50.0)))


def decide(evidence: MatchEvidence, config: GridRegistrationConfig) -> tuple[Verdict, str, float]:
    """Verdict, its reason with the numbers that decided, and the pose's probability."""
    probability = probability_of(evidence)
    agreement = evidence.agreement
    if agreement.overlap < config.min_overlap:
        return (
            Verdict.NOT_ENOUGH_OVERLAP,
            f"the maps share {agreement.overlap:.0%} of the smaller one's seen area, "
            f"expected at least {config.min_overlap:.0%}",
            probability,
        )
    if agreement.conflict > config.max_conflict:
        return (
            Verdict.CONTRADICTED,
            f"{agreement.conflict:.0%} of the common walls lie on the other map's free space, "
            f"expected at most {config.max_conflict:.0%}",
            probability,
        )
    if evidence.rival_share > config.max_rival_share or evidence.stiffness < 0.005:
        return Verdict.AMBIGUOUS, _ambiguity(evidence, config), probability
    if probability < config.min_probability:
        return (
            Verdict.NOT_ENOUGH_OVERLAP,
            f"the best alignment is right with probability {probability:.2f}, expected at least "
            f"{config.min_probability}: {agreement.agreement:.0%} of the common walls agree, "
            f"score {evidence.surprise:.1f} deviations above chance",
            probability,
        )
    return (
        Verdict.ACCEPTED,
        f"{agreement.agreement:.0%} of the common walls agree, {agreement.conflict:.0%} conflict, "
        f"overlap {agreement.overlap:.0%}, score {evidence.surprise:.1f} deviations above chance",
        probability,
    )


def _ambiguity(evidence: MatchEvidence, config: GridRegistrationConfig) -> str:
    if evidence.stiffness < 0.005:
        return (
            f"the walls leave one direction free (curvature ratio {evidence.stiffness:.4f}), "
            "as a straight wall does"
        )
    return (
        f"another pose reaches {evidence.rival_share:.0%} of the best score, "
        f"expected at most {config.max_rival_share:.0%}"
    )
