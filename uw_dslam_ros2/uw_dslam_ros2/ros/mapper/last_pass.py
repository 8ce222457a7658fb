"""What a mapper does once mapping is finished: all its submaps, drawn anew from its own pings."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from uw_dslam_ros2.core.chart.pings import KeptPings
from uw_dslam_ros2.core.mapping import OccupancyConfig, Submap, VehicleMapper

__all__ = ["LastPass"]

_MAX_BYTES = 128 * 2**20
"""Of pings that are kept; one takes about three kilobytes, so it is hours of way."""


class LastPass:
    """Keeps pings while mapping goes on, and draws every run anew at its end.

    Parameters
    ----------
    config
        Grid and sensor model of the mappers.
    warn
        Called once, when no more pings are kept.
    """

    def __init__(self, config: OccupancyConfig, warn: Callable[[str], None]) -> None:
        self._config, self._warn = config, warn
        self._is_told = False
        self.pings = KeptPings(_MAX_BYTES)
        """To be the mappers' watch."""

    def look(self) -> None:
        """Say so if pings are left out from now on."""
        if self.pings.num_left_out and not self._is_told:
            self._is_told = True
            self._warn(
                f"{self.pings.num_bytes / 2**20:.0f} MiB of pings are kept, and no more: what is "
                "mapped from now on will not be drawn anew when mapping is finished"
            )

    def draw(self, mappers: Iterable[VehicleMapper]) -> list[Submap]:
        """Give mappers that have finished their submaps drawn anew, and return these."""
        # SciPy's solvers are large, and most of a node's life goes by without them.
        from uw_dslam_ros2.core.chart.redraw import redrawn

        result: list[Submap] = []
        for mapper in mappers:
            submaps = redrawn(mapper.submaps(), self.pings.of_submap, self._config)
            if submaps:
                mapper.replace(submaps)
                result += submaps
        self.pings.of_submap.clear()
        return result
