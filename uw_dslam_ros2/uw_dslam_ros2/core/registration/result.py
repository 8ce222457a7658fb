"""What a registration answers."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field
from typing import Self

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["PriorWindow", "Progress", "RegistrationResult", "Rival", "Verdict"]


def _relative_gap(lower_bound: float, upper_bound: float) -> float:
    return (upper_bound - lower_bound) / upper_bound if upper_bound > 0.0 else 0.0


class Verdict(enum.IntEnum):
    """Outcome of a match; the numbers are those of ``uw_dslam_msgs/Registration``."""

    ACCEPTED = 1
    TOO_FEW_FEATURES = 2
    NOT_ENOUGH_OVERLAP = 3
    AMBIGUOUS = 4
    CONTRADICTED = 5
    BUDGET_EXHAUSTED = 6
    IMPROBABLE = 7


@dataclass(frozen=True, slots=True)
class PriorWindow:
    """Search only where ``T_target_source`` is within these half-widths (> 0) of a guess."""

    T_target_source: SE2
    half_width_m: float
    half_width_rad: float

    def __post_init__(self) -> None:
        for name in ("half_width_m", "half_width_rad"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise InvalidInputError(f"the prior's {name} is {value}, expected more than 0")


@dataclass(frozen=True, slots=True)
class Rival:
    """Another pose that was not excluded; scores as shares of the best score."""

    T_target_source: SE2
    score: float
    upper_bound: float


@dataclass(frozen=True, slots=True)
class Progress:
    """State of a running search, for feedback."""

    stage: str
    lower_bound: float
    upper_bound: float
    num_boxes: int
    num_open_boxes: int
    T_target_source: SE2

    @property
    def gap(self) -> float:
        """Relative gap, in [0, 1]."""
        return _relative_gap(self.lower_bound, self.upper_bound)


@dataclass(frozen=True, slots=True, eq=False)
class RegistrationResult:
    """Outcome of one match. "Nothing found" is a result; only wrong input is an exception.

    ``T_target_source`` is the best guess even where the verdict refuses it, for logs, pictures and
    votes: callers must look at `is_accepted`. It is None, its covariance and score NaN, where no
    pose was judged: see `refused`. Scores and bounds are in one unit, 1 being a perfect match of
    all source weight (of maps: of the one with the smaller known area); ``score`` is of
    ``T_target_source``, the bounds are of the objective's maximum, which may be another pose where
    evidence speaks against that.
    """

    verdict: Verdict
    reason: str
    T_target_source: SE2 | None
    covariance: NDArray[np.float64]  # (3, 3), order x [m], y [m], yaw [rad], target frame
    probability: float  # that the transform is right, calibrated
    score: float
    lower_bound: float
    upper_bound: float
    is_certified: bool
    num_boxes: int
    seconds: float  # by the clock that was passed in; NaN without one
    overlap: float  # NaN for point sets
    conflict_ratio: float  # NaN for point sets
    inlier_ratio: float  # NaN where no pose was judged
    num_source_points: int
    num_target_points: int
    rivals: tuple[Rival, ...] = ()
    source_points: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 2)))
    target_points: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 2)))
    # Of source_points.
    is_inlier: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, dtype=np.bool_))

    @classmethod
    def refused(
        cls,
        verdict: Verdict,
        reason: str,
        *,
        best_so_far: Progress | None = None,
        seconds: float = math.nan,
        num_points: tuple[int, int] = (0, 0),
    ) -> Self:
        """Answer to a question of which no pose was judged.

        Nothing is made up: there is no transform, no number about one, and probability 0; of the
        bounds only what holds for any two inputs, 0 and 1.

        Parameters
        ----------
        verdict, reason
            Why; any but ACCEPTED.
        best_so_far
            Of a search that was stopped: its bounds, and the pose that it would have gone on with.
        seconds
            Time taken.
        num_points
            Feature points of source and target.
        """
        if verdict is Verdict.ACCEPTED:
            raise ValueError(f"the verdict of a refusal is {verdict.name}, expected another")
        best = best_so_far
        return cls(
            verdict=verdict,
            reason=reason,
            T_target_source=best.T_target_source if best else None,
            covariance=np.full((3, 3), math.nan),
            probability=0.0,
            score=best.lower_bound if best else math.nan,
            lower_bound=best.lower_bound if best else 0.0,
            upper_bound=best.upper_bound if best else 1.0,
            is_certified=False,
            num_boxes=best.num_boxes if best else 0,
            seconds=seconds,
            overlap=math.nan,
            conflict_ratio=math.nan,
            inlier_ratio=math.nan,
            num_source_points=num_points[0],
            num_target_points=num_points[1],
        )

    @property
    def is_accepted(self) -> bool:
        """Whether the transform may be used."""
        return self.verdict is Verdict.ACCEPTED

    @property
    def gap(self) -> float:
        """Relative gap between the bounds, in [0, 1]."""
        return _relative_gap(self.lower_bound, self.upper_bound)
