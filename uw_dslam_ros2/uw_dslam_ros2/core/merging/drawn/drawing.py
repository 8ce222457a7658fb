"""The global map of one plan after another, drawn when somebody asks for it."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Set as AbstractSet

from uw_dslam_ros2.core.grid import GridSpec
from uw_dslam_ros2.core.merging.config import LOG_ODDS_MAX
from uw_dslam_ros2.core.merging.drawn.global_map import GlobalMap, undrawable
from uw_dslam_ros2.core.merging.graph.submap_groups import StoredSubmap
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId

__all__ = ["Drawing"]


class Drawing:
    """Draws only what is new or has moved."""

    def __init__(self) -> None:
        self._map: GlobalMap | None = None
        self._is_drawn = False
        self._left_out: dict[SubmapId, str] | None = None

    def note_change(self) -> None:
        """Submaps or their places are not what they were."""
        self._is_drawn, self._left_out = False, None

    def restart(self) -> None:
        """The frame has moved."""
        self._map = None
        self.note_change()

    def left_out(
        self,
        lattice: GridSpec,
        submaps: Mapping[SubmapId, StoredSubmap],
        T_map_submap: Mapping[SubmapId, SE2],
    ) -> dict[SubmapId, str]:
        """Which submaps cannot be drawn, and why."""
        if self._left_out is None:
            self._left_out = undrawable(lattice, submaps, T_map_submap)
        return self._left_out

    def drawn(
        self,
        lattice: GridSpec,
        submaps: Mapping[SubmapId, StoredSubmap],
        T_map_submap: Mapping[SubmapId, SE2],
        withdrawn: AbstractSet[SubmapId],
    ) -> GlobalMap:
        """The map, up to date."""
        if self._map is None:
            self._map = GlobalMap(lattice, LOG_ODDS_MAX)
        if not self._is_drawn:
            hidden = withdrawn | self.left_out(lattice, submaps, T_map_submap).keys()
            shown = {i: T for i, T in T_map_submap.items() if i not in hidden}
            self._map.draw(submaps, shown)
            self._is_drawn = True
        return self._map
