"""What a sonar's pixels stand for, by their speckle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

__all__ = ["Quantity", "decibels_per_count", "patch_levels", "quantity_of"]

Quantity = Literal["compressed", "amplitude", "power", "decibel"]
FloatArray = NDArray[np.float64]

_PATCH = (16, 12)  # ranges, beams
_MIN_PATCHES = 100
_MIN_LEVELS = 10.0  # a mean of fewer steps is too coarse to show speckle
_MAX_EMPTY = 0.15  # zeros beyond that are a driver's threshold, not speckle
_LIMITS = (0.42, 0.75, 1.5)
_SPECKLE_DB = 5.57  # standard deviation of fully developed speckle
_MIN_CONTRAST, _MAX_GROWTH = 1.15, 0.4  # of the mean, and of the deviation with it


def patch_levels(intensity: NDArray[np.generic]) -> FloatArray:
    """Mean and deviation (P, 2) of small patches of an image (R, B) that say something."""
    values = np.asarray(intensity, dtype=np.float64)
    rows, columns = _PATCH
    num = values.shape[0] // rows, values.shape[1] // columns
    tiles = values[: num[0] * rows, : num[1] * columns].reshape(num[0], rows, num[1], columns)
    patches = tiles.transpose(0, 2, 1, 3).reshape(num[0] * num[1], rows * columns)
    mean = patches.mean(axis=1)
    least = _MIN_LEVELS if intensity.dtype.kind in "ui" else 0.0
    is_used = (mean > least) & ((patches <= 0.0).mean(axis=1) <= _MAX_EMPTY)
    return np.column_stack([mean[is_used], patches[is_used].std(axis=1)])


def decibels_per_count(levels: Sequence[FloatArray]) -> float:
    """Decibels that one step of the pixels stands for; 0 where they are no logarithm.

    Speckle varies by as many decibels whatever the mean is. In pixels of any power of the
    amplitude it grows with the mean.
    """
    known = np.concatenate([*levels, np.empty((0, 2))])
    if len(known) < _MIN_PATCHES:
        return 0.0
    known = known[np.argsort(known[:, 0], kind="stable")]
    third = len(known) // 3
    dark, bright = known[:third], known[-third:]
    contrast = float(np.median(bright[:, 0]) / np.median(dark[:, 0]))
    if contrast < _MIN_CONTRAST:
        return 0.0
    deviations = [float(np.quantile(part[:, 1], 0.25)) for part in (dark, bright)]
    if min(deviations) <= 0.0 or math.log(deviations[1] / deviations[0]) > (
        _MAX_GROWTH * math.log(contrast)
    ):
        return 0.0
    return _SPECKLE_DB / float(np.quantile(known[:, 1], 0.25))


def quantity_of(levels: Sequence[FloatArray]) -> Quantity | None:
    """What the pixels of some images are; None where their patches (P, 2) do not show it.

    Fully developed speckle varies by 1 in power, by 0.52 in amplitude and by less in what is
    compressed for display; structure adds to that, so the evenest quarter of the patches is asked.
    """
    known = np.concatenate([*levels, np.empty((0, 2))])
    if len(known) < _MIN_PATCHES:
        return None
    if decibels_per_count(levels):
        return "decibel"
    even = float(np.quantile(known[:, 1] / known[:, 0], 0.25))
    if not math.isfinite(even) or even > _LIMITS[2]:
        return None
    if even > _LIMITS[1]:
        return "power"
    return "amplitude" if even > _LIMITS[0] else "compressed"
