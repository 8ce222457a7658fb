"""What a registration answers."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

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


@dataclass(frozen=True, slots=True)
class PriorWindow:
    """Search only where ``T_target_source`` is within these half-widths (> 0) of a guess."""

    T_target_source: SE2
    half_width_m: float
    half_width_rad: float


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

    ``T_target_source`` is the best guess even where the verdict refuses it, for logs and
    pictures: callers must look at `is_accepted`. Scores and bounds are in one unit, 1 being a
    perfect match of all source weight; ``score`` is of ``T_target_source``, the bounds are of the
    objective's maximum, which may be another pose where evidence speaks against that.
    """

    verdict: Verdict
    reason: str
    T_target_source: SE2
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
    inlier_ratio: float
    num_source_points: int
    num_target_points: int
    rivals: tuple[Rival, ...] = ()
    source_points: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 2)))
    target_points: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 2)))
    # Of source_points.
    is_inlier: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, dtype=np.bool_))

    @property
    def is_accepted(self) -> bool:
        """Whether the transform may be used."""
        return self.verdict is Verdict.ACCEPTED

    @property
    def gap(self) -> float:
        """Relative gap between the bounds, in [0, 1]."""
        return _relative_gap(self.lower_bound, self.upper_bound)
