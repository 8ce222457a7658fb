"""From measured quantities to a verdict on a match of two maps."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from uw_dslam_ros2.core.registration.grid_config import GridRegistrationConfig
from uw_dslam_ros2.core.registration.refine_grids import Agreement
from uw_dslam_ros2.core.registration.result import Verdict

__all__ = ["FEATURE_NAMES", "MatchEvidence", "decide", "evidence_features", "probability_of"]


@dataclass(frozen=True, slots=True)
class MatchEvidence:
    """What is known about the best pose of two maps.

    ``surprise`` is how far the best score lies above what chance alignments of these two maps
    reach, in standard deviations of such. ``rival_share`` is the best other pose's score after
    refinement over the best one's. ``slide_share`` is the score some cells off in
    the least curved direction over the best one.
    """

    agreement: Agreement
    score: float
    surprise: float
    rival_share: float
    slide_share: float


# More walls than these are no more proof: chance matches of large maps have them too.
_ENOUGH_WALLS = 600.0

FEATURE_NAMES = ("agreement", "conflict", "log_agreeing", "log_surprise", "rival_share", "overlap")

# Logistic model: intercept, then one coefficient for each of `FEATURE_NAMES`; fitted by
# `study verdict --seeds 2` on 127 simulated pairs, ridge 0.1.
_COEFFICIENTS = (-15.0730, 5.3186, -5.7241, 2.0610, 1.3574, -3.7250, 0.8713)


def evidence_features(evidence: MatchEvidence) -> tuple[float, ...]:
    """Quantities of which the probability is made, as `FEATURE_NAMES`."""
    agreement = evidence.agreement
    return (
        agreement.agreement,
        agreement.conflict,
        math.log1p(min(agreement.agreement * agreement.num_walls, _ENOUGH_WALLS)),
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
    if evidence.slide_share > config.max_slide_share:
        reason = (
            f"the walls leave one direction free, as a straight wall does: the score is still "
            f"{evidence.slide_share:.0%} some cells away, expected at most "
            f"{config.max_slide_share:.0%}"
        )
        return Verdict.AMBIGUOUS, reason, min(probability, 0.5)
    if agreement.overlap < config.min_overlap:
        reason = (
            f"the best alignment shares {agreement.overlap:.0%} of the smaller map's seen area, "
            f"expected at least {config.min_overlap:.0%}"
        )
        return Verdict.NOT_ENOUGH_OVERLAP, reason, probability
    is_probable = probability >= config.min_probability
    if agreement.conflict > (config.max_conflict if is_probable else 0.6 * config.max_conflict):
        reason = (
            f"{agreement.conflict:.0%} of the common walls lie on the other map's free space, "
            f"expected at most {config.max_conflict:.0%}"
        )
        return Verdict.CONTRADICTED, reason, probability
    # Rivals only matter to an alignment that would be convincing without them.
    alone = probability_of(replace(evidence, rival_share=min(evidence.rival_share, 0.5)))
    if evidence.rival_share > config.max_rival_share and alone >= config.min_probability:
        reason = (
            f"another pose reaches {evidence.rival_share:.0%} of the best score, "
            f"expected at most {config.max_rival_share:.0%}"
        )
        return Verdict.AMBIGUOUS, reason, min(probability, 0.5)
    numbers = (
        f"{agreement.agreement:.0%} of the common walls agree, {agreement.conflict:.0%} conflict, "
        f"overlap {agreement.overlap:.0%}, best rival {evidence.rival_share:.0%}, "
        f"score {evidence.surprise:.1f} deviations above chance"
    )
    if not is_probable:
        reason = f"right with probability {probability:.2f} only: {numbers}"
        return Verdict.NOT_ENOUGH_OVERLAP, reason, probability
    return Verdict.ACCEPTED, numbers, probability
