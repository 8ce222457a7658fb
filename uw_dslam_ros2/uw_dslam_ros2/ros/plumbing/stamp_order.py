"""Messages of several sensors in the order of their stamps, whatever order they arrive in."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Iterator

__all__ = ["StampOrder"]


class StampOrder[ItemT]:
    """Holds items back until nothing earlier is to be expected.

    Sensors have queues of their own, and an executor empties them in any order. What a mapper
    makes of its input must not depend on that. An item leaves when every stream that is alive has
    come as far; a stream that is `hold_ns` behind the youngest item is not waited for. Of equal
    stamps those leave first whose stream comes first by name: ``dvl``, ``imu``, then the pings.

    Parameters
    ----------
    hold_ns : how long a stream is waited for, in the time of the stamps.
    jump_ns : a stream whose stamps go back by more than this has begun again.
    """

    def __init__(self, hold_ns: int, jump_ns: int) -> None:
        self._hold_ns = hold_ns
        self._jump_ns = jump_ns
        self._ties = itertools.count()
        self.num_late = 0
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._heap: list[tuple[int, str, int, ItemT]] = []
        self._newest_of_stream: dict[str, int] = {}
        self._alive: set[str] = set()
        self._unheard: set[str] = set()
        self._released_ns: int | None = None

    def __len__(self) -> int:
        return len(self._heap)

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the youngest item seen."""
        return max(self._newest_of_stream.values(), default=None)

    def has_jumped_back(self, stream: str, stamp_ns: int) -> bool:
        """Whether this stamp shows that a recording began again."""
        newest_ns = self._newest_of_stream.get(stream)
        if newest_ns is None or stream in self._unheard:
            return False
        return stamp_ns < newest_ns - self._jump_ns

    def expect(self, stream: str, stamp_ns: int) -> None:
        """Wait for a stream that is about to begin as for one that has come so far."""
        if stream not in self._newest_of_stream:
            self._newest_of_stream[stream] = stamp_ns
            self._unheard.add(stream)
            self._alive.add(stream)

    def advance(self, stream: str, stamp_ns: int) -> None:
        """Note that a stream has come so far, without an item."""
        is_first = stream in self._unheard
        newest_ns = 0 if is_first else self._newest_of_stream.get(stream, 0)
        self._newest_of_stream[stream] = max(newest_ns, stamp_ns)
        self._unheard.discard(stream)
        self._alive.add(stream)

    def add(self, stream: str, stamp_ns: int, item: ItemT) -> None:
        """Take an item; one that is earlier than what has left is counted as late."""
        self.advance(stream, stamp_ns)
        if self._released_ns is not None and stamp_ns < self._released_ns:
            self.num_late += 1
        heapq.heappush(self._heap, (stamp_ns, stream, next(self._ties), item))

    def peek(self) -> ItemT | None:
        """The item that may leave next, or None while an earlier one may come."""
        if not self._heap or not self._alive:
            return None
        stamp_ns, _, _, item = self._heap[0]
        return item if stamp_ns <= self._safe_ns() else None

    def _safe_ns(self) -> int:
        """Nothing earlier than this is to be expected."""
        alive_ns = [self._newest_of_stream[stream] for stream in self._alive]
        oldest_ns = max(alive_ns) - self._hold_ns
        return min(stamp_ns for stamp_ns in alive_ns if stamp_ns >= oldest_ns)

    def rest(self) -> Iterator[ItemT]:
        """All that is left, in the order of the stamps; silent streams are waited for no more."""
        self._alive.clear()
        while self._heap:
            yield self.pop()

    def pop(self) -> ItemT:
        """Take out the earliest item."""
        stamp_ns, _, _, item = heapq.heappop(self._heap)
        self._released_ns = max(self._released_ns or stamp_ns, stamp_ns)
        return item
