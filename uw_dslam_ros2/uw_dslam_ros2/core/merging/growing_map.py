"""One vehicle's map that grows as a whole, told as submaps: for vehicles that send no submaps.

Programs for SLAM publish an occupancy grid over and over: it grows, its outline and the place of
its cells change, and where a loop closes the drawn walls jump. The map is cut into square tiles
that stay where they are in the vehicle's frame. Each is to the map queue what a submap is, and is
given again when enough of it has changed; so most questions that were answered stay answered.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from uw_dslam_ros2.core.config import Config, setting
from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import UNKNOWN, GridSpec, OccupancyMap
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap

__all__ = ["GrowingMap", "GrowingMapConfig", "MapChange"]

Tile = tuple[int, int]
"""Column and row of a tile."""
CellArray = NDArray[np.int8]

_WALL_PERCENT = 50
_BEND = 0.005
"""How far an independent map is bent: metres for each metre, and a fifth of it in radians."""
_JUMP_SHARE = 0.5
"""Of the walls that were there before: where more are elsewhere now, the map has jumped."""


@dataclass(frozen=True, slots=True)
class GrowingMapConfig(Config):
    """How a map that grows as a whole is cut into submaps."""

    tile_m: float = setting(25.0, 1.0, 1000.0, "side of the squares that a map is cut into [m]")
    min_change: float = setting(
        0.1, 0.001, 1.0, "share of a square that must have changed before it is matched again"
    )
    max_cells: int = setting(
        64_000_000, 1, 2_000_000_000, "largest grid that is taken, unknown cells included"
    )


@dataclass(frozen=True, slots=True, eq=False)
class MapChange:
    """What is new in a map."""

    submaps: tuple[Submap, ...]
    has_jumped: bool
    """What was found out about the map before does not hold any more."""


@dataclass(slots=True, eq=False)
class _Given:
    """A tile as it was given last."""

    sequence: int
    revision: int
    grid: OccupancyMap


class GrowingMap:
    """Cuts the maps of one vehicle into submaps.

    Parameters
    ----------
    vehicle_id
        The vehicle's name.
    config
        Settings.
    submaps
        Those that were given before, to go on from them.
    """

    def __init__(
        self, vehicle_id: str, config: GrowingMapConfig, submaps: Iterable[Submap] = ()
    ) -> None:
        self._vehicle_id, self._config = vehicle_id, config
        self._given: dict[Tile, _Given] = {}
        self._last: Tile | None = None
        self._newest: tuple[OccupancyMap, int] | None = None
        for submap in sorted(submaps, key=lambda submap: submap.sequence):
            x, y = submap.T_odom_submap.x, submap.T_odom_submap.y
            tile = math.floor(x / config.tile_m), math.floor(y / config.tile_m)
            self._given[tile] = _Given(submap.sequence, submap.revision, submap.grid)
            self._last = tile

    def update(self, occupancy: OccupancyMap, stamp_ns: int) -> MapChange:
        """Take the whole map as it is now, in a frame of the vehicle that stays the same.

        Raises
        ------
        InvalidInputError
            If the grid is larger than the settings allow.
        """
        if occupancy.values.size > self._config.max_cells:
            raise InvalidInputError(
                f"the map has {occupancy.values.size} cells, "
                f"expected at most {self._config.max_cells}"
            )
        self._newest = occupancy, stamp_ns
        return self._changes(self._config.min_change)

    def rest(self) -> MapChange:
        """What has changed too little until now; for when nothing more is expected soon."""
        return self._changes(0.0)

    def _changes(self, min_change: float) -> MapChange:
        if self._newest is None:
            return MapChange((), has_jumped=False)
        occupancy, stamp_ns = self._newest
        pieces = self._cut(occupancy)
        changes: dict[Tile, float] = {}
        num_walls = num_lost = 0
        for tile in pieces.keys() | self._given.keys():
            piece, before = pieces.get(tile), self._given.get(tile)
            if before is None:
                assert piece is not None
                changes[tile] = _known_m2(piece) / self._config.tile_m**2
                continue
            after = _resampled(piece, before.grid.spec)
            walls, lost = _lost_walls(before.grid.values, after)
            num_walls, num_lost = num_walls + walls, num_lost + lost
            changes[tile] = _change(before.grid, after, piece, self._config.tile_m)
        has_jumped = num_lost > _JUMP_SHARE * num_walls
        least = 0.0 if has_jumped else min_change
        changed = [tile for tile, change in changes.items() if change > least]
        submaps = []
        for tile in self._line(changed):
            grid = pieces.get(tile) or _nothing(self._given[tile].grid.spec)
            submaps.append(self._give(tile, grid, stamp_ns))
        return MapChange(tuple(submaps), has_jumped)

    def _cut(self, occupancy: OccupancyMap) -> dict[Tile, OccupancyMap]:
        """The tiles that hold something; each grid is in its tile's frame."""
        known = np.argwhere(occupancy.known)
        if not len(known):
            return {}
        spec, side_m = occupancy.spec, self._config.tile_m
        tiles = np.floor(spec.centers_of(known) / side_m).astype(np.int64)
        order = np.lexsort((tiles[:, 1], tiles[:, 0]))
        known, tiles = known[order], tiles[order]
        starts = np.flatnonzero(np.any(np.diff(tiles, axis=0, prepend=tiles[:1] - 1), axis=1))
        pieces = {}
        for cells, (col, row) in zip(np.split(known, starts[1:]), tiles[starts], strict=True):
            first, last = cells.min(axis=0), cells.max(axis=0) + 1
            values = np.full(last - first, UNKNOWN, dtype=np.int8)
            inside = cells - first
            values[inside[:, 0], inside[:, 1]] = occupancy.values[cells[:, 0], cells[:, 1]]
            tile = int(col), int(row)
            corner = SE2(*(first[::-1] * spec.resolution_m))
            T_tile_grid = self._T_odom_tile(tile).inverse() @ spec.T_frame_grid @ corner
            part = GridSpec(spec.resolution_m, values.shape[0], values.shape[1], T_tile_grid)
            pieces[tile] = OccupancyMap(part, values)
        return pieces

    def _T_odom_tile(self, tile: Tile) -> SE2:  # noqa: N802 (notation of motions)
        side_m = self._config.tile_m
        return SE2((tile[0] + 0.5) * side_m, (tile[1] + 0.5) * side_m)

    def _line(self, tiles: Iterable[Tile]) -> list[Tile]:
        """In an order in which each follows a near one: neighbours in number are so in place."""
        left, line, last = sorted(tiles), [], self._last
        while left:
            here = last or left[0]
            last = min(left, key=lambda tile: (math.dist(tile, here), tile))
            left.remove(last)
            line.append(last)
        return line

    def _give(self, tile: Tile, grid: OccupancyMap, stamp_ns: int) -> Submap:
        before = self._given.get(tile)
        if before is None:
            given = _Given(len(self._given), 0, grid)
            self._last = tile
        else:
            given = _Given(before.sequence, before.revision + 1, grid)
        self._given[tile] = given
        covariance = self._covariance(given.sequence)
        return Submap(
            self._vehicle_id,
            given.sequence,
            given.revision,
            True,
            stamp_ns,
            self._T_odom_tile(tile),
            covariance,
            grid,
            run_id=1,
        )

    def _covariance(self, sequence: int) -> NDArray[np.float64]:
        """Of a tile relative to the one before it."""
        places = {given.sequence: tile for tile, given in self._given.items()}
        if sequence == 0:
            return np.zeros((3, 3))
        distance_m = self._config.tile_m * math.dist(places[sequence], places[sequence - 1])
        sigma_m = _BEND * distance_m
        return np.diag([sigma_m**2, sigma_m**2, (_BEND / 5.0) ** 2])


def _resampled(piece: OccupancyMap | None, spec: GridSpec) -> CellArray:
    """A tile's cells at the centres of another grid: between two maps the lattice may move."""
    values = np.full(spec.shape, UNKNOWN, dtype=np.int8)
    if piece is None:
        return values
    where = np.argwhere(values == UNKNOWN)
    cells = piece.spec.cells_of(spec.centers_of(where))
    inside = piece.spec.contains(cells)
    where, cells = where[inside], cells[inside]
    values[where[:, 0], where[:, 1]] = piece.values[cells[:, 0], cells[:, 1]]
    return values


def _lost_walls(before: CellArray, after: CellArray) -> tuple[int, int]:
    """Occupied cells before, and how many of them have no occupied cell near them any more.

    One cell to the side is the same: the lattice moves, and walls are redrawn.
    """
    walls = before > _WALL_PERCENT
    near = scipy.ndimage.binary_dilation(after > _WALL_PERCENT, structure=np.ones((3, 3)))
    return int(np.count_nonzero(walls)), int(np.count_nonzero(walls & ~near))


def _change(
    before: OccupancyMap, after: CellArray, piece: OccupancyMap | None, side_m: float
) -> float:
    """How much of a tile has changed: of its area in what is known, or of its walls."""
    is_gone = before.known & (after < 0)
    gone_m2 = np.count_nonzero(is_gone) * before.spec.resolution_m**2
    new_m2 = (_known_m2(piece) if piece else 0.0) - (_known_m2(before) - gone_m2)
    walls, lost = _lost_walls(before.values, after)
    new_walls = new = 0
    if piece is not None:
        new_walls, new = _lost_walls(piece.values, _resampled(before, piece.spec))
    return max((gone_m2 + abs(new_m2)) / side_m**2, (lost + new) / max(walls + new_walls, 1))


def _known_m2(grid: OccupancyMap) -> float:
    return float(np.count_nonzero(grid.known)) * grid.spec.resolution_m**2


def _nothing(spec: GridSpec) -> OccupancyMap:
    """What a tile holds that the map has left."""
    one = GridSpec(spec.resolution_m, 1, 1, spec.T_frame_grid)
    return OccupancyMap(one, np.full((1, 1), UNKNOWN, dtype=np.int8))
