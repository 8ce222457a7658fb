"""The speckle of sonar images in four numbers, to compare simulated images with real ones."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

__all__ = ["speckle_of", "speckle_statistics"]

FloatArray = NDArray[np.float64]


def speckle_statistics(pings: NDArray[np.generic]) -> FloatArray:
    """Coefficient of variation, skewness, correlation of next beams and of next ranges (4,).

    Of intensities (P, R, B) over their local mean, without the margins.
    """
    deviation = speckle_of(pings)

    def correlation(a: FloatArray, b: FloatArray) -> float:
        return float((a * b).mean() / math.sqrt((a * a).mean() * (b * b).mean()))

    return np.array([
        deviation.std(),
        (deviation**3).mean() / deviation.std() ** 3,
        correlation(deviation[:, :, 1:], deviation[:, :, :-1]),
        correlation(deviation[:, 1:], deviation[:, :-1]),
    ])  # fmt: skip


def speckle_of(pings: NDArray[np.generic]) -> FloatArray:
    """Intensities (P, R, B) over their local mean, less 1, without the margins."""
    x = np.asarray(pings, dtype=np.float64)
    local = np.stack([gaussian_filter(ping, 6.0) for ping in x])
    return (x / np.maximum(local, 1e-9) - 1.0)[:, 20:-20, 20:-20]
