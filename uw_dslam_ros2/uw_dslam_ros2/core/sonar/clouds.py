"""Points that somebody else detected: of a fan, or of a sonar with one beam that turns."""

from __future__ import annotations

from numpy.typing import ArrayLike

from uw_dslam_ros2.core.sonar.detect import checked_points, spacing_of_turn

__all__ = ["Clouds"]

_QUICKEST_TURN_NS = 4_000_000_000
_NUM_WAITING = 3
"""So many clouds, each later than the quickest turn, are turns. Slow ones take 35 s."""
_SPACING_RAD = 0.03
"""Of beams where no turn has shown it: two steps of 0.9 degrees, or one of 1.8."""


class Clouds[Cloud]:
    """Holds clouds of points back until it is known what kind of sonar they are of.

    A turn's points lie all round, but not where the echoes are few: such a cloud looks like one of
    a fan, whose lone points are noise, and which comes at once. What tells them apart is time: a
    fan pings many times while another sonar turns once.
    """

    def __init__(self) -> None:
        self.turn_spacing_rad: float | None = None
        """How far the beams of a sonar that turns lie apart; 0 for a fan; None: not known yet."""
        self._waiting: list[Cloud] = []
        self._last_ns = 0

    def add(self, stamp_ns: int, points: ArrayLike, cloud: Cloud) -> list[Cloud]:
        """What may be mapped now, in the order of arrival; `InvalidInputError` for bad points."""
        around_rad = spacing_of_turn(checked_points(points))
        if around_rad > 0.0:
            self.turn_spacing_rad = around_rad
        elif self.turn_spacing_rad is None and self._waiting:
            if stamp_ns - self._last_ns < _QUICKEST_TURN_NS:
                self.turn_spacing_rad = 0.0
            elif len(self._waiting) + 1 >= _NUM_WAITING:
                self.turn_spacing_rad = _SPACING_RAD
        self._waiting.append(cloud)
        self._last_ns = stamp_ns
        return [] if self.turn_spacing_rad is None else self.take()

    def take(self) -> list[Cloud]:
        """All that still waits."""
        waiting, self._waiting = self._waiting, []
        return waiting
