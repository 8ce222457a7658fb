"""Gaussian mixture of feature points (Algorithm 2, step 6)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.features.clustering import cluster_filter
from uw_dslam_ros2.core.features.sampling import sample_voxels

__all__ = ["Mixture", "mixture_of"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Mixture:
    """Isotropic Gaussians of the plane: ``sum_k weights[k] N(means[k], sigmas_m[k]^2)``."""

    means: FloatArray  # (K, 2) [m]
    weights: FloatArray  # (K,), > 0, sum 1
    sigmas_m: FloatArray  # (K,) [m], > 0

    def __post_init__(self) -> None:
        count = len(self.means)
        if self.means.shape != (count, 2):
            raise InvalidInputError(f"means have shape {self.means.shape}, expected (K, 2)")
        for name in ("weights", "sigmas_m"):
            values = getattr(self, name)
            if values.shape != (count,):
                raise InvalidInputError(f"{name} has shape {values.shape}, expected ({count},)")
            if not (np.isfinite(values).all() and (values > 0.0).all()):
                raise InvalidInputError(f"{name} holds a number that is not positive")


def mixture_of(
    points: ArrayLike, sigma_m: float, *, voxel_size_m: float | None = None, seed: int = 0
) -> Mixture:
    """Algorithm 2 on points (N, 2) [m]: filter, one point a voxel, equal weights and widths."""
    array = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    kept = array[cluster_filter(array)]
    chosen = kept[sample_voxels(kept, voxel_size_m, seed=seed)]
    count = len(chosen)
    weights = np.full(count, 1.0 / count) if count else np.zeros(0)
    return Mixture(chosen, weights, np.full(count, float(sigma_m)))
