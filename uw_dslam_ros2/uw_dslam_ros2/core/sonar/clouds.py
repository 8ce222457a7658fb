"""Points that somebody else detected: of a fan, or of a sonar with one beam that turns."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.sonar.detect import checked_points, spacing_of_turn

__all__ = ["Clouds"]

_QUICKEST_TURN_NS = 4_000_000_000
_PATIENCE_NS = 80_000_000_000
"""Two of the slowest turns; a mapper knows where it was then a little longer."""
_WIDEST_FAN_RAD = math.radians(160.0)
_SECTORS = 120
_SPACING_RAD = 0.03
"""Of beams where no turn has shown it: two steps of 0.9 degrees, or one of 1.8."""


class Clouds[Cloud]:
    """Holds clouds of points back until it is known what kind of sonar they are of.

    A turn's points lie all round, but not where the echoes are few: such a cloud looks like one of
    a fan, whose lone points are noise, and which comes at once. A fan pings many times while
    another sonar turns once; one that pings as seldom as that never hears beyond its aperture,
    while turns do, sooner or later.
    """

    def __init__(self) -> None:
        self.turn_spacing_rad: float | None = None
        """How far the beams of a sonar that turns lie apart; 0 for a fan; None: not known yet."""
        self._waiting: list[Cloud] = []
        self._first_ns = self._last_ns = 0
        self._is_quick = False
        self._heard_from = np.zeros(_SECTORS, np.bool_)

    def add(self, stamp_ns: int, points: ArrayLike, cloud: Cloud) -> list[Cloud]:
        """What may be mapped now, in the order of arrival; `InvalidInputError` for bad points."""
        xy = checked_points(points)
        is_first = self.turn_spacing_rad is None and not self._waiting
        if is_first:
            self._first_ns = stamp_ns
        elif stamp_ns - self._last_ns < _QUICKEST_TURN_NS:
            self._is_quick = True
        if (around_rad := spacing_of_turn(xy)) > 0.0:
            self.turn_spacing_rad = around_rad
        elif not self.turn_spacing_rad:
            self._judge(xy, stamp_ns, is_first=is_first)
        self._waiting.append(cloud)
        self._last_ns = stamp_ns
        return [] if self.turn_spacing_rad is None else self.take()

    def _judge(self, xy: NDArray[np.float64], stamp_ns: int, *, is_first: bool) -> None:
        """Say what few points are of, if that is known by now."""
        bearing = np.arctan2(xy[:, 1], xy[:, 0])
        self._heard_from[(bearing * (_SECTORS / (2.0 * math.pi))).astype(np.int64) % _SECTORS] = 1
        if self._is_quick:
            self.turn_spacing_rad = 0.0
        elif _covered_rad(self._heard_from) > _WIDEST_FAN_RAD:
            if not is_first:
                self.turn_spacing_rad = _SPACING_RAD
        elif stamp_ns - self._first_ns > _PATIENCE_NS:
            self.turn_spacing_rad = 0.0

    def take(self) -> list[Cloud]:
        """All that still waits."""
        waiting, self._waiting = self._waiting, []
        return waiting


def _covered_rad(heard_from: NDArray[np.bool_]) -> float:
    """The least arc that holds all sectors (S,) that were heard from."""
    places = np.flatnonzero(heard_from)
    if not len(places):
        return 0.0
    gaps = np.diff(places, append=places[0] + len(heard_from))
    return float(2.0 * math.pi * (1.0 - (gaps.max() - 1) / len(heard_from)))
