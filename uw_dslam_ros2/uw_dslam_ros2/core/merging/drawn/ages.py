"""When what a map shows was last seen."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.merging.types import SubmapRecord

__all__ = ["last_seen_ns"]


def last_seen_ns(occupancy: OccupancyMap, records: Iterable[SubmapRecord]) -> NDArray[np.int64]:
    """When the walls (R, C) of a map were last seen: the end of the latest submap with the cell.

    0 where no submap has it, or none that tells its times, and where there is no wall.

    Parameters
    ----------
    occupancy
        A map in the frame of a group of submaps, whoever drew it.
    records
        Those of the group.
    """
    walls = np.argwhere(occupancy.values > 50)
    points = occupancy.spec.centers_of(walls)
    latest = np.zeros(len(walls), np.int64)
    for record in records:
        submap = record.submap
        if len(submap.trajectory) == 0:
            continue
        grid = submap.grid
        cells = grid.spec.cells_of(record.T_component_submap.inverse().apply(points))
        inside = np.flatnonzero(grid.spec.contains(cells))
        has_it = inside[grid.known[tuple(cells[inside].T)]]
        latest[has_it] = np.maximum(latest[has_it], submap.trajectory_stamp_ns[-1])
    seen = np.zeros(occupancy.spec.shape, np.int64)
    seen[tuple(walls.T)] = latest
    return seen
