"""Evidence of many submaps, summed on one lattice.

Log-odds are added as whole numbers (1/1024 nat), so that the sum does not depend on the order:
adding a submap and taking it away again leaves the same bytes, and so does any order of arrival.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Hashable, Iterable
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from uw_dslam_ros2.core.grid import UNKNOWN, EvidenceGrid, GridSpec, OccupancyMap
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["Mosaic", "Patch", "Window", "fuse_maps", "render_patch", "snap_pose"]

_UNITS_PER_NAT = 1024
_NO_EVIDENCE = np.int16(-32768)
_CHUNK_CELLS = 256


@dataclass(frozen=True, slots=True)
class Window:
    """A rectangle of lattice cells: rows ``row_0 <= row < row_1``, columns likewise."""

    row_0: int
    col_0: int
    row_1: int
    col_1: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.row_1 - self.row_0, self.col_1 - self.col_0

    def union(self, other: Window) -> Window:
        """Smallest rectangle around both."""
        return Window(
            min(self.row_0, other.row_0),
            min(self.col_0, other.col_0),
            max(self.row_1, other.row_1),
            max(self.col_1, other.col_1),
        )

    def slices(self, inside: Window) -> tuple[slice, slice]:
        """Index of this rectangle in an array that covers `inside`."""
        return (
            slice(self.row_0 - inside.row_0, self.row_1 - inside.row_0),
            slice(self.col_0 - inside.col_0, self.col_1 - inside.col_0),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """One submap drawn on the lattice: units of log-odds, or the lowest int16 if never seen."""

    window: Window
    units: NDArray[np.int16]

    @property
    def observed(self) -> NDArray[np.bool_]:
        """Cells with evidence."""
        return self.units != _NO_EVIDENCE


def _unit_table() -> NDArray[np.int16]:
    """Units of log-odds of 0..100 percent; 0 and 100 count as half a percent from certainty."""
    probability = np.clip(np.arange(101) / 100.0, 0.005, 0.995)
    return np.rint(_UNITS_PER_NAT * np.log(probability / (1.0 - probability))).astype(np.int16)


_TABLE = _unit_table()


@njit(cache=True, nogil=True)
def _render(
    values: NDArray[np.int8],
    table: NDArray[np.int16],
    origin_row: float,
    origin_col: float,
    step_cos: float,
    step_sin: float,
    num_samples: int,
    out: NDArray[np.int16],
) -> None:
    """Fill `out` by looking each of its cells up in `values`.

    A lattice step is ``step`` source cells long, turned by -yaw; the origin is the lattice corner
    of `out` in source cells. With several samples a cell takes the strongest wall under it, or
    else the mean of what is seen.
    """
    num_rows, num_cols = values.shape
    for row in range(out.shape[0]):
        for col in range(out.shape[1]):
            if num_samples == 1:  # the usual case, without the loops
                y, x = row + 0.5, col + 0.5
                source_row = math.floor(origin_row - step_sin * x + step_cos * y)
                source_col = math.floor(origin_col + step_cos * x + step_sin * y)
                out[row, col] = _NO_EVIDENCE
                if 0 <= source_row < num_rows and 0 <= source_col < num_cols:
                    value = values[source_row, source_col]
                    if value >= 0:
                        out[row, col] = table[value]
                continue
            count = 0
            total = np.int64(0)
            strongest = np.int64(0)
            for i in range(num_samples):
                for j in range(num_samples):
                    y = row + (i + 0.5) / num_samples
                    x = col + (j + 0.5) / num_samples
                    source_row = math.floor(origin_row - step_sin * x + step_cos * y)
                    source_col = math.floor(origin_col + step_cos * x + step_sin * y)
                    if 0 <= source_row < num_rows and 0 <= source_col < num_cols:
                        value = values[source_row, source_col]
                        if value >= 0:
                            units = np.int64(table[value])
                            count += 1
                            total += units
                            if units > strongest:
                                strongest = units
            if count == 0:
                out[row, col] = _NO_EVIDENCE
            elif strongest > 0:
                out[row, col] = strongest
            else:
                out[row, col] = total // count


def snap_pose(motion: SE2, resolution_m: float, radius_m: float) -> SE2:
    """Round a pose so finely that no point within `radius_m` moves by more than a tenth of a cell.

    Poses that differ in rounding errors only are drawn alike, and need not be drawn again.
    """
    step_m = 0.1 * resolution_m
    step_rad = step_m / max(radius_m, resolution_m)
    return SE2(
        step_m * round(motion.x / step_m),
        step_m * round(motion.y / step_m),
        step_rad * round(motion.yaw / step_rad),
    )


def render_patch(lattice: GridSpec, occupancy: OccupancyMap, T_frame_map: SE2) -> Patch:
    """Draw a map on the lattice.

    Parameters
    ----------
    lattice
        Its resolution and origin count; its size does not.
    occupancy
        The map to draw.
    T_frame_map
        From the map's frame to the lattice's.
    """
    T_lattice_grid = lattice.T_frame_grid.inverse() @ T_frame_map @ occupancy.spec.T_frame_grid
    ratio = lattice.resolution_m / occupancy.spec.resolution_m
    corners = T_lattice_grid.apply(
        GridSpec(occupancy.spec.resolution_m, *occupancy.spec.shape).corners()
    )
    # A hair off the whole number must not open a new row or column.
    scaled = corners / lattice.resolution_m
    col_0, row_0 = np.floor(scaled.min(axis=0) + 1e-6).astype(int)
    col_1, row_1 = np.ceil(scaled.max(axis=0) - 1e-6).astype(int)
    window = Window(int(row_0), int(col_0), max(int(row_1), row_0 + 1), max(int(col_1), col_0 + 1))
    corner = np.array([col_0, row_0]) * lattice.resolution_m
    # A rotation by a rounding error must not move centres across cells.
    origin = T_lattice_grid.inverse().apply(corner) / occupancy.spec.resolution_m
    out = np.empty(window.shape, dtype=np.int16)
    cos, sin = math.cos(T_lattice_grid.yaw), math.sin(T_lattice_grid.yaw)
    num_samples = max(1, math.ceil(ratio - 1e-6))
    _render(
        occupancy.values, _TABLE, origin[1], origin[0], ratio * cos, ratio * sin, num_samples, out
    )
    return _trimmed(window, out)


def _trimmed(window: Window, units: NDArray[np.int16]) -> Patch:
    """Cut away rows and columns at the border without evidence."""
    seen = units != _NO_EVIDENCE
    rows, cols = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    if rows.size == 0:
        corner = Window(window.row_0, window.col_0, window.row_0, window.col_0)
        return Patch(corner, np.empty((0, 0), dtype=np.int16))
    inner = Window(
        window.row_0 + int(rows[0]),
        window.col_0 + int(cols[0]),
        window.row_0 + int(rows[-1]) + 1,
        window.col_0 + int(cols[-1]) + 1,
    )
    return Patch(inner, np.ascontiguousarray(units[inner.slices(window)]))


class Mosaic:
    """A sum of patches, kept up to date: adding, moving and removing one costs what it touches."""

    def __init__(self, lattice: GridSpec, log_odds_max: float) -> None:
        self._lattice = lattice
        self._log_odds_max = log_odds_max
        self._patches: dict[Hashable, tuple[Hashable, Patch]] = {}
        self._held: Window | None = None
        self._sum = np.zeros((0, 0), dtype=np.int32)
        self._num_occupied = np.zeros((0, 0), dtype=np.uint16)
        self._num_free = np.zeros((0, 0), dtype=np.uint16)
        self._changed: Window | None = None

    @property
    def lattice(self) -> GridSpec:
        """Where lattice cell (0, 0) lies, and the resolution; its size means nothing."""
        return self._lattice

    def version_of(self, key: Hashable) -> Hashable | None:
        """What `put` was told of this patch."""
        held = self._patches.get(key)
        return None if held is None else held[0]

    def put(self, key: Hashable, version: Hashable, patch: Patch) -> None:
        """Add a patch, in the place of the one with the same key."""
        self.remove(key)
        self._patches[key] = (version, patch)
        self._add(patch, 1)

    def remove(self, key: Hashable) -> None:
        """Take a patch away; without it nothing happens."""
        held = self._patches.pop(key, None)
        if held is not None:
            self._add(held[1], -1)

    def keys(self) -> Iterable[Hashable]:
        """Keys of the patches."""
        return self._patches.keys()

    def take_changed(self) -> Window | None:
        """Rectangle touched since the last call, in lattice cells."""
        changed, self._changed = self._changed, None
        return changed

    def window(self) -> Window | None:
        """Rectangle around all evidence."""
        total: Window | None = None
        for _, patch in self._patches.values():
            if patch.units.size:
                total = patch.window if total is None else total.union(patch.window)
        return total

    def spec_of(self, window: Window) -> GridSpec:
        """Place of a rectangle as a grid of its own."""
        return _spec_of(self._lattice, window)

    def evidence(self) -> EvidenceGrid | None:
        """Everything; None without evidence."""
        window = self.window()
        if window is None or self._held is None:
            return None
        index = window.slices(self._held)
        log_odds = (self._sum[index] / np.float64(_UNITS_PER_NAT)).astype(np.float32)
        np.clip(log_odds, -self._log_odds_max, self._log_odds_max, out=log_odds)
        observed = (self._num_free[index] > 0) | (self._num_occupied[index] > 0)
        return EvidenceGrid(self.spec_of(window), log_odds, observed)

    def contradictions(self) -> NDArray[np.uint16] | None:
        """For each cell of `evidence`, how many patches vote against its majority."""
        window = self.window()
        if window is None or self._held is None:
            return None
        index = window.slices(self._held)
        return np.minimum(self._num_free[index], self._num_occupied[index])

    def contributors(self, row: int, col: int) -> list[tuple[Hashable, float]]:
        """Which patches saw a lattice cell, and the log-odds that each gave."""
        found: list[tuple[Hashable, float]] = []
        for key, (_, patch) in self._patches.items():
            w = patch.window
            if w.row_0 <= row < w.row_1 and w.col_0 <= col < w.col_1:
                units = patch.units[row - w.row_0, col - w.col_0]
                if units != _NO_EVIDENCE:
                    found.append((key, float(units) / _UNITS_PER_NAT))
        return found

    def contributor_sets(self) -> tuple[NDArray[np.uint32], list[frozenset[Hashable]]]:
        """For each cell of `evidence`, which patches saw it: an index into a list of sets.

        The sets are numbered in the order of the patches' keys, so equal mosaics give equal
        arrays; number 0 is the empty set.
        """
        window = self.window()
        sets: list[frozenset[Hashable]] = [frozenset()]
        if window is None:
            return np.zeros((0, 0), dtype=np.uint32), sets
        owners = np.zeros(window.shape, dtype=np.uint32)
        for key in sorted(self._patches, key=repr):
            patch = self._patches[key][1]
            if patch.units.size == 0:
                continue
            part = owners[patch.window.slices(window)]
            before, after = part[patch.observed], {}
            for number in np.flatnonzero(np.bincount(before)).tolist():
                after[number] = len(sets)
                sets.append(sets[number] | {key})
            table = np.zeros(max(after, default=0) + 1, dtype=np.uint32)
            table[list(after)] = list(after.values())
            part[patch.observed] = table[before]
        # Sets that a later patch has covered wholly are used by no cell any more.
        is_used = np.bincount(owners.ravel(), minlength=len(sets)) > 0
        is_used[0] = True
        packed = (np.cumsum(is_used) - 1).astype(np.uint32)
        used = np.flatnonzero(is_used).tolist()
        return packed[owners], [sets[number] for number in used]

    def _add(self, patch: Patch, sign: int) -> None:
        if patch.units.size == 0:
            return
        held = self._grow(patch.window)
        index = patch.window.slices(held)
        observed = patch.observed
        self._sum[index] += np.int32(sign) * np.where(observed, patch.units, 0).astype(np.int32)
        is_occupied = observed & (patch.units > 0)
        step = np.uint16(1)
        is_free = observed & ~is_occupied
        for votes, mask in ((self._num_occupied, is_occupied), (self._num_free, is_free)):
            if sign > 0:
                votes[index] += step * mask
            else:
                votes[index] -= step * mask
        changed = self._changed
        self._changed = patch.window if changed is None else changed.union(patch.window)

    def _grow(self, window: Window) -> Window:
        """Make the arrays cover a rectangle, in whole chunks so that it happens seldom."""
        held = self._held
        if held is not None and held.union(window) == held:
            return held
        wanted = window if held is None else held.union(window)
        chunk = _CHUNK_CELLS
        grown = Window(
            wanted.row_0 // chunk * chunk,
            wanted.col_0 // chunk * chunk,
            -(-wanted.row_1 // chunk) * chunk,
            -(-wanted.col_1 // chunk) * chunk,
        )
        for name in ("_sum", "_num_occupied", "_num_free"):
            old = getattr(self, name)
            new = np.zeros(grown.shape, dtype=old.dtype)
            if held is not None:
                new[held.slices(grown)] = old
            setattr(self, name, new)
        self._held = grown
        return grown


def fuse_maps(
    lattice: GridSpec, maps: Iterable[tuple[OccupancyMap, SE2]], log_odds_max: float
) -> OccupancyMap | None:
    """One map of several placed ones (each with its ``T_frame_map``); None if nothing was seen."""
    patches = [render_patch(lattice, occupancy, T_frame_map) for occupancy, T_frame_map in maps]
    patches = [patch for patch in patches if patch.units.size]
    if not patches:
        return None
    window = functools.reduce(Window.union, (patch.window for patch in patches))
    total = np.zeros(window.shape, dtype=np.int32)
    is_seen = np.zeros(window.shape, dtype=np.bool_)
    for patch in patches:
        index, observed = patch.window.slices(window), patch.observed
        np.add(total[index], patch.units, out=total[index], where=observed)
        is_seen[index] |= observed
    limit = math.ceil(log_odds_max * _UNITS_PER_NAT)
    np.clip(total, -limit, limit, out=total)
    values = _percent_table(limit, log_odds_max)[total + limit]
    values[~is_seen] = UNKNOWN
    return OccupancyMap(_spec_of(lattice, window), values)


@functools.cache
def _percent_table(limit: int, log_odds_max: float) -> NDArray[np.int8]:
    """Percent of each whole number of units from ``-limit`` on, as `EvidenceGrid` rounds."""
    units = np.arange(-limit, limit + 1)[None]
    log_odds = np.clip((units / np.float64(_UNITS_PER_NAT)), -log_odds_max, log_odds_max)
    seen = np.ones(units.shape, dtype=np.bool_)
    evidence = EvidenceGrid(GridSpec(1.0, *units.shape), log_odds.astype(np.float32), seen)
    return evidence.to_occupancy().values[0]


def _spec_of(lattice: GridSpec, window: Window) -> GridSpec:
    res = lattice.resolution_m
    corner = lattice.T_frame_grid @ SE2(window.col_0 * res, window.row_0 * res)
    return GridSpec(res, *window.shape, corner)
