"""How promising a search is, told cheaply: what shapes two maps hold, and how much of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.grid import OccupancyMap

__all__ = ["NO_SHAPE", "MapShape", "promise", "shape_of"]

FloatArray = NDArray[np.float64]

_MAX_WALL_POINTS = 600
_NUM_BINS = 24
_SMALLEST_M = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class MapShape:
    """What a map looks like from any side.

    ``histogram`` (24,) holds the shares of distances between pairs of wall points, in bins that
    widen by a constant factor (the D2 shape distribution of Osada et al. 2002): turning or
    shifting the map does not change it. ``wall_length_m`` is about the length of its walls.
    """

    histogram: FloatArray
    wall_length_m: float


NO_SHAPE = MapShape(np.zeros(_NUM_BINS), 0.0)
"""Of a map without walls."""


def shape_of(occupancy: OccupancyMap) -> MapShape:
    """Describe a map; one without walls has an empty histogram."""
    cells = np.argwhere(occupancy.values > 50)
    length_m = len(cells) * occupancy.spec.resolution_m
    if len(cells) < 2:
        return MapShape(np.zeros(_NUM_BINS), length_m)
    step = max(1, math.ceil(len(cells) / _MAX_WALL_POINTS))
    points = occupancy.spec.centers_of(cells[::step])
    first, second = np.triu_indices(len(points), k=1)
    distance = np.hypot(*(points[first] - points[second]).T)
    # A factor of about 1.26 a bin covers half a metre to a hundred and more.
    ratio = np.maximum(distance, _SMALLEST_M) / _SMALLEST_M
    index = np.floor(10.0 * np.log10(ratio)).astype(int)
    counts = np.bincount(np.minimum(index, _NUM_BINS - 1), minlength=_NUM_BINS)
    return MapShape(counts / counts.sum(), length_m)


def promise(source: MapShape, target: MapShape) -> float:
    """Expected worth of a search: likeness of the shapes times the walls that could match [m].

    The likeness is the common part of the histograms, in [0, 1].
    """
    likeness = float(np.minimum(source.histogram, target.histogram).sum())
    return likeness * min(source.wall_length_m, target.wall_length_m)
