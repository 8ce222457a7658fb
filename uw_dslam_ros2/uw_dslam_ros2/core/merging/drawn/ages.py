"""When what a map shows was last seen."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.grid import GridSpec
from uw_dslam_ros2.core.merging.types import SubmapRecord

__all__ = ["last_seen_ns"]


def last_seen_ns(
    spec: GridSpec, records: Iterable[SubmapRecord], cells: NDArray[np.int64]
) -> NDArray[np.int64]:
    """When cells (N, 2) [row, col] of a map were last seen, (N,): the end of the latest submap.

    0 where no submap knows the cell, or none that tells its times.

    Parameters
    ----------
    spec
        Of a map in the frame of a group of submaps, whoever drew it.
    records
        Those of the group.
    """
    points = spec.centers_of(cells)
    latest = np.zeros(len(cells), np.int64)
    for record in records:
        submap = record.submap
        if len(submap.trajectory) == 0:
            continue
        grid = submap.grid
        own = grid.spec.cells_of(record.T_component_submap.inverse().apply(points))
        inside = np.flatnonzero(grid.spec.contains(own))
        has_it = inside[grid.known[tuple(own[inside].T)]]
        latest[has_it] = np.maximum(latest[has_it], submap.trajectory_stamp_ns[-1])
    return latest
