"""Nearest-neighbour density estimation: which points of an alignment are inliers (Algorithm 4)."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

__all__ = ["nnde_density", "nnde_inliers"]

FloatArray = NDArray[np.float64]


def nnde_density(
    points: FloatArray, others: FloatArray, num_neighbors: int, scale_m: float
) -> FloatArray:
    """Normalised density (N,) in [0, 1] of the aligned points (N, 2) among the other set (K, 2).

    The density is the reciprocal of the mean distance to the nearest neighbours, so that dense
    regions score high; `scale_m` [m], the kernel's width, is added to the distance, or else one
    perfect pair would push all others to zero. Then the minimum becomes 0 and the maximum 1.
    """
    count = min(num_neighbors, len(others))
    distances, _ = scipy.spatial.cKDTree(others).query(points, k=count)
    mean = np.asarray(distances, dtype=np.float64).reshape(len(points), count).mean(axis=1)
    density = 1.0 / (mean + scale_m)
    spread = density.max() - density.min()
    if spread <= 1e-12 * density.max():
        return np.ones(len(points))
    return (density - density.min()) / spread


def nnde_inliers(
    points: FloatArray,
    others: FloatArray,
    num_neighbors: int,
    threshold: float,
    scale_m: float,
) -> NDArray[np.bool_]:
    """Mask (N,) of the points whose normalised density exceeds the threshold."""
    return nnde_density(points, others, num_neighbors, scale_m) >= threshold
