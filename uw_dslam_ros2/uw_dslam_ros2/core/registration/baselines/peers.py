"""Other packages' methods, where they are installed; the plane is lifted to three dimensions.

None of them is needed by this project: they are imported when called, and `available_peers`
tells which can be. ``pip install open3d small-gicp kiss-matcher`` brings those that exist for the
platform.
"""

from __future__ import annotations

import importlib
import importlib.util
import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.registration.baselines.result import BaselineResult, checked_points
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["PEERS", "available_peers", "is_installed", "kiss_matcher", "open3d_icp", "small_gicp"]

FloatArray = NDArray[np.float64]
_NUM_LAYERS = 5
_LEAST_INLIERS = 5
Matcher = Callable[[ArrayLike, ArrayLike], BaselineResult]


def open3d_icp(
    source: ArrayLike, target: ArrayLike, *, max_distance_m: float = 1.0
) -> BaselineResult:
    """Open3D's point-to-point ICP from identity."""
    o3d = importlib.import_module("open3d")
    clouds = []
    for name, points in (("source", source), ("target", target)):
        cloud = o3d.geometry.PointCloud()
        cloud.points = o3d.utility.Vector3dVector(_lifted(name, points))
        clouds.append(cloud)
    found = o3d.pipelines.registration.registration_icp(*clouds, max_distance_m, np.eye(4))
    return BaselineResult(_flattened(found.transformation), float(found.fitness))


def small_gicp(
    source: ArrayLike, target: ArrayLike, *, max_distance_m: float = 1.0
) -> BaselineResult:
    """small_gicp's point-to-point ICP from identity (planes have no meaning at z = 0)."""
    package = importlib.import_module("small_gicp")
    found = package.align(
        _lifted("target", target),
        _lifted("source", source),
        registration_type="ICP",
        downsampling_resolution=1e-4,
        max_correspondence_distance=max_distance_m,
    )
    T = _flattened(found.T_target_source) if found.converged else None
    return BaselineResult(T, -float(found.error), {"num_iterations": float(found.iterations)})


def kiss_matcher(source: ArrayLike, target: ArrayLike, *, voxel_m: float = 0.05) -> BaselineResult:
    """KISS-Matcher: features, pruning and GNC, turning in the plane alone.

    It was made for dense 3-D scans and looks at normals, so each point stands upright, a pole of
    voxels half as high. Fewer inliers than its authors' examples ask for are a refusal.
    """
    package = importlib.import_module("kiss_matcher")
    config = package.KISSMatcherConfig(voxel_m)
    config.use_quatro = True
    matcher = package.KISSMatcher(config)
    clouds = [
        list(_upright(name, points, 0.5 * voxel_m).astype(np.float32))
        for name, points in (("source", source), ("target", target))
    ]
    found = matcher.estimate(*clouds)
    inliers = matcher.get_num_final_inliers()
    if not found.valid or inliers < _LEAST_INLIERS:
        return BaselineResult(None, float(inliers))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = found.rotation, np.ravel(found.translation)
    return BaselineResult(_flattened(matrix), float(inliers))


PEERS: dict[str, tuple[str, Matcher]] = {
    "open3d ICP": ("open3d", open3d_icp),
    "small_gicp ICP": ("small_gicp", small_gicp),
    "KISS-Matcher": ("kiss_matcher", kiss_matcher),
}
"""Method name to the package it needs, and the method."""


def available_peers() -> dict[str, Matcher]:
    """Those of `PEERS` whose package is installed."""
    return {name: matcher for name, (package, matcher) in PEERS.items() if is_installed(package)}


def is_installed(package: str) -> bool:
    """Whether a package can be imported."""
    return importlib.util.find_spec(package) is not None


def _lifted(name: str, points: ArrayLike) -> FloatArray:
    array = checked_points(name, points)
    return np.column_stack([array, np.zeros(len(array))])


def _upright(name: str, points: ArrayLike, step_m: float) -> FloatArray:
    """Points (N, 2) [m] as poles of `_NUM_LAYERS` points each."""
    array = checked_points(name, points)
    heights = np.repeat(np.arange(_NUM_LAYERS) * step_m, len(array))
    return np.column_stack([np.tile(array, (_NUM_LAYERS, 1)), heights])


def _flattened(matrix: ArrayLike) -> SE2 | None:
    """The planar part; None for a matrix that turns the plane over or is not finite."""
    matrix = np.asarray(matrix, dtype=np.float64)
    if not np.isfinite(matrix).all() or matrix[2, 2] < 0.0:
        return None
    yaw = math.atan2(matrix[1, 0] - matrix[0, 1], matrix[0, 0] + matrix[1, 1])
    return SE2(float(matrix[0, 3]), float(matrix[1, 3]), yaw)
