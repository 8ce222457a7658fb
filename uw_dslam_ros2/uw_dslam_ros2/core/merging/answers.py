"""Matches that the queue wants, and the answers it has had."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.merging.units import Unit
from uw_dslam_ros2.core.registration.result import PriorWindow, RegistrationResult, Verdict
from uw_dslam_ros2.core.se2 import SE2, wrap_angle

__all__ = ["Answer", "Match", "MatchKey", "numbers_of"]

FloatArray = NDArray[np.float64]

MatchKey = tuple[bytes, bytes, tuple[float, ...]]
"""Source unit, target unit, prior: equal keys are the same question and get the same answer."""


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """A question: where the source lies in the target."""

    source: Unit
    target: Unit
    prior: PriorWindow | None = None

    @property
    def key(self) -> MatchKey:
        """What makes two questions the same."""
        return self.source.key, self.target.key, _prior_key(self.prior)


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """What is kept of a `RegistrationResult`, with the question."""

    match: Match
    verdict: Verdict
    reason: str
    T_target_source: SE2
    covariance: FloatArray
    probability: float
    numbers: dict[str, float] = field(default_factory=dict)  # of the result, for reports

    @property
    def is_accepted(self) -> bool:
        """Accepted, and where a window was asked for, inside it."""
        return self.verdict is Verdict.ACCEPTED and self.is_inside(self.match.prior)

    @property
    def is_guess(self) -> bool:
        """Whether the transform means anything: accepted, or merely not sure enough."""
        is_unsure = self.verdict in (Verdict.ACCEPTED, Verdict.NOT_ENOUGH_OVERLAP)
        return is_unsure and self.is_inside(self.match.prior)

    def is_inside(self, prior: PriorWindow | None) -> bool:
        """Whether the transform lies in a window, or there is none."""
        if prior is None:
            return True
        guess, found = prior.T_target_source, self.T_target_source
        # A refinement may step over the border by a little.
        return (
            abs(found.x - guess.x) <= 1.1 * prior.half_width_m
            and abs(found.y - guess.y) <= 1.1 * prior.half_width_m
            and abs(wrap_angle(found.yaw - guess.yaw)) <= 1.1 * prior.half_width_rad
        )


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


def numbers_of(result: RegistrationResult) -> dict[str, float]:
    """Proof and measurements of a result by name, where known; no times, which differ each run."""
    values = {name: float(getattr(result, name)) for name in _NUMBERS}
    return {name: value for name, value in values.items() if math.isfinite(value)}


def _prior_key(prior: PriorWindow | None) -> tuple[float, ...]:
    if prior is None:
        return ()
    return (*prior.T_target_source.as_array().tolist(), prior.half_width_m, prior.half_width_rad)
