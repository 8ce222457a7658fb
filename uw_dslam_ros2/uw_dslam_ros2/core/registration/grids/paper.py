"""The paper's way from two maps to a motion: points of each, a Gaussian mixture, GMRBnB, NNDE."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.features.clustering import cluster_filter
from uw_dslam_ros2.core.features.grid_filter import clean_cells, coarsen
from uw_dslam_ros2.core.features.grid_points import grid_points
from uw_dslam_ros2.core.features.sampling import sample_voxels, voxel_size
from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.registration.config import RegistrationConfig
from uw_dslam_ros2.core.registration.grids.config import GridRegistrationConfig
from uw_dslam_ros2.core.registration.grids.judging.agreement import WallMap, measure_agreement
from uw_dslam_ros2.core.registration.points.register import register_point_sets
from uw_dslam_ros2.core.registration.result import PriorWindow, Progress, RegistrationResult
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["register_grids_by_points"]

FloatArray = NDArray[np.float64]
_CANDIDATES_PER_POINT = 4
_VOXEL_GROWTH = 1.2


def register_grids_by_points(
    source: OccupancyMap,
    target: OccupancyMap,
    config: GridRegistrationConfig,
    *,
    prior: PriorWindow | None = None,
    clock: Callable[[], float] | None = None,
    progress: Callable[[Progress], None] | None = None,
    is_cancelled: Callable[[], bool] | None = None,
) -> RegistrationResult:
    """Match the maps' points alone (Algorithms 1 to 4), and say how the maps agree there.

    Points are found, freed of those in no cluster, and thinned to one a voxel (Algorithm 2); their
    number, not the voxels' size, is what `GridRegistrationConfig.max_points` limits.
    """
    points, weights = zip(
        *(_sampled_points(m, config.features, config.max_points) for m in (source, target)),
        strict=True,
    )
    result = register_point_sets(
        points[0],
        points[1],
        RegistrationConfig(
            method="gmrbnb",
            gap=config.gap,
            max_boxes=config.max_boxes,
            max_seconds=config.max_seconds,
        ),
        source_weights=weights[0] if len(weights[0]) else None,
        target_weights=weights[1] if len(weights[1]) else None,
        prior=prior,
        clock=clock,
        progress=progress,
        is_cancelled=is_cancelled,
    )
    if result.T_target_source is None:
        return result
    resolution_m = max(source.spec.resolution_m, target.spec.resolution_m)
    walls = [WallMap(coarsen(clean_cells(m), resolution_m)) for m in (source, target)]
    T_grids = (
        target.spec.T_frame_grid.inverse() @ result.T_target_source @ source.spec.T_frame_grid
    )
    agreement = measure_agreement(
        walls[0], walls[1], SE2(T_grids.x / resolution_m, T_grids.y / resolution_m, T_grids.yaw)
    )
    return replace(result, overlap=agreement.overlap, conflict_ratio=agreement.conflict)


def _sampled_points(
    occupancy: OccupancyMap, method: str, max_points: int
) -> tuple[FloatArray, FloatArray]:
    """Algorithm 2: points (N, 2) [m] and weights (N,) of sum 1, N at most ``max_points``."""
    points, weights = grid_points(occupancy, method, _CANDIDATES_PER_POINT * max_points)
    is_clustered = cluster_filter(points)
    points, weights = points[is_clustered], weights[is_clustered]
    size_m = voxel_size(points)
    chosen = np.arange(len(points))
    while size_m > 0.0:
        chosen = sample_voxels(points, size_m)
        if len(chosen) <= max_points:
            break
        size_m *= _VOXEL_GROWTH
    total = float(weights[chosen].sum())
    return points[chosen], weights[chosen] / total if len(chosen) else weights[chosen]
