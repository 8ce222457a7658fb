"""One registration in this process: servers of a graph are there for the merge."""

from __future__ import annotations

from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.registration.grids.register import GridRegistrationConfig, register_grids
from uw_dslam_ros2.core.registration.result import PriorWindow, RegistrationResult

__all__ = ["register_by_engine"]


def register_by_engine(
    source: OccupancyMap, target: OccupancyMap, prior: PriorWindow | None
) -> RegistrationResult:
    """Register with the defaults."""
    return register_grids(source, target, GridRegistrationConfig(), prior=prior)
