"""What has come of each sender: fragments to items, every item once, in any order."""

from __future__ import annotations

from dataclasses import dataclass, field

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.link.coding.items import PeerReport
from uw_dslam_ros2.core.link.transport.erasure import restore
from uw_dslam_ros2.core.link.transport.packets import NUM_NUMBERS, Packet, read_framed

__all__ = ["Inbox"]

_MAX_REPORTED = 24
_MAX_AHEAD = 4 * NUM_NUMBERS
_MAX_OPEN = 64  # items of which only some fragments have come


@dataclass(slots=True)
class _Open:
    num_needed: int
    fragments: dict[int, bytes] = field(default_factory=dict)


class Inbox:
    """Of one sender, while its epoch lasts."""

    def __init__(self, epoch: int) -> None:
        self.epoch = epoch
        self.life: int | None = None
        """What the sender's reports say beyond the epoch; None until one has come."""
        self.num_duplicates = 0
        self._base = 0  # all items below are here
        self._done: set[int] = set()  # of those from there on
        self._open: dict[int, _Open] = {}
        self._num_items = 0  # that there are, as far as is known

    @property
    def is_complete(self) -> bool:
        """Whether nothing is known that has not come."""
        return self._base >= self._num_items and not self._open

    @property
    def num_lacking(self) -> int:
        """Items that are known of and have not come."""
        return self._num_items - self._base - len(self._done)

    def has(self, number: int) -> bool:
        """Whether an item has come."""
        return number < self._base or number in self._done

    def expect(self, num_items: int, voids: tuple[int, ...]) -> None:
        """Hear how many items there are, and which of them need not come any more."""
        if num_items > self._base + _MAX_AHEAD:
            raise InvalidInputError(
                f"the sender claims {num_items} items after {self._base}, "
                f"expected at most {_MAX_AHEAD} more"
            )
        self._num_items = max(self._num_items, num_items)
        for number in voids:
            if number < self._num_items:
                self.finish(number)

    def add(self, packet: Packet) -> tuple[int, bytes] | None:
        """Take a fragment; the item's number and content if it completes one that is new.

        The caller checks the content and calls `finish` if it is sound; else it will be sent
        again. Raises `InvalidInputError` where the fragments do not make an item.
        """
        number = self.whole_number(packet.number)
        if self.has(number):
            self.num_duplicates += 1
            return None
        held = self._open.get(number)
        if held is None or held.num_needed != packet.num_needed:
            if len(self._open) >= _MAX_OPEN:
                del self._open[min(self._open)]
            held = self._open[number] = _Open(packet.num_needed)
        elif len(packet.payload) != len(next(iter(held.fragments.values()))):
            del self._open[number]
            raise InvalidInputError(
                f"fragment {packet.index} of item {number} has {len(packet.payload)} bytes, "
                "expected as many as those before it"
            )
        if packet.index in held.fragments:
            self.num_duplicates += 1
            return None
        held.fragments[packet.index] = packet.payload
        self._num_items = max(self._num_items, number + 1)
        if len(held.fragments) < held.num_needed:
            return None
        del self._open[number]
        data = restore(held.fragments, held.num_needed)
        if read_framed(data)[0] % NUM_NUMBERS != packet.number:
            raise InvalidInputError(f"item {read_framed(data)[0]} came as number {packet.number}")
        return self.add_whole(data)

    def add_whole(self, data: bytes) -> tuple[int, bytes] | None:
        """Take a framed item; as `add`."""
        number, item = read_framed(data)
        if number > self._base + _MAX_AHEAD:
            raise InvalidInputError(f"item {number} came after {self._base}")
        if self.has(number):
            self.num_duplicates += 1
            return None
        return number, item

    def finish(self, number: int) -> None:
        """Note that an item is here, or not needed."""
        if self.has(number):
            return
        self._open.pop(number, None)
        self._done.add(number)
        self._num_items = max(self._num_items, number + 1)
        while self._base in self._done:
            self._done.discard(self._base)
            self._base += 1

    def fragments(self) -> tuple[tuple[int, int, int, bytes], ...]:
        """Of items that are not complete: number, parts needed, index and content of each."""
        return tuple(
            (number, held.num_needed, index, payload)
            for number, held in sorted(self._open.items())
            for index, payload in sorted(held.fragments.items())
        )

    def put_back(self, fragments: tuple[tuple[int, int, int, bytes], ...]) -> None:
        """Undo `fragments`."""
        for number, num_needed, index, payload in fragments:
            self._open.setdefault(number, _Open(num_needed)).fragments[index] = payload
            self._num_items = max(self._num_items, number + 1)

    def report(self) -> PeerReport:
        """What to tell the sender."""
        last = min(self._num_items, self._base + _MAX_REPORTED)
        lacking = [self._lacking(number) for number in range(self._base, last)]
        while lacking and lacking[-1] is None and last == self._num_items:
            lacking.pop()
        return PeerReport(self.epoch, self._base, tuple(lacking), last < self._num_items)

    def _lacking(self, number: int) -> int | None:
        if number in self._done:
            return 0
        held = self._open.get(number)
        return None if held is None else held.num_needed - len(held.fragments)

    def whole_number(self, short: int) -> int:
        """The whole number that a packet means: one that is missing, near the newest known."""
        newest = max(self._num_items - 1, 0)
        near = newest - (newest - short + NUM_NUMBERS // 2) % NUM_NUMBERS + NUM_NUMBERS // 2
        choices = [near - k * NUM_NUMBERS for k in range(near // NUM_NUMBERS + 1)]
        for number in choices:
            if number >= 0 and not self.has(number):
                return number
        return max(near, short)
