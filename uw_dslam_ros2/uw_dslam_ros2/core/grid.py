"""Grids of the plane: metres to [row, col] and back, and the maps that live on them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["FREE", "OCCUPIED", "UNKNOWN", "EvidenceGrid", "GridSpec", "OccupancyMap"]

FloatArray = NDArray[np.float64]

UNKNOWN, FREE, OCCUPIED = -1, 0, 100
"""Values of an occupancy map: -1 unknown, else the probability of being occupied in percent."""


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


@dataclass(frozen=True, slots=True, eq=False)
class EvidenceGrid:
    """An occupancy grid as it is computed: natural log-odds, positive means occupied.

    ``log_odds`` is float32 of ``spec.shape``. ``observed`` is a mask of its own, because log-odds
    0 may also mean echoes that contradict each other.
    """

    spec: GridSpec
    log_odds: NDArray[np.float32]
    observed: NDArray[np.bool_]

    def __post_init__(self) -> None:
        for name in ("log_odds", "observed"):
            shape = getattr(self, name).shape
            if shape != self.spec.shape:
                raise InvalidInputError(f"{name} has shape {shape}, expected {self.spec.shape}")

    def to_occupancy(self) -> OccupancyMap:
        """Probability in percent, rounded; unobserved cells are -1."""
        probability = 1.0 / (1.0 + np.exp(-self.log_odds.astype(np.float64)))
        percent = np.rint(100.0 * probability).astype(np.int8)
        return OccupancyMap(self.spec, np.where(self.observed, percent, np.int8(UNKNOWN)))

    @classmethod
    def from_occupancy(cls, occupancy: OccupancyMap) -> EvidenceGrid:
        """Undo `to_occupancy` up to its rounding; 0 and 100 become half a percent from there."""
        probability = np.clip(occupancy.values.astype(np.float64) / 100.0, 0.005, 0.995)
        log_odds = np.log(probability / (1.0 - probability))
        known = occupancy.known
        return cls(occupancy.spec, np.where(known, log_odds, 0.0).astype(np.float32), known.copy())
