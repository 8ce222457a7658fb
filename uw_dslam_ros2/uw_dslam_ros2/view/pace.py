"""How often work that repeats itself may be done, so that it takes a share of a core at most."""

from __future__ import annotations

import math

__all__ = ["Pace"]


class Pace:
    """Work is begun, seconds of it are noted, and the next begins when they have been earned.

    Parameters
    ----------
    share
        Of a core, in (0, 1].
    longest_s
        No wait is longer.
    """

    def __init__(self, share: float, longest_s: float = 5.0) -> None:
        self._share, self._longest_s = share, longest_s
        self._begun_s = -math.inf
        self._spent_s = 0.0

    def begin(self, now_s: float) -> None:
        """It begins now, by a clock that only rises."""
        self._begun_s, self._spent_s = now_s, 0.0

    def spend(self, seconds: float) -> None:
        """So long a core was busy with it."""
        self._spent_s += seconds

    def wait_s(self, now_s: float) -> float:
        """How long to wait before the next begins."""
        earned_s = self._begun_s + self._spent_s / self._share
        return min(max(earned_s - now_s, 0.0), self._longest_s)
