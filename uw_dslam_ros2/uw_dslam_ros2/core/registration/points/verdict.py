"""From the evidence for the best pose and its rivals to a verdict on two point sets."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.registration.result import Verdict
from uw_dslam_ros2.core.registration.rules import Rule, at_least, at_most, first_that_applies

__all__ = ["PointCase", "PoseHypothesis", "decide_points", "posterior"]

# Weight of chance against a pose that was found. A Bayes factor of 1 is rare among unrelated sets:
# the best of all their poses exceeds evidence x in a share of about 2e-4 exp(-x) of all cases.
_COINCIDENCE = 0.005
_FIT = 0.5  # share of the points with a partner from which two sets are said to fit
_OPEN = 0.5  # standard deviation, in spacings, from which a pose is not determined
_DOUBTED = 0.5  # most probability left to a pose that the points do not tell from others


@dataclass(frozen=True, slots=True, eq=False)
class PoseHypothesis:
    """One refined pose and what speaks for it."""

    evidence: float  # log of the Bayes factor against chance [nats]; -inf: nothing does
    covariance: NDArray[np.float64]  # (3, 3) of theta, x, y; inf where the points leave it free
    independent_evidence: float  # the same if no point repeated others
    pair_share: float  # of the smaller set that has a partner
    log_odds: float  # against the best, by how evenly the points prefer either (`point_rivals`)


def posterior(evidences: Sequence[float]) -> float:
    """Probability of the first hypothesis against all others and against chance (evidence 0)."""
    top = max(0.0, *evidences)
    terms = [math.exp(evidence - top) for evidence in evidences]
    return terms[0] / (_COINCIDENCE * math.exp(-top) + sum(terms))


@dataclass(frozen=True, eq=False)
class PointCase:
    """A match of points as the table below asks about it; the first hypothesis is the best.

    ``is_complete``: the search proved its ``gap`` (relative). ``spacing_m`` is the mean distance
    between target points, ``arm_m`` the source's radius: a pose whose standard deviation reaches
    half the spacing, along any axis, is not determined. ``is_line``: both sets are thinner than
    their points are apart.
    """

    hypotheses: Sequence[PoseHypothesis]
    is_complete: bool
    gap: float
    spacing_m: float
    arm_m: float
    is_line: bool
    min_posterior: float

    @property
    def best(self) -> PoseHypothesis:
        """The hypothesis that is judged."""
        return self.hypotheses[0]

    @cached_property
    def not_finite(self) -> str:
        """The first number that is not finite, with its value; empty where all are."""
        return next(_not_finite(self), "")

    @cached_property
    def probability(self) -> float:
        """Posterior of the best pose against all others and chance."""
        return posterior(self.evidences)

    @property
    def is_coincidence(self) -> bool:
        """Whether the best pose is no better than chance."""
        return posterior([self.best.evidence]) < self.min_posterior

    @property
    def least_evidence(self) -> float:
        """Evidence from which a pose is better than chance [nats]."""
        return math.log(_COINCIDENCE * self.min_posterior / (1.0 - self.min_posterior))

    @cached_property
    def deviation_m(self) -> float:
        """Largest standard deviation [m] along any axis of the pose, rotation times the arm."""
        scale = np.array([self.arm_m, 1.0, 1.0])
        scaled = self.best.covariance * np.outer(scale, scale)
        if not np.isfinite(scaled).all():
            return math.inf
        return math.sqrt(max(float(np.linalg.eigvalsh(scaled)[-1]), 0.0))

    @property
    def max_deviation_m(self) -> float:
        """What that may be."""
        return _OPEN * self.spacing_m

    @cached_property
    def evidences(self) -> list[float]:
        """Of all; a rival that would convince by itself has at least its odds to the best."""
        evidences = [self.best.evidence]
        for rival in self.hypotheses[1:]:
            evidence = rival.evidence
            if posterior([evidence]) >= self.min_posterior:
                evidence = max(evidence, self.best.evidence + rival.log_odds)
            evidences.append(evidence)
        return evidences

    @property
    def fits_in_many_ways(self) -> bool:
        """Whether most points fit, more than by chance were they independent, in many poses."""
        best = self.best
        if best.pair_share < _FIT or posterior([best.independent_evidence]) < self.min_posterior:
            return False
        return self.deviation_m > self.max_deviation_m or any(
            rival.pair_share >= _FIT and rival.log_odds > math.log(1.0 - self.min_posterior)
            for rival in self.hypotheses[1:]
        )

    @property
    def too_little(self) -> str:
        """The evidence that is too little."""
        return f"evidence in nats {at_least(self.best.evidence, self.least_evidence, '.1f')}"


_RULES: tuple[Rule[PointCase, Verdict], ...] = (
    Rule(
        lambda c: not c.is_complete,
        Verdict.BUDGET_EXHAUSTED,
        lambda c: f"the search stopped with a gap of {100.0 * c.gap:.1f} % left to prove",
    ),
    Rule(
        lambda c: c.not_finite != "",
        Verdict.TOO_FEW_FEATURES,
        lambda c: f"the points tell too little to judge their best alignment by: {c.not_finite}",
    ),
    Rule(
        lambda c: c.is_coincidence and c.is_line,
        Verdict.AMBIGUOUS,
        lambda c: (
            "both sets lie on a line, and nothing tells where along it they fit: " + c.too_little
        ),
        most_probability=_DOUBTED,
    ),
    Rule(
        lambda c: c.is_coincidence and c.fits_in_many_ways,
        Verdict.AMBIGUOUS,
        lambda c: (
            f"{100.0 * c.best.pair_share:.0f} % of the points find partners, but they repeat "
            f"each other and do so in other poses as well: {c.too_little}"
        ),
        most_probability=_DOUBTED,
    ),
    Rule(
        lambda c: c.is_coincidence,
        Verdict.IMPROBABLE,
        lambda c: f"the best alignment is no better than chance: {c.too_little}",
    ),
    Rule(
        lambda c: c.deviation_m > c.max_deviation_m,
        Verdict.AMBIGUOUS,
        lambda c: (
            "the points leave the pose open: standard deviation in metres "
            f"{at_most(c.deviation_m, c.max_deviation_m, '.3g')}"
        ),
        most_probability=_DOUBTED,
    ),
    Rule(
        lambda c: c.probability < c.min_posterior,
        Verdict.AMBIGUOUS,
        lambda c: (
            f"another pose explains the points about as well, evidence "
            f"{max(c.evidences[1:]):.1f} against {c.best.evidence:.1f} nats: "
            f"probability {at_least(c.probability, c.min_posterior, '.2f')}"
        ),
    ),
    Rule(
        lambda _: True,
        Verdict.ACCEPTED,
        lambda c: f"evidence {c.best.evidence:.1f} nats, probability {c.probability:.4f}",
    ),
)
"""What makes a match of points accepted: that only the last line applies."""


def decide_points(case: PointCase) -> tuple[Verdict, str, float]:
    """Verdict, its reason with the numbers that decided, and the pose's probability."""
    rule = first_that_applies(_RULES, case)
    probability = 0.0 if case.not_finite else min(case.probability, rule.most_probability)
    return rule.outcome, rule.sentence(case), probability


def _not_finite(case: PointCase) -> Iterator[str]:
    """Minus infinity says that nothing speaks for a pose; that refuses it as it should."""
    numbers = [("the gap", case.gap), ("the spacing", case.spacing_m), ("the arm", case.arm_m)]
    for hypothesis in case.hypotheses:
        for name in ("evidence", "independent_evidence", "log_odds"):
            value = getattr(hypothesis, name)
            numbers.append((name, 0.0 if value == -math.inf else value))
        numbers.append(("pair_share", hypothesis.pair_share))
    return (f"{name} is {value}" for name, value in numbers if not math.isfinite(value))
