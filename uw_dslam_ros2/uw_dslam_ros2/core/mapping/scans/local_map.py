"""The echoes of the last stretch of the path, against which the next ping is matched."""

from __future__ import annotations

from collections import deque

import numpy as np
import scipy
from numpy.typing import NDArray

from uw_dslam_ros2.core.mapping.config import WIDE_BEAM_RAD, MatchConfig
from uw_dslam_ros2.core.mapping.scans.matcher import (
    LikelihoodField,
    Prior,
    ScanMatch,
    match_points,
    thin,
)
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["LocalMap", "joined"]

FloatArray = NDArray[np.float64]
_COARSEST = 8.0
_MAX_PINGS = 200
"""A vehicle at rest has no path after which its pings would go."""
_MIN_POINTS = 20
"""Fewer echoes than this, of the ping or known ones, say too little of a pose."""
_MAX_POINTS = 300
"""Of more echoes an even choice is matched: more of the same walls add time, not accuracy."""

_NEAR_M = 1.0


def joined(
    points: FloatArray, weight: FloatArray, beamwidth_rad: float, step_m: float
) -> tuple[FloatArray, FloatArray]:
    """Echoes (N, 2) of successive wide beams, and the wall between those that lie near.

    Two turns hear a wall at places that lie further apart than the field is wide; between two
    beams that are neighbours on it the wall goes on. Beams two widths apart see it at 60 degrees.
    """
    if len(points) < 2 or beamwidth_rad < WIDE_BEAM_RAD:
        return points, weight
    steps = np.diff(points, axis=0)
    length_m = np.hypot(steps[:, 0], steps[:, 1])
    range_m = np.hypot(points[:-1, 0], points[:-1, 1])
    is_near = (length_m < 2.0 * beamwidth_rad * range_m) & (length_m > step_m)
    parts, weights = [points], [weight]
    for i in np.flatnonzero(is_near):
        share = np.arange(step_m, length_m[i], step_m)[:, None] / length_m[i]
        parts.append(points[i] + share * steps[i])
        weights.append(np.full(len(share), min(weight[i], weight[i + 1])))
    return np.vstack(parts), np.concatenate(weights)


class LocalMap:
    """Recent key pings in the open submap's frame."""

    def __init__(self, config: MatchConfig) -> None:
        self._config = config
        self._pings: deque[tuple[FloatArray, FloatArray, float]] = deque()
        self._path_length_m = 0.0
        self._last: SE2 | None = None

    def add(self, points: FloatArray, weight: FloatArray, T_submap_base: SE2) -> None:
        """Add a key ping's echoes (N, 2) in the submap's frame; forget those too far back."""
        if self._last is not None:
            self._path_length_m += self._last.distance_to(T_submap_base)[0]
        self._last = T_submap_base
        self._pings.append((points, weight, self._path_length_m))
        while (
            self._path_length_m - self._pings[0][2] > self._config.local_length_m
            or len(self._pings) > _MAX_PINGS
        ):
            self._pings.popleft()

    def rebase(self, T_new_old: SE2) -> None:
        """Move everything to a new submap's frame."""
        self._pings = deque((T_new_old.apply(p), w, at_m) for p, w, at_m in self._pings)
        if self._last is not None:
            self._last = T_new_old @ self._last

    def is_near(self, points: FloatArray) -> bool:
        """Whether most points (N, 2) in the submap's frame lie near known ones, roughly."""
        if len(points) < _MIN_POINTS or not self._pings:
            return False
        known = np.vstack([p for p, _, _ in self._pings])
        if len(known) < _MIN_POINTS:
            return False
        distance_m, _ = scipy.spatial.cKDTree(known).query(points, distance_upper_bound=_NEAR_M)
        return bool(np.isfinite(distance_m).mean() > 0.5)

    def match(self, points: FloatArray, weight: FloatArray, prior: Prior) -> ScanMatch | None:
        """Match a ping's echoes (N, 2) in base_link; None where there is too little to match."""
        config = self._config
        if len(points) < _MIN_POINTS or not self._pings:
            return None
        known = np.vstack([p for p, _, _ in self._pings])
        support = np.concatenate([w for _, w, _ in self._pings])
        if len(known) < _MIN_POINTS:
            return None
        sigma = np.sqrt(np.diag(prior.covariance))
        half_width = (
            float(np.clip(3.0 * sigma[0], config.sigma_m, config.window_m)),
            float(np.clip(3.0 * sigma[1], config.sigma_m, config.window_m)),
            float(np.clip(3.0 * sigma[2], 0.2 * config.window_rad, config.window_rad)),
        )
        coarse = min(max(max(half_width[:2]) / 4.0, config.sigma_m), _COARSEST * config.sigma_m)
        sigmas = [coarse]
        while sigmas[-1] > 1.5 * config.sigma_m:
            sigmas.append(max(0.5 * sigmas[-1], config.sigma_m))
        fields = [LikelihoodField(known, support, s) for s in sigmas]
        source, source_weight = thin(points, weight, config.sigma_m)
        stride = -(-len(source) // _MAX_POINTS)
        source, source_weight = source[::stride], source_weight[::stride]
        return match_points(
            fields,
            source,
            np.minimum(source_weight, 1.0),
            prior,
            half_width,
            config.information_share,
        )
