"""Work that is done again and again, but never for more than a share of the time."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator

__all__ = ["Throttle"]

_SHARE = 0.1  # of the time that the work may take


class Throttle:
    """Says when costly work is due: ``period_s`` after it was begun last, later if it is slow.

    By a steady clock, since a replay may be faster than time. How long the first turn takes says
    nothing of the next ones: code is loaded in it.
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._due_s = float("-inf")
        self._is_first = True

    def is_due(self) -> bool:
        """Whether to do it now."""
        return time.monotonic() >= self._due_s

    @contextlib.contextmanager
    def turn(self) -> Iterator[None]:
        """Around the work."""
        begun_s = time.monotonic()
        yield
        ended_s = time.monotonic()
        rest_s = 0.0 if self._is_first else (ended_s - begun_s) / _SHARE
        self._is_first = False
        self._due_s = max(begun_s + self._period_s, ended_s + rest_s)
