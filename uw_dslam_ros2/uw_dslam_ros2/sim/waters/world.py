"""A place seen from above: reflecting outlines, and exact rays through them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.errors import InvalidInputError

__all__ = ["NO_HIT", "RayHits", "Surface", "World", "WorldBuilder", "bounds_of", "cast_rays"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

NO_HIT = -1
"""Segment index of a ray that meets nothing."""


@dataclass(frozen=True, slots=True)
class Surface:
    """How a kind of wall answers sound: strength at normal incidence, and how much is mirrored.

    ``strength_db`` relative to a flat concrete wall; ``specular_db`` is added at normal incidence
    (smooth steel flashes, rubble does not).
    """

    name: str
    strength_db: float
    specular_db: float


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """Opaque outlines in a horizontal plane, in the frame ``map`` [m].

    ``segments`` (S, 4) [x0, y0, x1, y1]; ``surface_of`` (S,) indexes ``surfaces``. ``bounds``
    [x_min, y_min, x_max, y_max] hold everything. ``water_point`` (2,) lies in the water that
    vehicles can reach. Depth of the bottom [m] is the same everywhere.
    """

    name: str
    seed: int
    segments: FloatArray
    surface_of: IntArray
    surfaces: tuple[Surface, ...]
    bounds: tuple[float, float, float, float]
    water_point: tuple[float, float]
    water_depth_m: float

    def cast(self, origin: ArrayLike, angles_rad: ArrayLike, max_range_m: float) -> RayHits:
        """First hits of rays from one origin (2,) at angles (K,), counter-clockwise from x."""
        return cast_rays(self.segments, origin, angles_rad, max_range_m)


@dataclass(frozen=True, slots=True, eq=False)
class RayHits:
    """First hits of K rays.

    Range (K,) [m] (inf: none), segment (K,) (`NO_HIT`), cosine of the angle of incidence (K,), and
    the hit's distance (K,) [m] from the segment's start.
    """

    range_m: FloatArray
    segment: IntArray
    cos_incidence: FloatArray
    along_m: FloatArray


@njit(cache=True, nogil=True)
def _cast_kernel(
    segments: FloatArray,
    origin_x: float,
    origin_y: float,
    angles: FloatArray,
    max_range: float,
    ranges: FloatArray,
    indices: IntArray,
    cosines: FloatArray,
    along: FloatArray,
) -> None:
    num_rays = angles.shape[0]
    cos_a, sin_a = np.cos(angles), np.sin(angles)
    for k in range(num_rays):
        ranges[k] = np.inf
        indices[k] = -1
        cosines[k] = 0.0
        along[k] = 0.0
    for s in range(segments.shape[0]):
        ax, ay = segments[s, 0] - origin_x, segments[s, 1] - origin_y
        ex, ey = segments[s, 2] - segments[s, 0], segments[s, 3] - segments[s, 1]
        length = math.hypot(ex, ey)
        if length == 0.0:
            continue
        # The segment's distance from the origin: most of a large place is out of range.
        t = -(ax * ex + ay * ey) / (length * length)
        t = min(1.0, max(0.0, t))
        if math.hypot(ax + t * ex, ay + t * ey) > max_range:
            continue
        for k in range(num_rays):
            # origin + r d = a + u e, solved by Cramer's rule.
            denominator = cos_a[k] * ey - sin_a[k] * ex
            if denominator == 0.0:
                continue
            r = (ax * ey - ay * ex) / denominator
            u = (ax * sin_a[k] - ay * cos_a[k]) / denominator
            if 0.0 <= u <= 1.0 and 0.0 < r <= max_range and r < ranges[k]:
                ranges[k] = r
                indices[k] = s
                cosines[k] = abs(denominator) / length
                along[k] = u * length


def cast_rays(
    segments: FloatArray, origin: ArrayLike, angles_rad: ArrayLike, max_range_m: float
) -> RayHits:
    """First hits of rays with segments (S, 4) [x0, y0, x1, y1], exactly; see `World.cast`."""
    origin = np.asarray(origin, dtype=np.float64)
    angles = np.ascontiguousarray(angles_rad, dtype=np.float64)
    if origin.shape != (2,) or angles.ndim != 1:
        raise InvalidInputError(
            f"origin has shape {origin.shape}, angles {angles.shape}, expected (2,) and (K,)"
        )
    hits = RayHits(
        np.empty(len(angles)),
        np.empty(len(angles), np.int64),
        np.empty(len(angles)),
        np.empty(len(angles)),
    )
    _cast_kernel(
        np.ascontiguousarray(segments, dtype=np.float64),
        origin[0],
        origin[1],
        angles,
        float(max_range_m),
        hits.range_m,
        hits.segment,
        hits.cos_incidence,
        hits.along_m,
    )
    return hits


def bounds_of(segments: FloatArray) -> tuple[float, float, float, float]:
    """Smallest box [x_min, y_min, x_max, y_max] around segments (S, 4)."""
    xs, ys = segments[:, [0, 2]], segments[:, [1, 3]]
    return float(xs.min()), float(ys.min()), float(xs.max()), float(ys.max())


class WorldBuilder:
    """Collects outlines of one place."""

    def __init__(self) -> None:
        self._segments: list[FloatArray] = []
        self._surface_of: list[int] = []
        self._surfaces: list[Surface] = []

    def add(self, surface: Surface, points: ArrayLike, *, is_closed: bool = False) -> None:
        """Add a polyline through points (N >= 2, 2) [m]."""
        points = np.asarray(points, dtype=np.float64)
        if is_closed:
            points = np.vstack([points, points[:1]])
        if surface not in self._surfaces:
            self._surfaces.append(surface)
        index = self._surfaces.index(surface)
        for start, end in itertools.pairwise(points):
            self._segments.append(np.concatenate([start, end]))
            self._surface_of.append(index)

    def build(
        self, name: str, seed: int, water_point: Sequence[float], water_depth_m: float
    ) -> World:
        """Finish; the bounds are those of the outlines."""
        segments = np.array(self._segments)
        return World(
            name=name,
            seed=seed,
            segments=segments,
            surface_of=np.array(self._surface_of, dtype=np.int64),
            surfaces=tuple(self._surfaces),
            bounds=bounds_of(segments),
            water_point=(float(water_point[0]), float(water_point[1])),
            water_depth_m=water_depth_m,
        )
