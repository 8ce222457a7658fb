"""What two maps say about each other at a pose."""

from __future__ import annotations

import math
from dataclasses import dataclass

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
    map inside the other's seen area (``num_walls``; of split cells, half), ``agreement`` is
    the share with a wall near and ``conflict`` the share on free space with none near.
    ``inlier_ratio`` of the source's wall cells have a partner, ``target_inlier_ratio`` of the
    target's. ``residual_cells`` is the root mean
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
    target_inlier_ratio: float = 0.0


class WallMap:
    """Distance to walls, free share and walls of a map, made once for all poses.

    ``is_split``: its cells are halves of those that the map has. So a wall is twice as thick as it
    need be, and counts by its length: two cells are one.
    """

    def __init__(self, cells: FilteredCells, is_split: bool = False) -> None:
        import cv2  # large, so loaded when first used

        self.cells, self.is_split = cells, is_split
        is_wall = cells.wall > 0.25
        self.distance = wall_distance(cells)
        self.free = cv2.boxFilter(cells.free, -1, (3, 3), borderType=cv2.BORDER_CONSTANT)
        known = cells.known > 0.5
        self.num_known = int(np.count_nonzero(known))
        # 0 unknown, 1 known, 2 known and near a wall
        self.seen = np.where(known, 1 + (self.distance <= _NEAR_CELLS), 0).astype(np.uint8)
        self.thickness = _mean_thickness(is_wall)
        rows, cols = np.nonzero(is_wall)
        self.points = np.column_stack([cells.col[rows, cols], cells.row[rows, cols]]).astype(
            np.float64
        )


_NUM_LINES = 4
_NUM_LINE_ANGLES = 120
_LINE_HALF_WIDTH_CELLS = 2.5
_LEAST_SPLIT_THICKNESS = 2.0  # of a wall of half cells
_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
_MOST_LINE_POINTS = 1500
_NEAR_CELLS = 2.5
_FAR_CELLS = 3.5
_LEAST_FREE = 0.6  # share of free cells around a wall that make it contradict the other map


def measure_agreement(source: WallMap, target: WallMap, T_target_source: SE2) -> Agreement:
    """Agreement of two maps of one resolution; ``T_target_source`` is in cells [x, y]."""
    seen, near, conflict, square = 0, 0, 0, 0.0
    agreeing, inliers = [], []
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
        inliers.append(counts[1] / max(len(is_near), 1))
    overlap, wall_share = _common_area(source, target, T_target_source)
    share, width = 1.0, _LINE_HALF_WIDTH_CELLS
    if source.is_split:
        share = 0.5
        width += 0.5 * (max(source.thickness, target.thickness) - _LEAST_SPLIT_THICKNESS)
    return Agreement(
        overlap,
        round(share * seen),
        near / max(seen, 1),
        conflict / max(seen, 1),
        inliers[0],
        float(np.sqrt(square / max(near, 1))),
        wall_share,
        share * near * _detail_share(np.concatenate(agreeing), width),
        inliers[1],
    )


def _mean_thickness(is_wall: NDArray[np.bool_]) -> float:
    """Cells of the walls (R, C) over half of those at their rims, 2 at least."""
    import cv2  # large, so loaded when first used

    inner = cv2.erode(is_wall.astype(np.uint8), _CROSS, borderType=cv2.BORDER_CONSTANT)
    num_walls = int(np.count_nonzero(is_wall))
    return 2.0 * num_walls / max(num_walls - int(np.count_nonzero(inner)), 1)


def _detail_share(points: FloatArray, half_width: float) -> float:
    """Share of points (N, 2) [cells] that lie off the few lines that hold most of them."""
    if len(points) == 0:
        return 0.0
    some = points[:: -(-len(points) // _MOST_LINE_POINTS)]
    left = off_strongest_lines(
        np.ascontiguousarray(some), _NUM_LINES, _NUM_LINE_ANGLES, half_width
    )
    return float(left.mean())


def _common_area(source: WallMap, target: WallMap, T_target_source: SE2) -> tuple[float, float]:
    """Area seen by both over the smaller seen area, and the share of it that is near a wall."""
    import cv2  # large, so loaded when first used

    rows, cols = target.seen.shape
    matrix = T_target_source.matrix()[:2].copy()
    matrix[:, 2] += matrix[:, :2] @ (0.5, 0.5) - 0.5  # OpenCV counts from cell centres
    moved = cv2.warpAffine(source.seen, matrix, (cols, rows), flags=cv2.INTER_NEAREST)
    both, near = agreement_kernels.count_common(moved, target.seen)
    smaller = min(source.num_known, target.num_known)
    return min(both / max(smaller, 1), 1.0), 0.5 * near / max(both, 1)
