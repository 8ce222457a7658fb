"""Undo the enlarging of a map: cells in equal blocks carry no more than one cell of their size.

Filters that think in cells (a line of nine cells, a speck) would take each block for a body.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["shrink_blocks"]

_MOST_CELLS = 32
_LEAST_CELLS = 2  # specks of 2 x 2 cells pass for lines
_SHARE_AT_EDGES = 0.9  # of the changes between neighbours; a third at most by chance ...
_SHARE_OF_PAIRS = 0.98  # ... and half of them, of blocks of two cells
_MIN_EDGES = 8  # fewer say nothing: any two lie on some lattice
_MIN_SIDE_BLOCKS = 40


def shrink_blocks(occupancy: OccupancyMap) -> OccupancyMap:
    """The map with one cell for each block, in the same frame; itself where there are none.

    Blocks are squares of 2 to 32 cells on a lattice that may begin anywhere; cells that were
    changed after the enlarging are allowed for.
    """
    values = occupancy.values
    changes = [np.count_nonzero(values[:, 1:] != values[:, :-1], axis=0)]
    changes.append(np.count_nonzero(values[1:] != values[:-1], axis=1))
    for side in range(
        min(_MOST_CELLS, max(values.shape) // _MIN_SIDE_BLOCKS), _LEAST_CELLS - 1, -1
    ):
        phases = [_phase(count, side) for count in changes]
        if phases[0] is not None and phases[1] is not None:
            return _sampled(occupancy, side, phases[1], phases[0])
    return occupancy


def _phase(changes: NDArray[np.int64], side: int) -> int | None:
    """Where the first block edge lies if most changes lie on edges of such blocks, or None."""
    total = np.bincount(np.arange(1, len(changes) + 1) % side, changes, side)
    phase = int(total.argmax())
    least = _SHARE_OF_PAIRS if side == 2 else _SHARE_AT_EDGES
    if total.sum() == 0 or total[phase] < least * total.sum():
        return None
    num_edges = np.count_nonzero(changes[(phase - 1) % side :: side])
    return phase if num_edges >= _MIN_EDGES else None


def _sampled(occupancy: OccupancyMap, side: int, first_row: int, first_col: int) -> OccupancyMap:
    """The middle of each block; the first ones may begin outside of the map."""
    spec = occupancy.spec
    starts = [-((side - first) % side) for first in (first_row, first_col)]
    middles = [
        np.clip(np.arange(start, size, side) + side // 2, 0, size - 1)
        for start, size in zip(starts, spec.shape, strict=True)
    ]
    corner = SE2(starts[1] * spec.resolution_m, starts[0] * spec.resolution_m)
    shrunk = GridSpec(
        spec.resolution_m * side, len(middles[0]), len(middles[1]), spec.T_frame_grid @ corner
    )
    return OccupancyMap(shrunk, np.ascontiguousarray(occupancy.values[np.ix_(*middles)]))
