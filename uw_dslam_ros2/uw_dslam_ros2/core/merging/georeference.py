"""Where the map lies on earth, as people say of places in it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.merging.decisions import Decision
from uw_dslam_ros2.core.se2 import SE2, wrap_angle
from uw_dslam_ros2.core.submap import SubmapId

__all__ = ["Georeference", "georeference_of"]

FloatArray = NDArray[np.float64]

_NUM_STEPS = 10
_MIN_APART_M = 1.0
"""Positions nearer to each other than this say nothing of the map's heading."""


@dataclass(frozen=True, slots=True)
class Georeference:
    """The rigid motion that fits the fixes best.

    ``sigmas_off`` gives, by the number of each fix, how far off it is in its own standard
    deviations; ``metres_off`` in metres.
    """

    earth_frame: str
    T_earth_map: SE2
    metres_off: dict[int, float]
    sigmas_off: dict[int, float]


def georeference_of(
    fixes: Sequence[Decision], T_map_submap: Mapping[SubmapId, SE2]
) -> Georeference | str:
    """Where "map" lies on earth; a sentence where the fixes do not say it.

    Parameters
    ----------
    fixes
        Decisions of kind FIX; those of submaps without a place in "map" do not count.
    T_map_submap
        Places of the submaps in the map.
    """
    used = [fix for fix in fixes if fix.source in T_map_submap]
    if not used:
        return "no fix of a submap that is in the map"
    frames = sorted({fix.earth_frame for fix in used})
    if len(frames) > 1:
        return f"the fixes are in {' and in '.join(frames)}, expected one of them"
    poses = [T_map_submap[fix.source] for fix in used]  # type: ignore[index]
    points = np.array([T.apply(np.array(fix.point)) for T, fix in zip(poses, used, strict=True)])
    places = np.array([fix.place.as_array() for fix in used])  # type: ignore[union-attr]
    yaws = np.array([T.yaw for T in poses])
    weights = np.array([[1.0 / f.sigma_m, 1.0 / f.sigma_m, 1.0 / f.sigma_rad] for f in used])
    start = _start(points, places, yaws, weights)
    if start is None:
        return "one more fix, elsewhere in the map, is needed, or one with a heading"
    motion, middle = start, points.mean(axis=0)
    for _ in range(_NUM_STEPS):
        motion = _step(motion, middle, points, places, yaws, weights)
    errors = _errors(motion, points, places, yaws)
    metres, sigmas = np.hypot(*errors[:, :2].T), np.linalg.norm(errors * weights, axis=1)
    numbers = [fix.number for fix in used]
    return Georeference(
        frames[0],
        motion,
        dict(zip(numbers, metres.tolist(), strict=True)),
        dict(zip(numbers, sigmas.tolist(), strict=True)),
    )


def _start(
    points: FloatArray, places: FloatArray, yaws: FloatArray, weights: FloatArray
) -> SE2 | None:
    """First guess; None where nothing says how the map is turned."""
    known = weights[:, 2] > 0.0
    away, there = points - points.mean(axis=0), places[:, :2] - places[:, :2].mean(axis=0)
    if known.any():
        turns, strength = places[known, 2] - yaws[known], weights[known, 2] ** 2
        turn = math.atan2(float(strength @ np.sin(turns)), float(strength @ np.cos(turns)))
    elif np.hypot(*away.T).max() >= _MIN_APART_M:
        cross = away[:, 0] * there[:, 1] - away[:, 1] * there[:, 0]
        turn = math.atan2(float(cross.sum()), float((away * there).sum()))
    else:
        return None
    moved = SE2(0.0, 0.0, turn).apply(points)
    x, y = (places[:, :2] - moved).mean(axis=0)
    return SE2(float(x), float(y), turn)


def _step(
    motion: SE2,
    middle: FloatArray,
    points: FloatArray,
    places: FloatArray,
    yaws: FloatArray,
    weights: FloatArray,
) -> SE2:
    """One step of Gauss and Newton; turned about the points' middle, as earth is far away."""
    arms = SE2(0.0, 0.0, motion.yaw).apply(points - middle)
    jacobian = np.zeros((len(points), 3, 3))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = jacobian[:, 2, 2] = 1.0
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -arms[:, 1], arms[:, 0]
    rows = (weights[:, :, None] * jacobian).reshape(-1, 3)
    errors = (weights * _errors(motion, points, places, yaws)).ravel()
    shift = np.linalg.lstsq(rows, -errors, rcond=None)[0]
    center = motion.apply(middle) + shift[:2]
    turned = SE2(0.0, 0.0, motion.yaw + float(shift[2]))
    corner = center - turned.apply(middle)
    return SE2(float(corner[0]), float(corner[1]), turned.yaw)


def _errors(motion: SE2, points: FloatArray, places: FloatArray, yaws: FloatArray) -> FloatArray:
    """(N, 3): where the points come to lie, less where they should."""
    errors = np.empty((len(points), 3))
    errors[:, :2] = motion.apply(points) - places[:, :2]
    errors[:, 2] = wrap_angle(yaws + motion.yaw - places[:, 2])
    return errors
