"""Points of an occupancy map by any of the methods: Algorithm 2's input, behind one interface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.features.grid_filter import clean_cells
from uw_dslam_ros2.core.features.orb import orb_points
from uw_dslam_ros2.core.features.walls import wall_points
from uw_dslam_ros2.core.grid import OccupancyMap

__all__ = ["POINT_METHODS", "grid_points"]

FloatArray = NDArray[np.float64]
POINT_METHODS = ("orb", "walls", "both")


def grid_points(
    occupancy: OccupancyMap, method: str = "walls", max_points: int = 200
) -> tuple[FloatArray, FloatArray]:
    """Feature points (N, 2) [m] in the map's frame and weights (N,) of sum 1; N may be 0.

    Parameters
    ----------
    method
        ``orb``: corners, as the paper; ``walls``: points along the walls; ``both``: half of each.
    max_points
        Greatest N.
    """
    if method not in POINT_METHODS:
        raise InvalidInputError(
            f"method is {method!r}, expected one of {', '.join(POINT_METHODS)}"
        )
    cells = clean_cells(occupancy)
    share = max_points if method != "both" else max(1, max_points // 2)
    parts = []
    if method in ("orb", "both"):
        parts.append(orb_points(cells, share))
    if method in ("walls", "both"):
        parts.append(wall_points(cells, share))
    points = np.concatenate([part[0] for part in parts])
    weights = np.concatenate([part[1] for part in parts])
    spec = occupancy.spec
    placed = spec.T_frame_grid.apply(points * spec.resolution_m)
    return placed, weights / weights.sum() if len(weights) else weights
