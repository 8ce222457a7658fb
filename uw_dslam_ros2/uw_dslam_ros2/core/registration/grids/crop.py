"""Maps as a match sees them: neither canvas nor the order of rows and columns decides on it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap, bounds_of
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["crop_to_known", "precedes", "turn_to_own_axes"]

_WALL_PERCENT = 65
_LEAST_SHARE = 0.002  # of all known cells: an island with fewer is a speck


def crop_to_known(occupancy: OccupancyMap) -> OccupancyMap:
    """The smallest part that holds what is known, specks aside, in the same frame.

    Specks inside that part stay. The map itself where nothing would be cut.
    """
    import cv2  # large, so loaded when first used

    known = occupancy.known
    box = bounds_of(known)
    if box is None:
        return occupancy
    inner = np.ascontiguousarray(known[box])
    count, _, stats, _ = cv2.connectedComponentsWithStats(inner.view(np.uint8), connectivity=8)
    areas = stats[1:, cv2.CC_STAT_AREA]
    large = stats[1:][areas >= _LEAST_SHARE * areas.sum()]
    if count > 2 and 0 < len(large) < count - 1:
        first = large[:, [cv2.CC_STAT_TOP, cv2.CC_STAT_LEFT]]
        last = first + large[:, [cv2.CC_STAT_HEIGHT, cv2.CC_STAT_WIDTH]]
        row, col = (int(v) for v in first.min(axis=0))
        end_row, end_col = (int(v) for v in last.max(axis=0))
        box = (
            slice(box[0].start + row, box[0].start + end_row),
            slice(box[1].start + col, box[1].start + end_col),
        )
    values = occupancy.values[box]
    if values.shape == occupancy.spec.shape:
        return occupancy
    part = occupancy.spec.part(box[0].start, box[1].start, *values.shape)
    return OccupancyMap(part, np.ascontiguousarray(values))


def turn_to_own_axes(occupancy: OccupancyMap) -> OccupancyMap:
    """The map turned by the quarter turns that what is in it decides, in the same frame.

    Larger cells are blocks that begin in a map's corner, and every grid has four of them. So of
    the four ways to tell one map, always the same one is chosen: that in which the middle of what
    is known, or of the walls if that is the middle of the map, lies ahead, towards higher columns.
    """
    for mask in (occupancy.known, occupancy.values >= _WALL_PERCENT):
        forward, left = _imbalance(mask)
        if forward or left:
            break
    while not (forward >= 0 and -forward < left <= forward) and (forward or left):
        occupancy = _quarter_turned(occupancy)
        forward, left = -left, forward
    return occupancy


def precedes(occupancy: OccupancyMap, other: OccupancyMap) -> bool:
    """Whether a map comes first of two, by what is in them: that of the smaller known area.

    Of the same area, the one with fewer walls; of maps that also have as many of these, bytes
    decide. Both are told as `turn_to_own_axes` tells them.
    """
    return _order(occupancy) < _order(other)


def _order(occupancy: OccupancyMap) -> tuple[float, float, tuple[int, int], bytes]:
    area = occupancy.spec.resolution_m**2
    # The product is rounded so that cells of another size, which share an area, have the same.
    known, walls = (
        round(area * np.count_nonzero(mask), 6)
        for mask in (occupancy.known, occupancy.values >= _WALL_PERCENT)
    )
    return known, walls, occupancy.spec.shape, occupancy.values.tobytes()


def _imbalance(mask: NDArray[np.bool_]) -> tuple[int, int]:
    """How far the middle of the set cells lies off that of the map, along columns and rows.

    Times twice their number: a whole number, so that no rounding decides.
    """
    rows, cols = (mask.sum(axis=axis, dtype=np.int64) for axis in (1, 0))
    balances = []
    for counts in (cols, rows):
        places = 2 * np.arange(len(counts)) + 1 - len(counts)
        balances.append(int(counts @ places))
    return balances[0], balances[1]


def _quarter_turned(occupancy: OccupancyMap) -> OccupancyMap:
    """The same map in the same frame, with what lay towards higher columns now at higher rows."""
    spec = occupancy.spec
    corner = spec.T_frame_grid @ SE2(0.0, spec.num_rows * spec.resolution_m, -0.5 * math.pi)
    values = np.ascontiguousarray(occupancy.values.T[:, ::-1])
    turned = GridSpec(spec.resolution_m, spec.num_cols, spec.num_rows, corner)
    return OccupancyMap(turned, values)
