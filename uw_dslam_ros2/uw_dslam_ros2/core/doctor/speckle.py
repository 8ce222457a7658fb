"""What a sonar's pixels stand for, by their speckle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

__all__ = ["Quantity", "patch_variations", "quantity_of"]

Quantity = Literal["compressed", "amplitude", "power"]
FloatArray = NDArray[np.float64]

_PATCH = (16, 12)  # ranges, beams
_MIN_PATCHES = 100
_MIN_LEVELS = 10.0  # a mean of fewer steps is too coarse to show speckle
_MAX_EMPTY = 0.15  # zeros beyond that are a driver's threshold, not speckle
_LIMITS = (0.42, 0.75, 1.5)


def patch_variations(intensity: NDArray[np.generic]) -> FloatArray:
    """Standard deviation over mean (P,) of small patches of an image (R, B) that say something."""
    values = np.asarray(intensity, dtype=np.float64)
    rows, columns = _PATCH
    num = values.shape[0] // rows, values.shape[1] // columns
    tiles = values[: num[0] * rows, : num[1] * columns].reshape(num[0], rows, num[1], columns)
    patches = tiles.transpose(0, 2, 1, 3).reshape(num[0] * num[1], rows * columns)
    mean = patches.mean(axis=1)
    least = _MIN_LEVELS if intensity.dtype.kind in "ui" else 0.0
    is_used = (mean > least) & ((patches <= 0.0).mean(axis=1) <= _MAX_EMPTY)
    return np.asarray(patches[is_used].std(axis=1) / mean[is_used])


def quantity_of(variations: Sequence[FloatArray]) -> Quantity | None:
    """What the pixels of some images are; None where their patches (P,) do not show it.

    Fully developed speckle varies by 1 in power, by 0.52 in amplitude and by less in what is
    compressed for display; structure adds to that, so the evenest quarter of the patches is asked.
    """
    known = np.concatenate([*variations, np.empty(0)])
    if len(known) < _MIN_PATCHES:
        return None
    even = float(np.quantile(known, 0.25))
    if not math.isfinite(even) or even > _LIMITS[2]:
        return None
    if even > _LIMITS[1]:
        return "power"
    return "amplitude" if even > _LIMITS[0] else "compressed"
