"""What a mapper keeps beside its closed submaps, so that another process goes on with its run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.navigation import FilterState
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar import Detections
from uw_dslam_ros2.core.submap import Submap

__all__ = ["HeldSubmaps", "MapperState", "SectionState"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class SectionState:
    """What the open submap holds but its grid, or what has come to it since some moment."""

    num_pings: int
    num_drawn: int
    """Of them, how many are in the grid."""
    trajectory: FloatArray
    """``T_submap_base`` of each ping (K, 3)."""
    stamps_ns: NDArray[np.int64]
    points: FloatArray
    """Echoes (N, 2) [m] for matching, in the submap's frame."""
    weight: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class MapperState:
    """A mapper between two pings."""

    run_id: int
    beamwidth_rad: float
    """Of the sonar that its settings are suited to."""
    last_ping_ns: int
    velocity_ns: int | None
    navigation: FilterState
    dead_reckoning: FilterState | None
    T_odom_submap: FloatArray
    """(K, 3) of all submaps, the open one last."""
    covariance: FloatArray
    """(3, 3) of the open one's pose, as in `Submap`."""
    section: SectionState

    @property
    def sequence(self) -> int:
        """Number of the open submap."""
        return len(self.T_odom_submap) - 1


@dataclass(frozen=True, slots=True, eq=False)
class HeldSubmaps:
    """The submaps of a run whose `MapperState` is kept."""

    closed: list[tuple[Submap, FloatArray]]
    """As given away last, with the weights (N,) of their points. That which was open when the
    state was kept is among them if it has closed since."""
    drawn: list[tuple[Detections, SE2]]
    """Pings that entered the grid of the open one, and their ``T_submap_sonar``."""

    def num_pings(self, state: MapperState) -> int:
        """Of all, the open one included."""
        own = len(state.section.stamps_ns) if len(self.closed) == state.sequence else 0
        return own + sum(len(submap.trajectory) for submap, _ in self.closed)
