"""Grids of the plane: metres to [row, col] and back, and the maps that live on them."""

from __future__ import annotations

import functools
import hashlib
import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.se2 import SE2

__all__ = [
    "FREE",
    "MAX_MAP_SIDE",
    "OCCUPIED",
    "UNITS_PER_NAT",
    "UNKNOWN",
    "UNSEEN",
    "GridSpec",
    "OccupancyMap",
    "Strip",
    "bounds_of",
    "percent_table",
    "strips_of",
]

FloatArray = NDArray[np.float64]

UNKNOWN, FREE, OCCUPIED = -1, 0, 100
"""Values of an occupancy map: -1 unknown, else the probability of being occupied in percent."""

UNITS_PER_NAT = 1000.0
"""Log-odds are summed in integers of a thousandth of a nat: the same in any order."""

MAX_MAP_SIDE = 20_000
"""Rows and columns of the largest map that is made whole: to be shown, sent, written, matched."""

_STRIP_ROWS = 128

UNSEEN = np.int16(-32768)
"""Instead of log-odds: nothing was observed."""


@dataclass(frozen=True, slots=True)
class GridSpec:
    """Where a grid lies.

    Arrays are ``grid[row, col]``; row grows with y, column with x. ``T_frame_grid`` is the pose
    of the grid's own axes: its translation is the outer corner of cell (0, 0), and cell centres
    sit at +0.5 cells from there. Its yaw is 0 for almost every grid; a rotated origin in a
    message ends up here and is honoured everywhere.
    """

    resolution_m: float
    num_rows: int
    num_cols: int
    T_frame_grid: SE2 = SE2()

    def __post_init__(self) -> None:
        if not (math.isfinite(self.resolution_m) and self.resolution_m > 0.0):
            raise InvalidInputError(
                f"resolution is {self.resolution_m} m, expected a positive number"
            )
        if self.num_rows < 1 or self.num_cols < 1:
            raise InvalidInputError(
                f"grid is {self.num_rows} rows x {self.num_cols} columns, "
                "expected at least one cell"
            )

    @property
    def shape(self) -> tuple[int, int]:
        """``(num_rows, num_cols)``."""
        return self.num_rows, self.num_cols

    @property
    def reach_m(self) -> float:
        """No cell lies farther from the frame's origin."""
        origin = self.T_frame_grid
        return math.hypot(origin.x, origin.y) + self.resolution_m * math.hypot(*self.shape)

    def cells_of(self, points: ArrayLike) -> NDArray[np.int64]:
        """Cells [row, col] (N, 2) that hold points (N, 2) [x, y] [m]; may lie outside the grid."""
        local = self.T_frame_grid.inverse().apply(points) / self.resolution_m
        return np.floor(local[..., ::-1]).astype(np.int64)

    def centers_of(self, cells: ArrayLike) -> FloatArray:
        """Centres (N, 2) [x, y] in metres of cells (N, 2) [row, col]."""
        local = (np.asarray(cells, dtype=np.float64)[..., ::-1] + 0.5) * self.resolution_m
        return self.T_frame_grid.apply(local)

    def contains(self, cells: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which cells (N, 2) lie inside the grid."""
        inside = (cells >= 0) & (cells < np.array(self.shape))
        return inside.all(axis=-1)

    def part(self, row: int, col: int, num_rows: int, num_cols: int) -> GridSpec:
        """The cells from one on, in the same frame; it may reach beyond the grid."""
        corner = self.T_frame_grid @ SE2(col * self.resolution_m, row * self.resolution_m)
        return GridSpec(self.resolution_m, num_rows, num_cols, corner)

    def corners(self) -> FloatArray:
        """Outer corners (4, 2) [m], counter-clockwise from that of cell (0, 0)."""
        width, height = self.num_cols * self.resolution_m, self.num_rows * self.resolution_m
        return self.T_frame_grid.apply([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])


@dataclass(frozen=True, slots=True, eq=False)
class OccupancyMap:
    """An occupancy grid as it is exchanged: int8, -1 unknown, 0 free to 100 occupied [percent].

    ``values`` has shape ``spec.shape`` and is read-only.
    """

    spec: GridSpec
    values: NDArray[np.int8]

    def __post_init__(self) -> None:
        values = np.asarray(self.values)
        if values.shape != self.spec.shape:
            raise InvalidInputError(
                f"values have shape {values.shape}, expected {self.spec.shape}"
            )
        if values.dtype != np.int8:
            raise InvalidInputError(f"values have type {values.dtype}, expected int8")
        if values.min() < UNKNOWN or values.max() > OCCUPIED:
            bad = values[(values < UNKNOWN) | (values > OCCUPIED)][0]
            raise InvalidInputError(f"values hold {bad}, expected -1 or 0..100")
        view = values.view()
        view.flags.writeable = False
        object.__setattr__(self, "values", view)

    @property
    def known(self) -> NDArray[np.bool_]:
        """Cells that were observed."""
        return self.values >= 0

    def units(self) -> NDArray[np.int16]:
        """Log-odds (R, C) in units of `UNITS_PER_NAT`, `UNSEEN` where unknown.

        0 and 100 count as half a percent from certainty.
        """
        return np.where(self.known, _UNITS_OF_PERCENT[self.values], UNSEEN)

    def cells_digest(self) -> str:
        """Of the cells and their place (16 hexadecimal digits): of equal maps the same."""
        content = repr(self.spec).encode() + self.values.tobytes()
        return hashlib.blake2b(content, digest_size=8).hexdigest()


_PROBABILITY = np.clip(np.arange(101) / 100.0, 0.005, 0.995)
_UNITS_OF_PERCENT = np.rint(UNITS_PER_NAT * np.log(_PROBABILITY / (1.0 - _PROBABILITY))).astype(
    np.int16
)


@functools.cache
def percent_table(log_odds_max: float) -> NDArray[np.int8]:
    """Percent of each whole number of units whose log-odds are within a limit, the least first."""
    limit = int(log_odds_max * UNITS_PER_NAT)
    # A table instead of millions of exponentials.
    percent = 100.0 / (1.0 + np.exp(-np.arange(-limit, limit + 1) / UNITS_PER_NAT))
    return np.rint(percent).astype(np.int8)


def bounds_of(mask: NDArray[np.bool_]) -> tuple[slice, slice] | None:
    """Rows and columns that hold all set cells (R, C); None without any."""
    rows, cols = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if len(rows) == 0:
        return None
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(cols[0]), int(cols[-1]) + 1)


class Strip(NamedTuple):
    """Some rows, those around them that count for them, and where among these they are."""

    rows: slice
    around: slice
    inside: slice


def strips_of(num_rows: int, margin: int = 0) -> list[Strip]:
    """Rows in parts of about the same height.

    What is worked out of a whole map on the way takes many times the map's room.
    """
    edges = np.linspace(0, num_rows, 1 + -(-num_rows // _STRIP_ROWS)).astype(int).tolist()
    strips = []
    for first, last in itertools.pairwise(edges):
        low, high = max(first - margin, 0), min(last + margin, num_rows)
        strips.append(Strip(slice(first, last), slice(low, high), slice(first - low, last - low)))
    return strips
