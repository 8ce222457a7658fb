"""Clustering filter: drop the points that belong to no cluster (Algorithm 2, step 2)."""

from __future__ import annotations

import math

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.errors import InvalidInputError

__all__ = ["cluster_filter", "mean_spacing"]

FloatArray = NDArray[np.float64]


def mean_spacing(points: ArrayLike) -> float:
    """Mean distance [m] from a point to its nearest other one; 0 for fewer than two points."""
    array = _checked(points)
    if len(array) < 2:
        return 0.0
    distances, _ = scipy.spatial.cKDTree(array).query(array, k=2)
    return float(distances[:, 1].mean())


def cluster_filter(
    points: ArrayLike, *, radius_factor: float = 4.0, min_cluster_size: int = 3
) -> NDArray[np.bool_]:
    """Mask (N,) of the points that lie in a cluster: what is left are clear outliers.

    Density-based clustering (DBSCAN) whose radius follows the data.

    Parameters
    ----------
    points : (N, 2)
        [m].
    radius_factor : float
        Radius of a neighbourhood over the mean distance to the nearest neighbour, > 0.
    min_cluster_size : int
        Points that a neighbourhood must hold, the point itself counted, > 0.
    """
    array = _checked(points)
    if not (math.isfinite(radius_factor) and radius_factor > 0.0):
        raise InvalidInputError(f"radius_factor is {radius_factor}, expected a positive number")
    if min_cluster_size < 1:
        raise InvalidInputError(f"min_cluster_size is {min_cluster_size}, expected at least 1")
    if len(array) == 0:
        return np.zeros(0, dtype=np.bool_)
    radius_m = max(radius_factor * mean_spacing(array), 1e-12)
    # Which cluster a point is in does not matter here, so the clusters need not be grown.
    counts = scipy.spatial.cKDTree(array).query_ball_point(array, radius_m, return_length=True)
    is_core = np.asarray(counts) >= min_cluster_size
    if not is_core.any():
        return is_core
    distances, _ = scipy.spatial.cKDTree(array[is_core]).query(array)
    return np.asarray(distances <= radius_m)


def _checked(points: ArrayLike) -> FloatArray:
    array = np.asarray(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 2:
        raise InvalidInputError(f"points have shape {array.shape}, expected (N, 2)")
    if not np.isfinite(array).all():
        raise InvalidInputError("points hold a number that is not finite")
    return array
