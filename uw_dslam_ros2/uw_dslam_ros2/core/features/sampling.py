"""Density-uniform sampling: one random point a voxel (Algorithm 2, steps 3 to 5)."""

from __future__ import annotations

import math

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.features.clustering import mean_spacing

__all__ = ["sample_voxels", "voxel_size"]


def voxel_size(points: ArrayLike, factor: float = 2.0) -> float:
    """Voxel side [m]: `factor` mean distances between neighbouring points."""
    return factor * mean_spacing(points)


def sample_voxels(
    points: ArrayLike, size_m: float | None = None, *, seed: int = 0
) -> NDArray[np.int64]:
    """Indices (K,), ascending, of one random point for every voxel that holds any.

    The voxels are squares about their centres; a KD-tree over the points' own voxel centres says
    who belongs to which. The same seed gives the same points.

    Parameters
    ----------
    points : (N, 2)
        [m].
    size_m : float
        Side of a voxel, > 0; `voxel_size` without.
    seed : int
        Of the choice within a voxel.
    """
    array = np.asarray(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 2:
        raise InvalidInputError(f"points have shape {array.shape}, expected (N, 2)")
    if not np.isfinite(array).all():
        raise InvalidInputError("points hold a number that is not finite")
    size = voxel_size(array) if size_m is None and len(array) else size_m
    if len(array) == 0:
        return np.zeros(0, dtype=np.int64)
    if size is None or not math.isfinite(size) or size < 0.0 or (size_m is not None and size == 0):
        raise InvalidInputError(f"size_m is {size_m}, expected a positive number")
    if size == 0.0:  # all points are one, or there is only one
        return np.zeros(1, dtype=np.int64)
    cells = np.floor((array - array.min(axis=0)) / size)
    centers = np.unique((cells + 0.5) * size, axis=0)
    # In the largest norm, the nearest centre is that of the voxel around the point.
    _, voxels = scipy.spatial.cKDTree(centers).query(array - array.min(axis=0), p=np.inf)
    order = np.random.default_rng(seed).permutation(len(array))
    _, first = np.unique(voxels[order], return_index=True)
    return np.sort(order[first])
