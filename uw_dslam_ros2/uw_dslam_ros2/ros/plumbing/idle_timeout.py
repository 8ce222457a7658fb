"""When submaps have stopped coming, by how often they came so far."""

from __future__ import annotations

from collections import deque

__all__ = ["IdleTimeout"]

_LEAST_S, _MOST_S = 3.0, 120.0
_NUM_GAPS = 12


class IdleTimeout:
    """Says when the vehicles have come to rest; times are those of a steady clock.

    Parameters
    ----------
    quiet_s : without an arrival for this long nothing more is expected; 0: for twice as long as
        the longest time between two of the last ones, 3 s to 120 s.
    """

    def __init__(self, quiet_s: float) -> None:
        self._quiet_s = quiet_s
        self._gaps_s: deque[float] = deque(maxlen=_NUM_GAPS)
        self._last_s: float | None = None
        self._is_ended = True

    def set_quiet(self, quiet_s: float) -> None:
        """As at the beginning, from now on."""
        self._quiet_s = quiet_s

    def note(self, now_s: float) -> None:
        """Something came."""
        if self._last_s is not None:
            self._gaps_s.append(now_s - self._last_s)
        self._last_s = now_s
        self._is_ended = False

    def end(self) -> None:
        """Somebody says that nothing more is expected."""
        self._is_ended = True

    def is_active(self, now_s: float) -> bool:
        """Whether more is expected."""
        if self._is_ended or self._last_s is None:
            return False
        return now_s - self._last_s < self._patience_s()

    def _patience_s(self) -> float:
        if self._quiet_s > 0.0:
            return self._quiet_s
        return min(max(2.0 * max(self._gaps_s, default=0.0), _LEAST_S), _MOST_S)
