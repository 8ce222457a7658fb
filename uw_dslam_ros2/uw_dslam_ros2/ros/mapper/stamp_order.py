"""Messages of several sensors in the order of their stamps, whatever order they arrive in."""

from __future__ import annotations

import heapq
import itertools
from collections import deque
from collections.abc import Iterator

__all__ = ["StampOrder"]

_NEVER_NS = 1 << 62
_BELIEVE_NS = 2_000_000_000
_MAX_ASIDE = 20_000
"""Items put aside in a stream: more than half a minute of a fast IMU."""


class StampOrder[ItemT]:
    """Holds items back until nothing earlier is to be expected.

    Sensors have queues of their own, and an executor empties them in any order. What a mapper
    makes of its input must not depend on that. An item leaves when every stream that is alive has
    come as far; a stream that is `hold_ns` behind the youngest item is not waited for. Of equal
    stamps those leave first whose stream comes first by name: ``dvl``, ``imu``, then the pings.

    What lies far back in its own stream, or far ahead of all, is put aside: it is late or wrong if
    any stream goes on in the old time, and shows a clock that was set if all follow it.

    Parameters
    ----------
    hold_ns : how long a stream is waited for, in the time of the stamps.
    back_ns : an item that lies further back in its stream is put aside.
    ahead_ns : an item that lies further ahead of the youngest of all is put aside.
    believe_ns : a jump that has lasted for so long is one, if all streams have made it; for those
        that have not it is waited for `hold_ns` longer.
    """

    def __init__(
        self,
        hold_ns: int,
        back_ns: int = _NEVER_NS,
        ahead_ns: int = _NEVER_NS,
        believe_ns: int = _BELIEVE_NS,
    ) -> None:
        self._hold_ns = hold_ns
        self._back_ns, self._ahead_ns = back_ns, ahead_ns
        self._believe_ns = believe_ns
        self._ties = itertools.count()
        self.num_late = 0
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._aside: dict[str, deque[tuple[int, ItemT | None]]] = {}
        self._aside_since_ns: dict[str, int] = {}
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

    def offer(self, stream: str, stamp_ns: int, item: ItemT | None) -> bool:
        """Take an item (None only says how far its stream has come).

        True where a clock was set, by now beyond doubt: then what `rest` gives is of the old time,
        and `begin_anew` goes on with the new one.
        """
        if self._is_displaced(stream, stamp_ns):
            aside = self._aside.setdefault(stream, deque())
            aside.append((stamp_ns, item))
            if len(aside) > _MAX_ASIDE:
                aside.popleft()
                self.num_late += 1
            lasted_ns = stamp_ns - self._aside_since_ns.setdefault(stream, stamp_ns)
            # The others follow, or are not heard of any more: queues are emptied in any order.
            have_followed = self._alive <= self._aside.keys()
            wait_ns = 0 if have_followed else self._hold_ns
            return lasted_ns >= self._believe_ns + wait_ns
        # The old time goes on: what is aside of this stream came late, and another stream's jump
        # would have to last anew.
        self.num_late += len(self._aside.pop(stream, ()))
        self._aside_since_ns.clear()
        if item is None:
            self.advance(stream, stamp_ns)
        else:
            self.add(stream, stamp_ns, item)
        return False

    def begin_anew(self) -> None:
        """Forget the old time; what was put aside is the beginning of the new one."""
        aside, known = self._aside, sorted(self._newest_of_stream)
        first_ns = min(stamp_ns for items in aside.values() for stamp_ns, _ in items)
        self.clear()
        for stream in known:
            self.expect(stream, first_ns - 1)  # the others follow, but may not have done so yet
        for stream, items in aside.items():
            for stamp_ns, item in items:
                self.offer(stream, stamp_ns, item)

    @property
    def displaced(self) -> dict[str, int]:
        """How many items are put aside, by stream: of those whose clock alone was set, many."""
        return {stream: len(items) for stream, items in self._aside.items()}

    def _is_displaced(self, stream: str, stamp_ns: int) -> bool:
        newest_ns = self.newest_ns
        if newest_ns is None or self._unheard >= self._newest_of_stream.keys():
            return False
        own_ns = self._newest_of_stream.get(stream)
        is_back = own_ns is not None and stream not in self._unheard
        if is_back and own_ns is not None and stamp_ns < own_ns - self._back_ns:
            return True
        return stamp_ns > newest_ns + self._ahead_ns

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
