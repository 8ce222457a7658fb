"""A queue that rests, such as that of a saved session, as what a view shows."""

from __future__ import annotations

from typing import Any

from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.merging import MapQueue
from uw_dslam_ros2.core.registration.grids.register import GridRegistrationConfig, register_grids
from uw_dslam_ros2.core.registration.result import PriorWindow, RegistrationResult
from uw_dslam_ros2.view.showing import Register, Showing

__all__ = ["QueueSource", "register_by_engine"]


class QueueSource:
    """A queue that does not change."""

    def __init__(self, title: str, queue: MapQueue) -> None:
        self.title = title
        self._showing = Showing.of_queue(queue)

    def showing(self) -> Showing:
        """The only state."""
        return self._showing

    def status(self) -> dict[str, Any]:
        """Nothing changes."""
        return {"is_live": False}

    def register(self) -> Register:
        """The engine itself."""
        return register_by_engine


def register_by_engine(
    source: OccupancyMap, target: OccupancyMap, prior: PriorWindow | None
) -> RegistrationResult:
    """Register in this process, with the defaults."""
    return register_grids(source, target, GridRegistrationConfig(), prior=prior)
