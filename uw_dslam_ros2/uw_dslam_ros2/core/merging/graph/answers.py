"""Matches that the queue wants, and the answers it has had."""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.merging.graph.submap_groups import SubmapGroup
from uw_dslam_ros2.core.registration.result import PriorWindow, RegistrationResult, Verdict
from uw_dslam_ros2.core.registration.rules import Rule, first_that_applies
from uw_dslam_ros2.core.se2 import SE2, wrap_angle

__all__ = ["Answer", "AnswerBook", "Query", "QueryKey", "Use"]

FloatArray = NDArray[np.float64]

# Refused for want of evidence, not because something speaks against the pose.
_UNSURE = Verdict.NOT_ENOUGH_OVERLAP, Verdict.IMPROBABLE
_WORTH_ASKING = 0.5  # probability from which an unsure pose is

QueryKey = tuple[bytes, bytes, tuple[float, ...]]
"""Source group, target group, prior: equal keys are the same question and get the same answer."""


@dataclass(frozen=True, slots=True, eq=False)
class Query:
    """A question: where the source lies in the target."""

    source: SubmapGroup
    target: SubmapGroup
    prior: PriorWindow | None = None

    @property
    def key(self) -> QueryKey:
        """What makes two questions the same."""
        return self.source.key, self.target.key, _prior_key(self.prior)


class Use(enum.IntEnum):
    """What the queue does with an answer; each one may do what those before it may."""

    NOTHING = 0
    VOTE = 1
    """Speaks for other answers that agree with it, and is believed if enough of them do."""
    CLAIM = 2
    """Is worth asking others about."""
    EDGE = 3
    """Is believed by itself, as long as those others do not contradict it."""


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """What is kept of a `RegistrationResult`, with the question, and what is done with it.

    ``why`` is the reason for that: the result's own, or what the queue has against it.
    """

    query: Query
    verdict: Verdict
    reason: str
    T_target_source: SE2 | None  # None where no pose was judged
    covariance: FloatArray
    probability: float
    numbers: dict[str, float] = field(default_factory=dict)  # of the result, for reports
    use: Use = field(init=False)
    why: str = field(init=False)

    def __post_init__(self) -> None:
        rule = first_that_applies(_RULES, self)
        object.__setattr__(self, "use", rule.outcome)
        object.__setattr__(self, "why", rule.sentence(self))

    @classmethod
    def of(cls, query: Query, result: RegistrationResult) -> Answer:
        """What to keep of a result."""
        return cls(
            query,
            result.verdict,
            result.reason,
            result.T_target_source,
            np.array(result.covariance, dtype=np.float64),
            result.probability,
            _numbers_of(result),
        )

    @property
    def is_accepted(self) -> bool:
        """Whether it is believed by itself."""
        return self.use is Use.EDGE

    @property
    def is_finite(self) -> bool:
        """Whether probability and covariance are numbers."""
        return math.isfinite(self.probability) and bool(np.isfinite(self.covariance).all())

    def is_of(self, vehicle_id: str) -> bool:
        """Whether a submap of a vehicle was asked about."""
        groups = self.query.source, self.query.target
        return any(i.vehicle_id == vehicle_id for group in groups for i in group.ids)

    def is_about(self, prior: PriorWindow) -> bool:
        """Whether nearly this window was searched: the middle of each lies well in the other."""
        own = self.query.prior
        if own is None:
            return False
        one, other = own.T_target_source, prior.T_target_source
        reach_m = 0.5 * min(own.half_width_m, prior.half_width_m)
        reach_rad = 0.5 * min(own.half_width_rad, prior.half_width_rad)
        return (
            max(abs(one.x - other.x), abs(one.y - other.y)) <= reach_m
            and abs(wrap_angle(one.yaw - other.yaw)) <= reach_rad
        )

    def is_inside(self, prior: PriorWindow | None) -> bool:
        """Whether there is a transform, and where there is a window, that lies in it."""
        found = self.T_target_source
        if prior is None or found is None:
            return found is not None
        guess = prior.T_target_source
        # A refinement may step over the border by a little.
        return (
            abs(found.x - guess.x) <= 1.1 * prior.half_width_m
            and abs(found.y - guess.y) <= 1.1 * prior.half_width_m
            and abs(wrap_angle(found.yaw - guess.yaw)) <= 1.1 * prior.half_width_rad
        )


_RULES: tuple[Rule[Answer, Use], ...] = (
    Rule(lambda a: a.T_target_source is None, Use.NOTHING, lambda a: a.reason),
    Rule(
        lambda a: not a.is_inside(a.query.prior),
        Use.NOTHING,
        lambda a: f"{a.reason}; but the pose is outside the window that was asked for",
    ),
    Rule(
        lambda a: a.verdict not in (*_UNSURE, Verdict.ACCEPTED),
        Use.NOTHING,
        lambda a: a.reason,
    ),
    Rule(
        lambda a: not a.is_finite,
        Use.NOTHING,
        lambda a: (
            f"{a.reason}; but its probability {a.probability} and covariance "
            f"{a.covariance.tolist()} are not finite"
        ),
    ),
    Rule(lambda a: a.verdict is Verdict.ACCEPTED, Use.EDGE, lambda a: a.reason),
    Rule(lambda a: a.probability >= _WORTH_ASKING, Use.CLAIM, lambda a: a.reason),
    Rule(lambda _: True, Use.VOTE, lambda a: a.reason),
)
"""What the queue does with an answer. How votes are counted, `voting.weigh` says."""


class AnswerBook:
    """Answers by question.

    A question near a guess needs not be asked where the same two maps were matched in another
    window, if what was found there lies in this one too.

    Parameters
    ----------
    answers
        All that there are.
    is_lenient
        Take also maps of the same submaps with slightly different poses for the same: quicker,
        but then it counts what was asked before.
    """

    def __init__(self, answers: Mapping[QueryKey, Answer], *, is_lenient: bool) -> None:
        self._answers, self._is_lenient = answers, is_lenient
        self._seen: dict[object, list[Answer]] = {}
        if is_lenient:
            for answer in answers.values():
                self._note(answer)

    def find(self, query: Query) -> Answer | None:
        """The answer to exactly this question."""
        answer = self._answers.get(query.key)
        if answer is not None and not self._is_lenient:
            self._note(answer)
        return answer

    def find_similar(self, query: Query) -> Answer | None:
        """An answer that serves as well; of the questions that were found before, or of all."""
        if query.prior is None:
            return None
        for earlier in self._seen.get(self._maps_of(query), ()):
            if earlier.use >= Use.VOTE and earlier.is_inside(query.prior):
                return earlier
            if self._is_lenient and earlier.is_about(query.prior):
                return earlier
        return None

    def _note(self, answer: Answer) -> None:
        if answer.query.prior is not None:
            self._seen.setdefault(self._maps_of(answer.query), []).append(answer)

    def _maps_of(self, query: Query) -> object:
        if self._is_lenient:
            return query.source.ids, query.target.ids
        return query.source.key, query.target.key


_NUMBERS = (
    "score",
    "lower_bound",
    "upper_bound",
    "is_certified",
    "num_boxes",
    "overlap",
    "conflict_ratio",
    "inlier_ratio",
    "num_source_points",
    "num_target_points",
)


def _numbers_of(result: RegistrationResult) -> dict[str, float]:
    """Proof and measurements of a result by name, where known; no times, which differ each run."""
    values = {name: float(getattr(result, name)) for name in _NUMBERS}
    return {name: value for name, value in values.items() if math.isfinite(value)}


def _prior_key(prior: PriorWindow | None) -> tuple[float, ...]:
    if prior is None:
        return ()
    return (*prior.T_target_source.as_array().tolist(), prior.half_width_m, prior.half_width_rad)
