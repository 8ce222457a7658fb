"""One map of many grids at their poses, kept while grids come in and move."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.mapping.grid_kernels import resample_add
from uw_dslam_ros2.core.mapping.occupancy import PackedEvidence, SparseEvidence
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["FusedMap", "fuse"]

# Growing means copying everything, so it goes in long steps.
_TILE = 256


class FusedMap:
    """Sum of grids at their poses.

    Evidence is counted in integers, so a grid can be taken out again without a trace: the map
    does not depend on the order in which grids came and moved, and a change costs what the grids
    that moved cost, however many there are. Only one of them is unpacked at a time.
    """

    def __init__(self, resolution_m: float) -> None:
        self._resolution_m = resolution_m
        self._row, self._col = 0, 0
        self._evidence = np.zeros((0, 0), np.int32)
        self._count = np.zeros((0, 0), np.int16)
        self._placed: dict[int, SE2] = {}

    def pose(self, index: int) -> SE2 | None:
        """Where grid `index` lies; None if it is not in the map."""
        return self._placed.get(index)

    def place(self, index: int, part: PackedEvidence | SparseEvidence, pose: SE2) -> None:
        """Put a grid at a pose; if it was in the map before, it moves there."""
        grid = part.unpacked() if isinstance(part, PackedEvidence) else part
        if grid.resolution_m != self._resolution_m:
            raise InvalidInputError(
                f"resolution is {grid.resolution_m} m, expected {self._resolution_m} m"
            )
        old = self._placed.get(index)
        if old is not None:
            self._add(grid, old, -1)
        self._grow_for(pose.apply(grid.corners()))
        self._add(grid, pose, 1)
        self._placed[index] = pose

    def remove(self, index: int, part: PackedEvidence | SparseEvidence) -> None:
        """Take a grid out again."""
        grid = part.unpacked() if isinstance(part, PackedEvidence) else part
        self._add(grid, self._placed.pop(index), -1)

    def to_occupancy(self, log_odds_max: float) -> OccupancyMap:
        """The observed part in percent; at least one cell."""
        grid = SparseEvidence(
            self._evidence, self._count > 0, self._row, self._col, self._resolution_m
        )
        return grid.trimmed().to_occupancy(log_odds_max)

    def _add(self, grid: SparseEvidence, pose: SE2, sign: int) -> None:
        resample_add(
            self._evidence, self._count, self._row, self._col,
            grid.evidence, grid.observed, grid.row, grid.col,
            pose.x, pose.y, pose.yaw, self._resolution_m, sign,
        )  # fmt: skip

    def _grow_for(self, corners: NDArray[np.float64]) -> None:
        col, row = np.floor(corners.min(axis=0) / self._resolution_m / _TILE).astype(int) * _TILE
        last_col, last_row = (
            np.ceil(corners.max(axis=0) / self._resolution_m / _TILE).astype(int) * _TILE
        )
        rows, cols = self._evidence.shape
        if self._evidence.size:
            row, col = min(row, self._row), min(col, self._col)
            last_row = max(last_row, self._row + rows)
            last_col = max(last_col, self._col + cols)
        shape = (int(last_row - row), int(last_col - col))
        if shape == (rows, cols):
            return
        evidence, count = np.zeros(shape, np.int32), np.zeros(shape, np.int16)
        top, left = self._row - int(row), self._col - int(col)
        if self._evidence.size:
            evidence[top : top + rows, left : left + cols] = self._evidence
            count[top : top + rows, left : left + cols] = self._count
        self._row, self._col, self._evidence, self._count = int(row), int(col), evidence, count


def fuse(
    parts: Iterable[tuple[PackedEvidence | SparseEvidence, SE2]], log_odds_max: float
) -> OccupancyMap:
    """One map of several grids at their poses; evidence is summed, order does not matter."""
    fused: FusedMap | None = None
    for index, (part, pose) in enumerate(parts):
        if fused is None:
            fused = FusedMap(part.resolution_m)
        fused.place(index, part, pose)
    if fused is None:
        raise InvalidInputError("there is no grid to fuse, expected at least one")
    return fused.to_occupancy(log_odds_max)
