"""What two maps say about each other at a pose."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.features.grid_filter import FilteredCells
from uw_dslam_ros2.core.registration.grids.judging import agreement_kernels
from uw_dslam_ros2.core.registration.grids.judging.lines import off_strongest_lines
from uw_dslam_ros2.core.registration.grids.signed_field import wall_distance
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["Agreement", "WallMap", "measure_agreement"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Agreement:
    """What two maps say about each other at a pose.

    ``overlap`` is the area seen by both over the smaller seen area. Of the wall cells of either
    map inside the other's seen area (``num_walls``, copies of one counted once), ``agreement`` is
    the share with a wall near and ``conflict`` the share on free space with none near.
    ``inlier_ratio`` of the source's wall cells have a partner. ``residual_cells`` is the root mean
    square distance of the partners. ``wall_share`` is the share of the common area that is that
    near to a wall: what a wall cell dropped anywhere would find. ``num_detail`` of the agreeing
    wall cells lie off the few straight lines that hold most of them: any room has straight walls,
    so they tell one place from another.
    """

    overlap: float
    num_walls: int
    agreement: float
    conflict: float
    inlier_ratio: float
    residual_cells: float
    wall_share: float
    num_detail: float


class WallMap:
    """Distance to walls, free share and walls of a map, made once for all poses.

    ``num_copies`` of its cells hold what one cell of the map does, and count as one.
    """

    def __init__(self, cells: FilteredCells, num_copies: int = 1) -> None:
        self.cells, self.num_copies = cells, num_copies
        is_wall = cells.wall > 0.25
        self.distance = wall_distance(cells)
        self.free = cv2.boxFilter(cells.free, -1, (3, 3), borderType=cv2.BORDER_CONSTANT)
        known = cells.known > 0.5
        self.num_known = int(np.count_nonzero(known))
        # 0 unknown, 1 known, 2 known and near a wall
        self.seen = np.where(known, 1 + (self.distance <= _NEAR_CELLS), 0).astype(np.uint8)
        rows, cols = np.nonzero(is_wall)
        self.points = np.column_stack([cells.col[rows, cols], cells.row[rows, cols]]).astype(
            np.float64
        )


_NUM_LINES = 4
_NUM_LINE_ANGLES = 120
_LINE_HALF_WIDTH_CELLS = 2.5
_MOST_LINE_POINTS = 1500
_NEAR_CELLS = 2.5
_FAR_CELLS = 3.5
_LEAST_FREE = 0.6  # share of free cells around a wall that make it contradict the other map


def measure_agreement(source: WallMap, target: WallMap, T_target_source: SE2) -> Agreement:
    """Agreement of two maps of one resolution; ``T_target_source`` is in cells [x, y]."""
    seen, near, conflict, square, inliers = 0, 0, 0, 0.0, 0.0
    agreeing = []
    for walls, other, T_other in (
        (source, target, T_target_source),
        (target, source, T_target_source.inverse()),
    ):
        is_near = np.empty(len(walls.points), np.bool_)
        counts = agreement_kernels.compare_walls(
            walls.points, math.cos(T_other.yaw), math.sin(T_other.yaw), T_other.x, T_other.y,
            other.seen, other.distance, other.free,
            _NEAR_CELLS, _FAR_CELLS, _LEAST_FREE, is_near,
        )  # fmt: skip
        seen, near, conflict = seen + counts[0], near + counts[1], conflict + counts[2]
        square += counts[3]
        points = walls.points[is_near]
        agreeing.append(T_target_source.apply(points) if walls is source else points)
        if walls is source:
            inliers = counts[1] / max(len(is_near), 1)
    overlap, wall_share = _common_area(source, target, T_target_source)
    num_copies = max(source.num_copies, target.num_copies)
    return Agreement(
        overlap,
        round(seen / num_copies),
        near / max(seen, 1),
        conflict / max(seen, 1),
        inliers,
        float(np.sqrt(square / max(near, 1))),
        wall_share,
        near / num_copies * _detail_share(np.concatenate(agreeing), math.sqrt(num_copies)),
    )


def _detail_share(points: FloatArray, width: float) -> float:
    """Share of points (N, 2) [cells] that lie off the few lines that hold most of them.

    A line is ``width`` times as wide as for cells that are as large as those of the maps.
    """
    if len(points) == 0:
        return 0.0
    some = points[:: -(-len(points) // _MOST_LINE_POINTS)]
    left = off_strongest_lines(
        np.ascontiguousarray(some), _NUM_LINES, _NUM_LINE_ANGLES, width * _LINE_HALF_WIDTH_CELLS
    )
    return float(left.mean())


def _common_area(source: WallMap, target: WallMap, T_target_source: SE2) -> tuple[float, float]:
    """Area seen by both over the smaller seen area, and the share of it that is near a wall."""
    rows, cols = target.seen.shape
    matrix = T_target_source.matrix()[:2].copy()
    matrix[:, 2] += matrix[:, :2] @ (0.5, 0.5) - 0.5  # OpenCV counts from cell centres
    moved = cv2.warpAffine(source.seen, matrix, (cols, rows), flags=cv2.INTER_NEAREST)
    both, near = agreement_kernels.count_common(moved, target.seen)
    smaller = min(source.num_known, target.num_known)
    return min(both / max(smaller, 1), 1.0), 0.5 * near / max(both, 1)
