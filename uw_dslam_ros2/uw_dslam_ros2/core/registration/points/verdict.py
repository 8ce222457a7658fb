"""From the evidence for the best pose and its rivals to a verdict on two point sets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.registration.result import Verdict

__all__ = ["PoseHypothesis", "decide_points", "posterior"]

# Weight of chance against a pose that was found. A Bayes factor of 1 is rare among unrelated sets:
# the best of all their poses exceeds evidence x in a share of about 2e-4 exp(-x) of all cases.
_CHANCE = 0.005
_FIT = 0.5  # share of the points with a partner from which two sets are said to fit


@dataclass(frozen=True, slots=True, eq=False)
class PoseHypothesis:
    """One refined pose and what speaks for it."""

    evidence: float  # log of the Bayes factor against chance [nats]
    covariance: NDArray[np.float64]  # (3, 3) of theta, x, y; inf where the points leave it free
    independent_evidence: float  # the same if no point repeated others
    pair_share: float  # of the smaller set that has a partner
    log_odds: float  # against the best, by how evenly the points prefer either (`point_rivals`)


def posterior(evidences: Sequence[float]) -> float:
    """Probability of the first hypothesis against all others and against chance (evidence 0)."""
    top = max(0.0, *evidences)
    terms = [math.exp(evidence - top) for evidence in evidences]
    return terms[0] / (_CHANCE * math.exp(-top) + sum(terms))


def decide_points(
    hypotheses: Sequence[PoseHypothesis],
    *,
    is_complete: bool,
    gap: float,
    spacing_m: float,
    arm_m: float,
    is_line: bool,
    min_probability: float,
) -> tuple[Verdict, str, float]:
    """Verdict, reason and probability; the first hypothesis is the best.

    ``spacing_m`` is the mean distance between target points, ``arm_m`` the source's radius: a pose
    whose standard deviation reaches the spacing, along any axis, is not determined. ``is_line``:
    both sets are thinner than their points are apart.
    """
    best = hypotheses[0]
    probability = posterior(_evidences(hypotheses, min_probability))
    against_chance = posterior([best.evidence])
    worst = _worst_deviation(best.covariance, arm_m)
    if not is_complete:
        reason = f"the search stopped with a gap of {100.0 * gap:.1f} % left to prove"
        return Verdict.BUDGET_EXHAUSTED, reason, probability
    if against_chance < min_probability:
        if is_line:
            reason = "both sets lie on a line, and nothing tells where along it they fit"
            return Verdict.AMBIGUOUS, reason, min(probability, 0.5)
        if _fits_in_many_ways(hypotheses, worst > 0.5 * spacing_m, min_probability):
            reason = (
                f"{100.0 * best.pair_share:.0f} % of the points find partners, but they repeat "
                f"each other and do so in other poses as well: evidence {best.evidence:.1f} nats"
            )
            return Verdict.AMBIGUOUS, reason, min(probability, 0.5)
        reason = (
            f"the best alignment is no better than chance: evidence {best.evidence:.1f} nats, "
            f"{math.log(_CHANCE * min_probability / (1.0 - min_probability)):.1f} needed"
        )
        return Verdict.NOT_ENOUGH_OVERLAP, reason, probability
    if worst > 0.5 * spacing_m:
        reason = f"the points leave the pose open: standard deviation {worst:.3g} m"
        return Verdict.AMBIGUOUS, reason, min(probability, 0.5)
    if probability < min_probability:
        rival = max(h.evidence for h in hypotheses[1:])
        reason = (
            f"another pose explains the points about as well: evidence {rival:.1f} against "
            f"{best.evidence:.1f} nats"
        )
        return Verdict.AMBIGUOUS, reason, probability
    reason = f"evidence {best.evidence:.1f} nats, probability {probability:.4f}"
    return Verdict.ACCEPTED, reason, probability


def _worst_deviation(covariance: NDArray[np.float64], arm_m: float) -> float:
    """Largest standard deviation [m] along any axis of the pose, rotation times the arm."""
    scale = np.array([arm_m, 1.0, 1.0])
    scaled = covariance * np.outer(scale, scale)
    if not np.isfinite(scaled).all():
        return math.inf
    return math.sqrt(max(float(np.linalg.eigvalsh(scaled)[-1]), 0.0))


def _evidences(hypotheses: Sequence[PoseHypothesis], min_probability: float) -> list[float]:
    """Evidence of all; a rival that would convince by itself has at least its odds to the best."""
    best = hypotheses[0]
    evidences = [best.evidence]
    for rival in hypotheses[1:]:
        evidence = rival.evidence
        if posterior([evidence]) >= min_probability:
            evidence = max(evidence, best.evidence + rival.log_odds)
        evidences.append(evidence)
    return evidences


def _fits_in_many_ways(
    hypotheses: Sequence[PoseHypothesis], is_open: bool, min_probability: float
) -> bool:
    """Whether most points fit, more often than by chance were they independent, in many poses."""
    best = hypotheses[0]
    if best.pair_share < _FIT or posterior([best.independent_evidence]) < min_probability:
        return False
    return is_open or any(
        rival.pair_share >= _FIT and rival.log_odds > math.log(1.0 - min_probability)
        for rival in hypotheses[1:]
    )
