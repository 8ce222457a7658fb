"""How the sonar moved from ping to ping, by its echoes alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.doctor.samples.sample import PingSample
from uw_dslam_ros2.core.mapping.scans.matcher import LikelihoodField, Prior, match_points, thin
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["PingMotions", "far_ping_motions", "have_echoes", "ping_motions"]

FloatArray = NDArray[np.float64]

_SIGMAS_M = (0.48, 0.24, 0.12)
_MIN_POINTS = 25
_MAX_POINTS = 200
_MIN_OVERLAP = 0.6
_WINDOW_RAD = 0.6
_CLOSER = (0.5, 0.5, 0.1)  # [m, m, rad] window of a closer look
_LOOKS = 3
_STILL = 0.005  # [m, rad]
_MAX_SPEED_M_S = 2.5
_SHARE = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class PingMotions:
    """Motions of the sonar: ``begin_s`` and ``end_s`` (M,), ``motion`` (M, 3) [x, y, yaw].

    A motion is ``T_begin_end`` in the sonar's frame as the echoes have it; ``information``
    (M, 3, 3) is nearly singular along directions that the echoes leave free.
    """

    begin_s: FloatArray
    end_s: FloatArray
    motion: FloatArray
    information: FloatArray

    def __len__(self) -> int:
        return len(self.begin_s)

    def between(self, begin_s: float, end_s: float) -> PingMotions:
        """Those that lie within a time."""
        inside = (self.begin_s >= begin_s) & (self.end_s <= end_s)
        return PingMotions(
            self.begin_s[inside], self.end_s[inside], self.motion[inside], self.information[inside]
        )

    @property
    def repeats(self) -> float:
        """How many motions tell of the same moment, at least 1."""
        if not len(self):
            return 1.0
        covered_s, until_s = 0.0, -np.inf
        for begin_s, end_s in zip(self.begin_s, self.end_s, strict=True):
            covered_s += max(0.0, float(end_s - max(begin_s, until_s)))
            until_s = max(until_s, float(end_s))
        return max(1.0, float((self.end_s - self.begin_s).sum()) / covered_s)

    def covariance(self, free_sigma: tuple[float, float, float] = (3.0, 3.0, 0.5)) -> FloatArray:
        """Covariances (M, 3, 3); a free direction has `free_sigma` [m, m, rad]."""
        weak = np.diag(1.0 / np.square(free_sigma))
        return np.asarray(np.linalg.inv(self.information + weak))


def have_echoes(pings: PingSample) -> NDArray[np.bool_]:
    """Which of the pings (P,) have enough echoes to be matched."""
    return np.array([len(points) >= _MIN_POINTS for points in pings.points], np.bool_)


def ping_motions(pings: PingSample, min_gap_s: float, max_gap_s: float) -> PingMotions:
    """Match each ping with the next one that is `min_gap_s` to `max_gap_s` later.

    No navigation is used: the search reaches as far as a vehicle moves and turns in that time.
    """
    rows = []
    fan = _Fan.around(pings.points)
    for i, begin_s in enumerate(pings.stamp_s):
        j = int(np.searchsorted(pings.stamp_s, begin_s + min_gap_s))
        if j >= len(pings.stamp_s) or pings.stamp_s[j] - begin_s > max_gap_s:
            continue
        target, source = pings.points[i], pings.points[j]
        first = _match(target, source, float(pings.stamp_s[j] - begin_s))
        if first is not None:
            found = _within_both(target, source, fan, first)
            rows.append((begin_s, pings.stamp_s[j], *found))
    return PingMotions(
        np.array([row[0] for row in rows]),
        np.array([row[1] for row in rows]),
        np.array([row[2] for row in rows]).reshape(-1, 3),
        np.array([row[3] for row in rows]).reshape(-1, 3, 3),
    )


def far_ping_motions(
    pings: PingSample, min_gap_s: float, max_gap_s: float, scale: float
) -> PingMotions:
    """The same where ranges are far too long, found by ranges `scale` times as long."""
    points = tuple(scale * own for own in pings.points)
    found = ping_motions(replace(pings, points=points), min_gap_s, max_gap_s)
    shrink = np.array([scale, scale, 1.0])
    return replace(
        found,
        motion=found.motion / shrink,
        information=found.information * shrink[:, None] * shrink,
    )


@dataclass(frozen=True, slots=True)
class _Fan:
    """What of the plane a sonar sees: bearings [rad] and ranges [m], in its own frame."""

    bearing_rad: tuple[float, float]
    range_m: tuple[float, float]

    @classmethod
    def around(cls, pings: Sequence[FloatArray]) -> _Fan:
        """The smallest that holds all echoes (N, 2)."""
        points = np.vstack([np.empty((0, 2)), *pings])
        if not len(points):
            return cls((0.0, 0.0), (0.0, 0.0))
        bearing, range_m = _polar(points)
        return cls(
            (float(bearing.min()), float(bearing.max())),
            (float(range_m.min()), float(range_m.max())),
        )

    def holds(self, points: FloatArray) -> NDArray[np.bool_]:
        """Which points (N, 2) lie in it."""
        bearing, range_m = _polar(points)
        (right, left), (near, far) = self.bearing_rad, self.range_m
        return (right <= bearing) & (bearing <= left) & (near <= range_m) & (range_m <= far)


def _polar(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    return np.arctan2(points[:, 1], points[:, 0]), np.hypot(points[:, 0], points[:, 1])


def _within_both(
    target: FloatArray, source: FloatArray, fan: _Fan, first: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Match once more with what both pings could see alone.

    A wall goes on where the fan ends, and its end in the image moves with the sonar: the longest
    overlap is that of a sonar which stands still, and a match of all echoes is drawn to it.
    """
    pose, information = first
    for _ in range(_LOOKS):
        T_target_source = SE2.from_array(pose)
        seen_again = source[fan.holds(T_target_source.apply(source))]
        seen_before = target[fan.holds(T_target_source.inverse().apply(target))]
        if len(seen_again) == len(source) and len(seen_before) == len(target):
            break
        prior = Prior(T_target_source, np.diag(np.square(2.0 * np.array(_CLOSER))))
        found = _matched(seen_before, seen_again, _SIGMAS_M[1:], prior, _CLOSER)
        if found is None:
            break
        step = float(np.abs(found[0] - pose).max())
        pose, information = found
        if step < _STILL:
            break
    return pose, information


def _match(
    target: FloatArray, source: FloatArray, gap_s: float
) -> tuple[FloatArray, FloatArray] | None:
    reach = min(_MAX_SPEED_M_S * gap_s, 4.0)
    prior = Prior(SE2(), np.diag([reach**2, reach**2, _WINDOW_RAD**2]))
    return _matched(target, source, _SIGMAS_M, prior, (reach, reach, _WINDOW_RAD))


def _matched(
    target: FloatArray,
    source: FloatArray,
    sigmas_m: Sequence[float],
    prior: Prior,
    window: tuple[float, float, float],
) -> tuple[FloatArray, FloatArray] | None:
    """Motion (3,) and information (3, 3); None where the pings do not meet."""
    if min(len(target), len(source)) < _MIN_POINTS:
        return None
    fields = [LikelihoodField(target, np.ones(len(target)), sigma) for sigma in sigmas_m]
    points, weight = thin(source, np.ones(len(source)), _SIGMAS_M[-1])
    stride = -(-len(points) // _MAX_POINTS)
    points, weight = points[::stride], np.minimum(weight[::stride], 1.0)
    found = match_points(fields, points, weight, prior, window, _SHARE)
    if found.overlap < _MIN_OVERLAP:
        return None
    return found.T_target_source.as_array(), found.information
