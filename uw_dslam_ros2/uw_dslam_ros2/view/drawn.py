"""The maps that are shown, drawn again only where something has changed."""

from __future__ import annotations

from collections.abc import Hashable, Mapping

from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.merging.config import LOG_ODDS_MAX
from uw_dslam_ros2.core.merging.drawn.global_map import GlobalMap, pinned_lattice
from uw_dslam_ros2.core.merging.graph.submap_groups import StoredSubmap
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId
from uw_dslam_ros2.view.tiles import TILE_PIXELS, Layer, tile_png

__all__ = ["Drawn"]

_MAX_TILES = 2000
_Bounds = tuple[float, float, float, float]


class Drawn:
    """All groups' maps at one moment, and the tiles that were made of them."""

    def __init__(self) -> None:
        self._maps: dict[int, tuple[GlobalMap, Layer]] = {}
        self._tiles: dict[tuple[int, int, int], bytes | None] = {}
        self._state: Hashable = None

    def show(
        self,
        state: Hashable,
        stored: Mapping[SubmapId, StoredSubmap],
        groups: Mapping[int, Mapping[SubmapId, SE2]],
        T_view_group: Mapping[int, SE2],
    ) -> None:
        """Have it show these submaps; an equal state is what it shows already.

        Parameters
        ----------
        groups
            Of each the poses of its submaps in its own frame.
        T_view_group
            Where these frames lie on the page.
        """
        if state == self._state:
            return
        self._state = state
        for gone in self._maps.keys() - groups.keys():
            self._drop(self._maps.pop(gone)[1].bounds())
        for group, poses in groups.items():
            if not poses and group not in self._maps:
                continue
            fused, layer = self._map_of(group, stored, poses)
            if layer.T_view_map != T_view_group[group]:
                self._drop(layer.bounds())
                layer.T_view_map = T_view_group[group]
                self._drop(layer.bounds())
            fused.draw(stored, poses)
            changed = fused.take_changed()
            if changed is not None:
                layer.change(fused.squares(), changed[1])
                self._drop(layer.bounds_of_cells(changed[1]))

    def map_of(self, group: int) -> OccupancyMap | None:
        """One group's map in its own frame; None where nothing was seen."""
        return self._maps[group][0].occupancy() if group in self._maps else None

    def tile(self, zoom: int, col: int, row: int) -> bytes | None:
        """As `tile_png`."""
        key = zoom, col, row
        if key not in self._tiles:
            if len(self._tiles) >= _MAX_TILES:
                self._tiles.clear()
            self._tiles[key] = tile_png([layer for _, layer in self._maps.values()], *key)
        return self._tiles[key]

    def _map_of(
        self, group: int, stored: Mapping[SubmapId, StoredSubmap], poses: Mapping[SubmapId, SE2]
    ) -> tuple[GlobalMap, Layer]:
        if group not in self._maps:
            spec = stored[next(iter(poses))].submap.grid.spec
            lattice = pinned_lattice(spec, spec.resolution_m)
            fused = GlobalMap(lattice, LOG_ODDS_MAX)
            self._maps[group] = fused, Layer(lattice, fused.square)
        return self._maps[group]

    def _drop(self, bounds: _Bounds | None) -> None:
        """Forget the tiles that show something of a rectangle of the page."""
        if bounds is None:
            return
        low_x, low_y, high_x, high_y = bounds
        for key in list(self._tiles):
            zoom, col, row = key
            # A cell of a coarse level reaches beyond the rectangle by at most a pixel.
            side_m, margin_m = TILE_PIXELS * 2.0**-zoom, 2.0 * 2.0**-zoom
            if (
                low_x - margin_m < (col + 1) * side_m
                and high_x + margin_m > col * side_m
                and low_y - margin_m < -row * side_m
                and high_y + margin_m > -(row + 1) * side_m
            ):
                del self._tiles[key]
