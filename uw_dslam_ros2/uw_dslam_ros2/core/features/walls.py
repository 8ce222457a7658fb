"""Points along the walls of a map, evenly spaced, weighted by evidence, placed within the cell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.features.grid_filter import FilteredCells

__all__ = ["wall_points"]

FloatArray = NDArray[np.float64]


def wall_points(
    cells: FilteredCells, max_points: int, spacing_cells: float = 1.0
) -> tuple[FloatArray, FloatArray]:
    """At most ``max_points`` wall points [x, y] (N, 2) in cells, and weights (N,) of sum 1.

    Positions count from the grid's outer corner.

    Walls are gathered in squares of ``spacing_cells``, larger if that gives too many; a point is
    the weighted mean of the walls in its square. A point's weight is the evidence there, limited
    to what one line through the square carries, so that a cluttered corner does not outweigh a
    wall.
    """
    rows, cols = np.nonzero(cells.wall > 0.25)
    if len(rows) == 0:
        return np.empty((0, 2)), np.empty(0)
    weight = cells.wall[rows, cols].astype(np.float64)
    points = np.column_stack([cells.col[rows, cols], cells.row[rows, cols]]).astype(np.float64)
    spacing = spacing_cells
    while True:
        gathered, total = _gather(points, weight, spacing)
        if len(gathered) <= max_points:
            break
        # The number of squares along lines falls with the spacing, in areas with its square.
        spacing *= max(1.05, (len(gathered) / max_points) ** 0.7)
    total = np.minimum(total, spacing)
    return gathered, total / total.sum()


def _gather(
    points: FloatArray, weight: FloatArray, spacing: float
) -> tuple[FloatArray, FloatArray]:
    square = np.floor(points / spacing).astype(np.int64)
    key = square[:, 1] * (square[:, 0].max() + 1) + square[:, 0]
    _, index = np.unique(key, return_inverse=True)
    total = np.bincount(index, weights=weight)
    x = np.bincount(index, weights=weight * points[:, 0]) / total
    y = np.bincount(index, weights=weight * points[:, 1]) / total
    return np.column_stack([x, y]), total
