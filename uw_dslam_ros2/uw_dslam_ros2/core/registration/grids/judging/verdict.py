"""From measured quantities to a verdict on a match of two maps."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

from uw_dslam_ros2.core.registration.grids.config import GridRegistrationConfig
from uw_dslam_ros2.core.registration.grids.judging.probability import (
    ENOUGH_DETAIL,
    MODELS,
    MatchEvidence,
    VerdictModels,
    lead_over_decoy,
    probability_of,
    rival_probability,
)
from uw_dslam_ros2.core.registration.result import Verdict
from uw_dslam_ros2.core.registration.rules import Rule, at_least, at_most, first_that_applies

__all__ = ["Proof", "decide"]

_MOST_CONFLICT = 0.4  # of the common walls lie on free space
_IMPROBABLE_CONFLICT = 0.24  # where a match is not probable either, that is why
_LIKE_SHARE = 0.8  # of the common walls agree where two places look alike
_LOOSE_SHARE = 0.1  # of the walls' extent: less sure along its weakest direction is worth saying


@dataclass(frozen=True, slots=True)
class Proof:
    """What a search proved of a pose; the defaults where there was none to be had.

    ``score`` is the pose's own, the bounds are those of the best pose of all; ``is_optimum``:
    the pose is that one, to the gap asked.
    """

    is_complete: bool = True
    is_optimum: bool = True
    is_cancelled: bool = False
    num_boxes: int = 0
    score: float = 0.0
    lower_bound: float = 0.0
    upper_bound: float = 0.0

    @property
    def gap(self) -> float:
        """What is left to prove, relative."""
        return 1.0 - self.lower_bound / max(self.upper_bound, 1e-12)


class _Case:
    """A match as the table below asks about it."""

    def __init__(
        self,
        evidence: MatchEvidence,
        config: GridRegistrationConfig,
        models: VerdictModels,
        proof: Proof,
    ) -> None:
        self.evidence, self.config, self.models, self.proof = evidence, config, models, proof
        self.agreement = evidence.best.agreement
        self.not_finite = next(_not_finite(evidence, proof), "")
        self.probability = 0.0 if self.not_finite else probability_of(evidence, models)
        self.least = 1.0 - config.max_false_accept
        self.is_probable = self.probability >= self.least
        self.max_conflict = _MOST_CONFLICT if self.is_probable else _IMPROBABLE_CONFLICT

    @property
    def alone(self) -> float:
        """Probability without what explains the match otherwise."""
        return probability_of(self.evidence, self.models, is_alone=True)

    @property
    def is_convincing(self) -> bool:
        """Whether the match would be accepted if nothing else explained it."""
        return self.alone >= self.least

    @property
    def beside_rivals(self) -> float:
        """Probability without the question of a mirror."""
        return probability_of(replace(self.evidence, decoy=None), self.models)

    @property
    def rival(self) -> float:
        """Probability of the most convincing rival, were the best pose not there."""
        return rival_probability(self.evidence, self.models)

    @property
    def is_plain(self) -> bool:
        """Whether the maps agree so well that with more detail the match would be accepted."""
        agreement, best = self.agreement, self.evidence.best
        detailed = replace(agreement, num_detail=max(agreement.num_detail, ENOUGH_DETAIL))
        richer = replace(self.evidence, best=replace(best, agreement=detailed))
        is_like = agreement.agreement >= _LIKE_SHARE
        return is_like and probability_of(richer, self.models) >= self.least

    @property
    def lead(self) -> float:
        """By how much more the best pose convinces than that of the source in a mirror."""
        return lead_over_decoy(self.evidence, self.models)

    @property
    def improbable(self) -> str:
        """The probability that is too small."""
        text = at_least(self.probability, self.least, ".2f")
        return f"right with probability {text}"

    @property
    def measured(self) -> str:
        """What the probability is made of."""
        agreement = self.agreement
        return (
            f"{agreement.agreement:.0%} of the common walls agree, {agreement.conflict:.0%} "
            f"conflict, overlap {agreement.overlap:.0%}, best rival "
            f"{self.evidence.rival_share:.0%}, score {self.evidence.best.surprise:.1f} "
            f"deviations above chance, on cells of {self.evidence.cell_m:.2g} m"
        )

    @property
    def higher(self) -> str:
        """That another pose scores higher."""
        proof = self.proof
        return (
            f"another pose has a higher score, {proof.lower_bound:.3f} against {proof.score:.3f}"
        )

    @property
    def open_gap(self) -> str:
        """Where the proof ended."""
        return (
            f"the proof stopped after {self.proof.num_boxes} boxes with a gap of "
            f"{self.proof.gap:.0%}, asked were {self.config.gap:.0%}"
        )


_RULES: tuple[Rule[_Case, Verdict], ...] = (
    Rule(
        lambda c: c.proof.is_cancelled,
        Verdict.BUDGET_EXHAUSTED,
        lambda c: f"cancelled after {c.proof.num_boxes} boxes, before the proof was complete",
    ),
    Rule(
        lambda c: c.not_finite != "",
        Verdict.TOO_FEW_FEATURES,
        lambda c: f"the maps hold too little to judge their best alignment by: {c.not_finite}",
    ),
    Rule(
        lambda c: c.agreement.overlap < c.config.min_overlap,
        Verdict.NOT_ENOUGH_OVERLAP,
        lambda c: (
            "share of the smaller map's seen area that the best alignment has in common: "
            f"{at_least(c.agreement.overlap, c.config.min_overlap)}"
        ),
    ),
    Rule(
        lambda c: c.agreement.conflict > c.max_conflict,
        Verdict.CONTRADICTED,
        lambda c: (
            "share of the common walls that lie on the other map's free space: "
            + at_most(c.agreement.conflict, c.max_conflict)
            + ("" if c.is_probable else f" of what is {c.improbable}")
        ),
    ),
    Rule(
        lambda c: c.is_convincing and c.beside_rivals < c.least,
        Verdict.AMBIGUOUS,
        lambda c: (
            f"another pose agrees about as well where it overlaps: beside it, {c.improbable}; "
            f"if this one were not there, that one would be with {c.rival:.2f}; best score of "
            f"another: {c.evidence.rival_share:.0%} of this one's"
        ),
    ),
    Rule(
        lambda c: c.is_convincing and not c.is_probable and c.lead < 0.0,
        Verdict.AMBIGUOUS,
        lambda c: (
            "in a mirror the source agrees better than as it is, by odds of "
            f"{math.exp(-c.lead):.1f}: one of the maps may have left and right exchanged, so "
            f"this is {c.improbable}"
        ),
    ),
    Rule(
        lambda c: c.is_convincing and not c.is_probable,
        Verdict.AMBIGUOUS,
        lambda c: (
            "hardly more than straight walls agrees, and in a mirror, where no pose is right, "
            f"about as well: {c.improbable}; {c.agreement.num_detail:.0f} cells of detail, "
            f"{c.measured}"
        ),
    ),
    Rule(
        lambda c: not c.is_probable and c.is_plain,
        Verdict.AMBIGUOUS,
        lambda c: (
            f"what agrees are a few straight walls, as many places have them: {c.improbable}; "
            f"{c.agreement.num_detail:.0f} cells of detail, {c.measured}"
        ),
    ),
    Rule(
        lambda c: not c.is_probable,
        Verdict.IMPROBABLE,
        lambda c: f"{c.improbable}: {c.measured}",
    ),
    Rule(
        lambda c: c.config.is_proof_required and not c.proof.is_optimum,
        Verdict.AMBIGUOUS,
        lambda c: f"a proof is required, but {c.higher}: {c.measured}",
    ),
    Rule(
        lambda c: c.config.is_proof_required and not c.proof.is_complete,
        Verdict.BUDGET_EXHAUSTED,
        lambda c: f"a proof is required, but {c.open_gap}",
    ),
    Rule(lambda _: True, Verdict.ACCEPTED, lambda c: c.measured),
)
"""What makes a match of two maps accepted: that only the last line applies.

Evidence decides what is right; a proof only says how much better another pose could score.
"""


def decide(
    evidence: MatchEvidence,
    config: GridRegistrationConfig,
    models: VerdictModels = MODELS,
    proof: Proof | None = None,
) -> tuple[Verdict, str, float]:
    """Verdict, its reason with the numbers that decided, and the pose's probability.

    ``proof`` is None where the search is still to come, or of no interest.
    """
    case = _Case(evidence, config, models, proof or Proof())
    rule = first_that_applies(_RULES, case)
    reason = rule.sentence(case)
    if rule.outcome is Verdict.ACCEPTED:
        if evidence.deviation_m > _LOOSE_SHARE * evidence.extent_m:
            reason += (
                "; the walls leave one direction free, as those of a corridor do: along it the "
                f"standard deviation is {evidence.deviation_m:.2g} m"
            )
        if not case.proof.is_optimum:
            reason += f"; {case.higher}, but the maps speak for this one"
        if not case.proof.is_complete:
            reason += f"; {case.open_gap}"
    return rule.outcome, reason, case.probability


def _not_finite(evidence: MatchEvidence, proof: Proof) -> Iterator[str]:
    """What is not a finite number, with its value."""
    numbers = [
        ("the standard deviation", evidence.deviation_m),
        ("the extent of the walls", evidence.extent_m),
        ("the number of poses searched", evidence.log_volume),
        ("the side of the cells", evidence.cell_m),
        ("the score in the search", proof.score),
        ("the lower bound", proof.lower_bound),
        ("the upper bound", proof.upper_bound),
    ]
    poses = [("", evidence.best), *((" of a rival", r) for r in evidence.rivals)]
    if evidence.decoy is not None:
        poses.append((" in a mirror", evidence.decoy))
        numbers.append(("the number of poses in a mirror", evidence.decoy_log_volume))
    for whose, pose in poses:
        numbers += [(f"the score{whose}", pose.score), (f"the surprise{whose}", pose.surprise)]
        for field in dataclasses.fields(pose.agreement):
            numbers.append((f"{field.name}{whose}", getattr(pose.agreement, field.name)))
    return (f"{name} is {value}" for name, value in numbers if not math.isfinite(value))
