"""Log-odds of many grids at their poses, summed on one lattice.

Log-odds are added as whole numbers, so that the sum does not depend on the order: adding a grid
and taking it away again leaves the same bytes, and so does any order of arrival.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from uw_dslam_ros2.core.grid import (
    UNKNOWN,
    UNSEEN,
    GridSpec,
    OccupancyMap,
    percent_table,
)
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sparse_cells import SQUARE, SparseCells, Window, window_of_square

__all__ = ["Drawable", "Mosaic", "fuse_maps"]

_UNSEEN = int(UNSEEN)


class Drawable(Protocol):
    """A grid that can be summed with others, such as `OccupancyMap`."""

    @property
    def spec(self) -> GridSpec:
        """Where it lies in its own frame."""

    def units(self) -> NDArray[np.int16]:
        """Log-odds (R, C) in units of `UNITS_PER_NAT`; `UNSEEN` where nothing was observed."""


class _Layers:
    """The sum and the votes of a rectangle of the lattice."""

    def __init__(self, window: Window) -> None:
        self.window = window
        self.total = np.zeros(window.shape, np.int32)
        self.num_occupied = np.zeros(window.shape, np.uint16)
        self.num_free = np.zeros(window.shape, np.uint16)
        self.num_votes = 0

    @property
    def observed(self) -> NDArray[np.bool_]:
        """Cells that somebody observed."""
        return (self.num_occupied > 0) | (self.num_free > 0)


@dataclass(frozen=True, slots=True, eq=False)
class _Placed:
    """A grid at its pose, and the rectangle in which it saw something."""

    version: Hashable
    grid: Drawable
    T_frame_map: SE2
    window: Window | None


class Mosaic:
    """A sum of grids, kept up to date: adding, moving and removing one costs what it touches.

    Cells are kept in tiles, and only where something was seen. Of the grids only their poses are
    kept beside themselves: who goes is drawn once more and subtracted.

    Parameters
    ----------
    lattice
        Its resolution and the place of its cell (0, 0) count; its size does not.
    """

    def __init__(self, lattice: GridSpec) -> None:
        self._lattice = lattice
        self._placed: dict[Hashable, _Placed] = {}
        self._tiles: dict[tuple[int, int], _Layers] = {}
        self._changed: Window | None = None

    @property
    def lattice(self) -> GridSpec:
        """Where lattice cell (0, 0) lies, and the resolution; its size means nothing."""
        return self._lattice

    def version_of(self, key: Hashable) -> Hashable | None:
        """What `put` was told of this grid."""
        held = self._placed.get(key)
        return None if held is None else held.version

    def put(self, key: Hashable, version: Hashable, grid: Drawable, T_frame_map: SE2) -> None:
        """Add a grid, in the place of the one with the same key; it must not change any more.

        ``T_frame_map`` goes from the frame of the grid's `spec` to the lattice's.
        """
        self.remove(key)
        window = self._draw(grid, T_frame_map, 1)
        self._placed[key] = _Placed(version, grid, T_frame_map, window)

    def remove(self, key: Hashable) -> None:
        """Take a grid away; without it nothing happens."""
        held = self._placed.pop(key, None)
        if held is not None:
            self._draw(held.grid, held.T_frame_map, -1)

    def keys(self) -> Iterable[Hashable]:
        """Keys of the grids."""
        return self._placed.keys()

    def take_changed(self) -> Window | None:
        """Rectangle touched since the last call, in lattice cells."""
        changed, self._changed = self._changed, None
        return changed

    def window(self) -> Window | None:
        """Rectangle around all that was observed."""
        windows = [held.window for held in self._placed.values() if held.window is not None]
        return functools.reduce(Window.union, windows) if windows else None

    def spec_of(self, window: Window) -> GridSpec:
        """Place of a rectangle as a grid of its own."""
        resolution_m = self._lattice.resolution_m
        corner = SE2(window.col_0 * resolution_m, window.row_0 * resolution_m)
        return GridSpec(resolution_m, *window.shape, self._lattice.T_frame_grid @ corner)

    def occupancy(self, log_odds_max: float) -> OccupancyMap | None:
        """Everything, in percent of log-odds cut at a limit; None where nothing was observed."""
        window = self.window()
        if window is None:
            return None
        table = percent_table(log_odds_max)
        values = np.full(window.shape, UNKNOWN, np.int8)
        for tile in self._tiles.values():
            place = tile.window.row_0 - window.row_0, tile.window.col_0 - window.col_0
            _to_percent(tile.total, tile.num_occupied, tile.num_free, table, *place, values)
        return OccupancyMap(self.spec_of(window), values)

    def squares(self) -> list[tuple[int, int]]:
        """Row and column, in squares, of those in which something was observed."""
        return list(self._tiles)

    def square(self, row: int, col: int, log_odds_max: float) -> NDArray[np.int8]:
        """Percent (SQUARE, SQUARE) of the cells of one of `squares`, as in `occupancy`."""
        tile, values = self._tiles[row, col], np.full((SQUARE, SQUARE), UNKNOWN, np.int8)
        table = percent_table(log_odds_max)
        _to_percent(tile.total, tile.num_occupied, tile.num_free, table, 0, 0, values)
        return values

    def contradictions(self) -> SparseCells | None:
        """For each cell of `occupancy`, how many grids vote against its majority; uint16."""
        window = self.window()
        if window is None:
            return None
        found = {
            place: np.minimum(tile.num_free, tile.num_occupied)
            for place, tile in self._tiles.items()
        }
        squares = {place: square for place, square in found.items() if square.any()}
        return SparseCells(window, squares, np.dtype(np.uint16))

    def contributor_sets(self) -> tuple[SparseCells, list[frozenset[Hashable]]] | None:
        """For each cell of `occupancy`, which grids saw it: an index into a list of sets, uint32.

        Equal mosaics number them alike, whatever came first; number 0 is the empty set.
        """
        window = self.window()
        if window is None:
            return None
        owners = {place: np.zeros((SQUARE, SQUARE), np.uint32) for place in sorted(self._tiles)}
        sets: list[frozenset[Hashable]] = [frozenset()]
        for key in sorted(self._placed, key=repr):
            held, after = self._placed[key], dict[int, int]()
            if held.window is None:
                continue
            drawing = _Drawing(self._lattice, held.grid, held.T_frame_map)
            for place in _squares_of(held.window):
                alone = _Layers(window_of_square(place))
                if drawing.add_to(alone, 1) is None:
                    continue
                square, seen = owners[place], alone.observed
                numbers, index = np.unique(square[seen], return_inverse=True)
                for number in numbers.tolist():
                    if number not in after:
                        after[number] = len(sets)
                        sets.append(sets[number] | {key})
                square[seen] = np.array([after[n] for n in numbers.tolist()], np.uint32)[index]
        return SparseCells(window, owners, np.dtype(np.uint32)), _packed(owners, sets)

    def _draw(self, grid: Drawable, T_frame_map: SE2, sign: int) -> Window | None:
        """Add a grid to the tiles, or subtract it; returns the rectangle that it has seen."""
        drawing = _Drawing(self._lattice, grid, T_frame_map)
        seen = []
        for place in _squares_of(drawing.window):
            tile = self._tiles.get(place) or _Layers(window_of_square(place))
            window = drawing.add_to(tile, sign)
            if window is not None:
                seen.append(window)
                self._tiles[place] = tile
                if tile.num_votes == 0:
                    del self._tiles[place]
        if not seen:
            return None
        total = functools.reduce(Window.union, seen)
        self._changed = total if self._changed is None else self._changed.union(total)
        return total


def _squares_of(window: Window) -> list[tuple[int, int]]:
    """Row and column of the squares that a rectangle lies in."""
    rows = range(window.row_0 // SQUARE, (window.row_1 - 1) // SQUARE + 1)
    cols = range(window.col_0 // SQUARE, (window.col_1 - 1) // SQUARE + 1)
    return list(itertools.product(rows, cols))


def _packed(
    owners: Mapping[tuple[int, int], NDArray[np.uint32]], sets: list[frozenset[Hashable]]
) -> list[frozenset[Hashable]]:
    """Number anew, in place, without the sets that a later grid has covered wholly."""
    is_used = np.zeros(len(sets), np.bool_)
    is_used[0] = True
    for square in owners.values():
        is_used[square] = True
    packed = (np.cumsum(is_used) - 1).astype(np.uint32)
    for square in owners.values():
        square[:] = packed[square]
    return [sets[number] for number in np.flatnonzero(is_used).tolist()]


class _Drawing:
    """How the cells of a lattice are looked up in a grid."""

    def __init__(self, lattice: GridSpec, grid: Drawable, T_frame_map: SE2) -> None:
        spec = grid.spec
        T_lattice_grid = lattice.T_frame_grid.inverse() @ T_frame_map @ spec.T_frame_grid
        ratio = lattice.resolution_m / spec.resolution_m
        scaled = (
            T_lattice_grid.apply(GridSpec(spec.resolution_m, *spec.shape).corners())
            / lattice.resolution_m
        )
        # A hair off the whole number must not open a new row or column.
        col_0, row_0 = np.floor(scaled.min(axis=0) + 1e-6).astype(int).tolist()
        col_1, row_1 = np.ceil(scaled.max(axis=0) - 1e-6).astype(int).tolist()
        self.window = Window(row_0, col_0, max(row_1, row_0 + 1), max(col_1, col_0 + 1))
        corner = np.array([col_0, row_0]) * lattice.resolution_m
        # A rotation by a rounding error must not move centres across cells.
        self._origin = T_lattice_grid.inverse().apply(corner) / spec.resolution_m
        self._step = ratio * math.cos(T_lattice_grid.yaw), ratio * math.sin(T_lattice_grid.yaw)
        self._num_samples = max(1, math.ceil(ratio - 1e-6))
        self._units = grid.units()

    def add_to(self, layers: _Layers, sign: int) -> Window | None:
        """Add, or subtract with a sign of -1; returns the rectangle that was seen."""
        common = layers.window.intersection(self.window)
        own, reach = layers.window, self.window
        num_seen, row_0, col_0, row_1, col_1 = _add(
            self._units, self._origin[1], self._origin[0], *self._step, self._num_samples,
            common.row_0 - own.row_0, common.row_1 - own.row_0,
            common.col_0 - own.col_0, common.col_1 - own.col_0,
            own.row_0 - reach.row_0, own.col_0 - reach.col_0, sign,
            layers.total, layers.num_occupied, layers.num_free,
        )  # fmt: skip
        layers.num_votes += sign * num_seen
        if num_seen == 0:
            return None
        return Window(own.row_0 + row_0, own.col_0 + col_0, own.row_0 + row_1, own.col_0 + col_1)


@njit(cache=True, nogil=True)
def _looked_up(units, row, col):  # type: ignore[no-untyped-def]
    """The cell of `units` (R, C) at a place in cells; outside nothing was observed."""
    if row >= 0.0 and col >= 0.0 and row < units.shape[0] and col < units.shape[1]:
        return int(units[int(row), int(col)])
    return _UNSEEN


@njit(cache=True, nogil=True)
def _sampled(units, row, col, step_cos, step_sin, num_samples):  # type: ignore[no-untyped-def]
    """Of samples spread over a lattice cell, the strongest wall, or else the mean."""
    count, total, strongest = 0, 0, 0
    for i in range(num_samples):
        y = (i + 0.5) / num_samples - 0.5
        for j in range(num_samples):
            x = (j + 0.5) / num_samples - 0.5
            value = _looked_up(
                units, row - step_sin * x + step_cos * y, col + step_cos * x + step_sin * y
            )
            if value != _UNSEEN:
                count += 1
                total += value
                strongest = max(strongest, value)
    if count == 0:
        return _UNSEEN
    return strongest if strongest > 0 else total // count


@njit(cache=True, nogil=True)
def _add(  # type: ignore[no-untyped-def]
    units, origin_row, origin_col, step_cos, step_sin, num_samples,
    row_0, row_1, col_0, col_1, shift_row, shift_col, sign, total, num_occupied, num_free,
):  # fmt: skip
    """Add to rows and columns of the layers by looking each cell up in `units` (R, C).

    A lattice step is ``step`` source cells long, turned by -yaw; the origin is a lattice corner in
    source cells, at (-shift_row, -shift_col) of the layers. Returns how many cells were
    seen, and the rectangle around them.
    """
    num_seen = 0
    least_row, least_col, last_row, last_col = row_1, col_1, row_0, col_0
    for row in range(row_0, row_1):
        y = shift_row + row + 0.5
        middle_row, middle_col = origin_row + step_cos * y, origin_col + step_sin * y
        for col in range(col_0, col_1):
            x = shift_col + col + 0.5
            source_row, source_col = middle_row - step_sin * x, middle_col + step_cos * x
            if num_samples == 1:  # the usual case, without the loops
                value = _looked_up(units, source_row, source_col)
            else:
                value = _sampled(units, source_row, source_col, step_cos, step_sin, num_samples)
            if value == _UNSEEN:
                continue
            total[row, col] += sign * value
            if value > 0:
                num_occupied[row, col] += sign
            else:
                num_free[row, col] += sign
            num_seen += 1
            least_row, last_row = min(least_row, row), row + 1
            least_col, last_col = min(least_col, col), max(last_col, col + 1)
    return num_seen, least_row, least_col, last_row, last_col


@njit(cache=True, nogil=True)
def _to_percent(total, num_occupied, num_free, table, row_0, col_0, values):  # type: ignore[no-untyped-def]
    """Look the sums of observed cells up in a table of odd length, whose middle is for zero.

    The layers begin at (row_0, col_0) of `values`, and may reach beyond.
    """
    limit = table.shape[0] // 2
    for row in range(max(0, -row_0), min(total.shape[0], values.shape[0] - row_0)):
        for col in range(max(0, -col_0), min(total.shape[1], values.shape[1] - col_0)):
            if num_occupied[row, col] > 0 or num_free[row, col] > 0:
                place = max(-limit, min(limit, total[row, col])) + limit
                values[row_0 + row, col_0 + col] = table[place]


def fuse_maps(
    lattice: GridSpec, maps: Iterable[tuple[Drawable, SE2]], log_odds_max: float
) -> OccupancyMap | None:
    """One map of several placed ones (each with its ``T_frame_map``); None if nothing was seen."""
    mosaic = Mosaic(lattice)
    for index, (grid, T_frame_map) in enumerate(maps):
        mosaic.put(index, None, grid, T_frame_map)
    return mosaic.occupancy(log_odds_max)
