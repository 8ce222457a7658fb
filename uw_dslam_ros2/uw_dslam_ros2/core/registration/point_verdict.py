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


@dataclass(frozen=True, slots=True, eq=False)
class PoseHypothesis:
    """One refined pose and what speaks for it."""

    evidence: float  # log of the Bayes factor against chance [nats]
    covariance: NDArray[np.float64]  # (3, 3) of theta, x, y; inf where the points leave it free


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
    min_probability: float,
) -> tuple[Verdict, str, float]:
    """Verdict, reason and probability; the first hypothesis is the best.

    ``spacing_m`` is the mean distance between target points, ``arm_m`` the source's radius: a pose
    whose standard deviation reaches the spacing, along any axis, is not determined.
    """
    best = hypotheses[0]
    probability = posterior([h.evidence for h in hypotheses])
    against_chance = posterior([best.evidence])
    scale = np.array([arm_m, 1.0, 1.0])
    scaled = best.covariance * np.outer(scale, scale)
    worst = math.inf
    if np.isfinite(scaled).all():
        worst = math.sqrt(max(float(np.linalg.eigvalsh(scaled)[-1]), 0.0))
    if not is_complete:
        reason = f"the search stopped with a gap of {100.0 * gap:.1f} % left to prove"
        return Verdict.BUDGET_EXHAUSTED, reason, probability
    if against_chance < min_probability:
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
