"""A place some time later: things that lie or moor in it have moved, or are gone."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.waters.world import World, bounds_of

__all__ = ["another_season", "loose_objects"]

IntArray = NDArray[np.int64]
_MOVED_SHARE = 0.1
_MOVED_M = 3.0
_HULL_M = 10.0  # the least size of what a mooring is left by


def loose_objects(world: World) -> list[IntArray]:
    """Segments of each closed outline: hulls, piles and rocks, but no quay."""
    objects, first = [], 0
    segments = world.segments
    for last in range(len(segments)):
        is_closed = np.array_equal(segments[last, 2:], segments[first, :2])
        is_end = last + 1 == len(segments) or not np.array_equal(
            segments[last, 2:], segments[last + 1, :2]
        )
        if is_closed:
            objects.append(np.arange(first, last + 1))
        if is_closed or is_end:
            first = last + 1
    return objects


def another_season(world: World, rng: np.random.Generator) -> World:
    """The place with a tenth of its loose objects moved by some metres, and a hull gone."""
    segments = world.segments.copy()
    is_kept = np.ones(len(segments), np.bool_)
    objects = loose_objects(world)
    hulls = [index for index in objects if np.ptp(segments[index, :2], axis=0).max() > _HULL_M]
    if hulls:
        is_kept[hulls[int(rng.integers(len(hulls)))]] = False
    count = math.ceil(_MOVED_SHARE * len(objects)) if objects else 0
    for number in rng.permutation(len(objects))[:count]:
        index = objects[number]
        middle = segments[index, :2].mean(axis=0)
        turn = SE2(yaw=float(rng.uniform(-math.pi, math.pi)))
        shift = rng.normal(0.0, _MOVED_M, 2)
        for ends in (slice(0, 2), slice(2, 4)):
            segments[index, ends] = turn.apply(segments[index, ends] - middle) + middle + shift
    return replace(
        world,
        segments=segments[is_kept],
        surface_of=world.surface_of[is_kept],
        bounds=bounds_of(segments[is_kept]),
    )
