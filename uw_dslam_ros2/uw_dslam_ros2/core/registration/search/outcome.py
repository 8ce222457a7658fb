"""What a search is asked for, and what it answers."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.registration.search.rivals import Neighborhoods
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["SearchOutcome", "SearchSettings", "Status"]

FloatArray = NDArray[np.float64]


class Status(enum.Enum):
    """Why a search ended."""

    CERTIFIED = "certified"
    BOXES = "boxes"
    TIME = "time"
    MEMORY = "memory"
    CANCELLED = "cancelled"


@dataclass(frozen=True, slots=True)
class SearchSettings:
    """When a search may end."""

    gap: float = 0.01  # relative: (upper - lower) / upper
    max_boxes: int = 10_000_000
    max_seconds: float = math.inf  # counts only with a clock
    max_memory_mb: float = 512.0  # of the open boxes
    keep: float = 1.0  # share of the best value down to which rivals are looked for
    rival_share: float = 1.0  # boxes for that, as a share of those that the proof took


@dataclass(frozen=True, slots=True, eq=False)
class SearchOutcome:
    """Pose and proof. Bounds are sums over all terms, not normalised."""

    T_target_source: SE2
    pose: FloatArray  # (3,), the same as theta, x, y of the problem
    lower_bound: float  # value at the pose, less the rounding margin
    upper_bound: float  # no pose of the window exceeds it
    status: Status
    num_boxes: int  # bounded one by one, and a share of the cells that costs as much as a box
    num_cells: int  # boxes bounded together, by a sweep
    num_open_boxes: int
    seconds: float  # NaN without a clock
    optima: FloatArray  # (F, 4): value, x, y, yaw of local optima met, best first, each pose once
    rivals: (
        FloatArray  # (R, 5): value, bound, x, y, yaw of other optima from `keep` on, best first
    )
    upper_elsewhere: float  # no pose beyond all neighbourhoods exceeds it
    has_all_rivals: bool  # every pose above `keep` is in a neighbourhood, or uphill leads to one
    neighborhoods: Neighborhoods
    open_poses: FloatArray  # (K, 3), middles of the most promising boxes that were left open

    @property
    def is_complete(self) -> bool:
        """Whether the gap was closed."""
        return self.status is Status.CERTIFIED

    def upper_bound_near(self, T_target_source: SE2) -> float:
        """Proven upper bound around a pose of the window: in its neighbourhood, or elsewhere."""
        return min(self.upper_bound, self.neighborhoods.upper_bound(T_target_source))

    @property
    def gap(self) -> float:
        """Relative gap, 0 where there is nothing to gain."""
        return (
            max(0.0, 1.0 - self.lower_bound / self.upper_bound) if self.upper_bound > 0.0 else 0.0
        )
