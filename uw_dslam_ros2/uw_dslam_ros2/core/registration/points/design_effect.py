"""How many points say the same thing together.

A likelihood multiplies over points as if each were drawn for itself. Points along walls are not:
where one of them meets a wall of the other set, its neighbours do too, at wrong poses as well as
at the right one. In survey sampling the remedy is the *design effect*: the variance of a sum over
clustered units is that of independent ones times a factor, and the sample counts as many units as
it has, divided by that factor.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.registration.points.correlation import likelihood_raster, sum_shifted
from uw_dslam_ros2.core.registration.points.evidence import Outline

__all__ = ["design_effect"]

FloatArray = NDArray[np.float64]

_PITCH = 0.8  # kernels between translations
_SCATTER = 8.0  # of the ratio for independent points, times the root of their number: its top
_EXCLUDED = 4.0  # kernels around the pose in question, where the sum is no matter of chance


def design_effect(
    turned: FloatArray,
    target: FloatArray,
    outline: Outline,
    translation: FloatArray,
    sigma_m: float,
    contrast: float,
) -> float:
    """Variance of the summed log-likelihood over translations, over that of independent points.

    At the rotation in question the source is shifted over the target; the field counts relative to
    its mean inside the target's outline and is zero outside, so that mere overlap does not count.
    Points placed independently have 1 on average, however wide the kernel, and scatter about it;
    the result is that by which the ratio exceeds their scatter, and at least 1.

    Parameters
    ----------
    turned : (m, 2)
        Source points, turned, about their centre [m].
    target : (n, 2)
        [m].
    outline : Outline
        Of the target.
    translation : (2,)
        Of the pose in question; its neighbourhood is left out.
    sigma_m, contrast : float
        Kernel, and density on a target over that of clutter.
    """
    pitch_m = _PITCH * sigma_m
    raster, origin = likelihood_raster(target, sigma_m, pitch_m, contrast)
    rows, columns = raster.shape
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
    inside = outline.holds(origin + pitch_m * grid.reshape(-1, 2)).reshape(raster.shape)
    if not inside.any():
        return 1.0
    centred = np.where(inside, raster - raster[inside].mean(), 0.0).astype(np.float32)
    half = 0.25 * np.ptp(target, axis=0) + 0.25 * np.ptp(turned, axis=0)
    middle = 0.5 * (target.min(axis=0) + target.max(axis=0))
    start = middle - half
    num_columns, num_rows = (np.ceil(2.0 * half / pitch_m) + 1.0).astype(np.int64)
    places = np.floor((turned + start - origin) / pitch_m + 0.5).astype(np.int64)
    total, single = sum_shifted(centred, places, num_rows, num_columns)
    x = start[0] + pitch_m * np.arange(num_columns) - translation[0]
    y = start[1] + pitch_m * np.arange(num_rows) - translation[1]
    is_far = x[None, :] ** 2 + y[:, None] ** 2 > (_EXCLUDED * sigma_m) ** 2
    expected = float(single[is_far].sum())
    if expected <= 0.0:
        return 1.0
    ratio = float((total[is_far].astype(np.float64) ** 2).sum()) / expected
    return max(ratio / (1.0 + _SCATTER / math.sqrt(min(len(turned), len(target)))), 1.0)
