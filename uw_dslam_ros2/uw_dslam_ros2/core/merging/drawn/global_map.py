"""The global map of a queue: drawn on one pinned lattice, and only where something moved."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.grid import MAX_MAP_SIDE, GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging.config import MAX_MAP_CELLS
from uw_dslam_ros2.core.merging.graph.submap_groups import StoredSubmap, joint_box, lattice_box
from uw_dslam_ros2.core.merging.types import MapProvenance
from uw_dslam_ros2.core.mosaic import Mosaic
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sparse_cells import Window
from uw_dslam_ros2.core.submap import SubmapId

FloatArray = NDArray[np.float64]

__all__ = ["GlobalMap", "Piece", "draw_pieces", "pinned_lattice", "snap_pose", "undrawable"]


class GlobalMap:
    """A mosaic of submaps in frame "map"."""

    def __init__(self, lattice: GridSpec, log_odds_max: float) -> None:
        self._mosaic = Mosaic(lattice)
        self._log_odds_max = log_odds_max

    def draw(
        self, submaps: Mapping[SubmapId, StoredSubmap], T_map_submap: Mapping[SubmapId, SE2]
    ) -> None:
        """Make it show exactly these submaps; what lies as before is left alone."""
        pieces = {}
        for submap_id, motion in T_map_submap.items():
            stored = submaps[submap_id]
            pieces[submap_id] = Piece(
                stored.submap.grid, motion, version=stored.digest, radius_m=stored.radius_m
            )
        draw_pieces(self._mosaic, pieces)

    def occupancy(self) -> OccupancyMap | None:
        """The fused map; None without evidence."""
        return self._mosaic.occupancy(self._log_odds_max)

    def squares(self) -> list[tuple[int, int]]:
        """Which squares of cells there are; see `Mosaic.squares`."""
        return self._mosaic.squares()

    def square(self, row: int, col: int) -> NDArray[np.int8]:
        """One of them, in percent, -1 where nothing was seen."""
        return self._mosaic.square(row, col, self._log_odds_max)

    def take_changed(self) -> tuple[GridSpec, Window] | None:
        """What changed since the last call: its place as a grid, and in cells of the lattice."""
        window = self._mosaic.take_changed()
        return None if window is None else (self._mosaic.spec_of(window), window)

    def provenance(self) -> MapProvenance | None:
        """Who saw what; None without evidence."""
        contradictions, found = self._mosaic.contradictions(), self._mosaic.contributor_sets()
        if contradictions is None or found is None:
            return None
        owners, sets = found
        named = tuple(tuple(sorted(SubmapId(*i) for i in keys)) for keys in sets)  # type: ignore[misc]
        spec = self._mosaic.spec_of(owners.window)
        return MapProvenance(spec, contradictions, owners, named)


class Piece(NamedTuple):
    """A grid to be drawn, and where it lies in the mosaic's frame."""

    grid: OccupancyMap
    T_mosaic_grid: SE2
    version: Hashable
    """Of the grid's content."""
    radius_m: float
    """No known cell lies farther from the grid's frame."""


def draw_pieces(mosaic: Mosaic, pieces: Mapping[SubmapId, Piece]) -> None:
    """Make a mosaic show exactly these; what lies as before is left alone."""
    for key in [key for key in mosaic.keys() if key not in pieces]:  # noqa: SIM118
        mosaic.remove(key)
    for submap_id, piece in pieces.items():
        snapped = snap_pose(piece.T_mosaic_grid, mosaic.lattice.resolution_m, piece.radius_m)
        version = (piece.version, snapped)
        if mosaic.version_of(submap_id) != version:
            mosaic.put(submap_id, version, piece.grid, snapped)


def undrawable(
    lattice: GridSpec,
    submaps: Mapping[SubmapId, StoredSubmap],
    T_map_submap: Mapping[SubmapId, SE2],
) -> dict[SubmapId, str]:
    """Which submaps are not drawn, and why: with them the map would be larger than can be made.

    Those near the origin, where the frame is pinned, come first.
    """
    if _surely_fits(lattice, submaps, T_map_submap):
        return {}
    found: dict[SubmapId, str] = {}
    drawn: list[FloatArray] = []
    order = sorted(T_map_submap, key=lambda i: (math.hypot(*T_map_submap[i].as_array()[:2]), i))
    for submap_id in order:
        spec, motion = submaps[submap_id].submap.grid.spec, T_map_submap[submap_id]
        box = lattice_box(lattice, spec, motion)
        rows, cols = np.diff(box, axis=0)[0].tolist()
        both = joint_box([*drawn, box])
        if rows * cols > MAX_MAP_CELLS:
            found[submap_id] = (
                f"not drawn: its {spec.num_rows} x {spec.num_cols} cells of {spec.resolution_m:g} "
                f"m are {rows * cols:.2g} of the global map's {lattice.resolution_m:g} m"
            )
        elif np.diff(both, axis=0).max() > MAX_MAP_SIDE:
            found[submap_id] = (
                f"not drawn: it lies {math.hypot(motion.x, motion.y):.0f} m from where the frame "
                f"is pinned, and a map has at most {MAX_MAP_SIDE} cells a side "
                f"({MAX_MAP_SIDE * lattice.resolution_m:.0f} m)"
            )
        else:
            drawn = [both]
    return found


def _surely_fits(
    lattice: GridSpec,
    submaps: Mapping[SubmapId, StoredSubmap],
    T_map_submap: Mapping[SubmapId, SE2],
) -> bool:
    """Whether circles around all grids lie in a map that can be made: the usual case, quickly."""
    x, y, reach = [], [], []
    for submap_id, motion in T_map_submap.items():
        x.append(motion.x)
        y.append(motion.y)
        reach.append(submaps[submap_id].submap.grid.spec.reach_m)
    if not reach:
        return True
    side_m = max(float(np.ptp(x)), float(np.ptp(y))) + 2.0 * max(reach)
    cells = 2.0 * max(reach) / lattice.resolution_m
    return side_m / lattice.resolution_m <= MAX_MAP_SIDE / math.sqrt(2.0) and (
        2.0 * cells**2 <= MAX_MAP_CELLS
    )


def pinned_lattice(spec: GridSpec, resolution_m: float) -> GridSpec:
    """Cells of the pinning submap, reduced to the cell at its frame's origin.

    A later revision that has grown by whole cells means the same lattice.

    Parameters
    ----------
    spec
        The pinning submap's grid.
    resolution_m
        Of the lattice.
    """
    turn = SE2(0.0, 0.0, spec.T_frame_grid.yaw)
    corner = turn.inverse().apply(spec.T_frame_grid.as_array()[:2]) / resolution_m
    phase: NDArray[np.float64] = np.round(corner - np.floor(corner + 1e-6), 9) * resolution_m
    return GridSpec(resolution_m, 1, 1, turn @ SE2(float(phase[0]), float(phase[1])))


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
