"""What a vehicle has to say, and what of it is worth the next packet."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field

from uw_dslam_ros2.core.link.coding.items import PeerReport, whole_note
from uw_dslam_ros2.core.link.transport.packets import (
    FIRST_RELAYED,
    Packet,
    bundled,
    framed,
    num_parts,
    part_of,
)
from uw_dslam_ros2.core.link.transport.relay import LOSS_LIMIT, num_repairs

__all__ = ["OutItem", "Outbox"]

_LOSS_MEMORY = 0.8
_SPARE, _SPARE_LOSS = 1, 0.1  # repairs more, where turns would be left empty and packets get lost
_LOSS_DOUBT = 5.0  # packets that are taken to have arrived before any report
_MOST_TIMES = 12  # an item that was sent so often and not taken is refused there, not lost


@dataclass(slots=True)
class OutItem:
    """One item of the log. The lower its rank, the sooner it goes."""

    number: int
    content: bytes
    rank: float
    label: str  # for the count of bytes
    is_void: bool = False
    parts: int = 0  # fragments that make it; 0: not cut yet
    num_sent: int = 0
    # Of each peer: fragments lacking, and how many had been sent when it said so.
    peers: dict[int, tuple[int, int]] = field(default_factory=dict)


class Outbox:
    """All items of a vehicle by number, and what each peer lacks of them."""

    def __init__(self) -> None:
        self.items: list[OutItem] = []
        self.num_repairs = 0
        self._judged = self._lost = 0.0

    def add(self, content: bytes, rank: float, label: str) -> OutItem:
        """Append an item."""
        item = OutItem(len(self.items), content, rank, label)
        self.items.append(item)
        return item

    def replace(self, item: OutItem, content: bytes) -> OutItem:
        """Say something else instead: in its place where nothing of it was sent yet."""
        if item.num_sent == 0:
            item.content, item.parts = content, 0
            return item
        item.is_void = True
        return self.add(content, item.rank, item.label)

    def drop(self, content: bytes) -> None:
        """What nothing was sent of yet need not be said: somebody else has."""
        for item in self.items:
            if item.num_sent == 0 and item.content == content:
                item.is_void = True

    def hear(self, peer: int, report: PeerReport) -> None:
        """Learn what a peer has."""
        expected = arrived = 0
        for item in self.items:
            lacking = report.lacking_of(item.number, item.parts)
            if item.num_sent == 0 or lacking is None:
                continue
            before, mark = item.peers.get(peer, (item.parts, 0))
            expected += min(item.num_sent - mark, before)
            arrived += min(item.num_sent - mark, before - lacking)
            item.peers[peer] = (lacking, item.num_sent)
        self._judged = _LOSS_MEMORY * self._judged + expected
        self._lost = _LOSS_MEMORY * self._lost + max(0, expected - arrived)

    @property
    def loss(self) -> float:
        """Share of packets that do not arrive, as the peers' reports say."""
        return self._lost / (self._judged + _LOSS_DOUBT)

    def forget(self, peer: int) -> None:
        """A peer has begun anew and has nothing."""
        for item in self.items:
            item.peers.pop(peer, None)

    def is_unheard(self, peers: Iterable[int]) -> bool:
        """Whether some peer has not confirmed all that was sent."""
        known = list(peers)
        return any(
            item.num_sent > 0 and not item.is_void and item.peers.get(peer, (1, 0))[0] > 0
            for item in self.items
            for peer in known
        )

    def voids(self, peers: Iterable[int]) -> tuple[int, ...]:
        """Items that somebody still lacks and need not get."""
        known = list(peers)
        return tuple(
            item.number
            for item in self.items
            if item.is_void and any(item.peers.get(p, (1, 0))[0] for p in known)
        )

    def next_item(self, peers: Iterable[int]) -> OutItem | None:
        """The item of which a fragment should go next, or None.

        Each goes out once, with as many sums as a listener is likely to need by the loss so far;
        what of it is sent afterwards is what some peer has said that it lacks. Turns that would be
        left empty carry one more of that, where packets get lost.
        """
        known = list(peers)
        for spare in (0, _SPARE):
            best: tuple[tuple[float, bool, float, int], OutItem] | None = None
            for item in self.items:
                left = self._left(item, known, spare)
                if left <= 0:
                    continue
                # Others may repair what one has; then what is complete sooner, then the older.
                is_held = any(item.peers.get(peer, (1, 0))[0] == 0 for peer in known)
                order = (item.rank, is_held, left / max(1, item.parts), item.number)
                if best is None or order < best[0]:
                    best = order, item
            if best is not None:
                return best[1]
        return None

    def cut(self, item: OutItem, max_bytes: int, sender: int, epoch: int, key: bytes) -> bytes:
        """The next fragment of an item, as a packet."""
        data = framed(item.number, item.content)
        item.parts = item.parts or num_parts(len(data), max_bytes)
        self.num_repairs += item.num_sent >= item.parts
        # Nobody gets the same again before all sums have been sent.
        index = item.num_sent % FIRST_RELAYED
        payload = part_of(data, item.parts, index)
        item.num_sent += 1
        return Packet(epoch, sender, item.number, item.parts, index, payload).pack(key)

    def take_whole(self, room: int, peers: Iterable[int]) -> bytes | None:
        """The next item as a note, if it fits whole into so many bytes."""
        item = self.next_item(peers)
        if item is None or item.parts > 1:
            return None
        note = whole_note(framed(item.number, item.content))
        if len(bundled([note])) > room:
            return None
        self.num_repairs += item.num_sent > 0
        item.parts, item.num_sent = 1, item.num_sent + 1
        return note

    def num_open(self, peers: Iterable[int]) -> int:
        """Items of which something is left to send."""
        known = list(peers)
        return sum(self._left(item, known) > 0 for item in self.items)

    @staticmethod
    def is_confirmed(item: OutItem, peers: Collection[int]) -> bool:
        """Whether these peers, of whom there is one at least, have said that they have an item."""
        return bool(peers) and all(item.peers.get(peer, (1, 0))[0] == 0 for peer in peers)

    def num_unconfirmed(self, peers: Iterable[int]) -> int:
        """Items of which some peer has not said that it has them."""
        known = list(peers)
        return sum(
            bool(known) and not item.is_void and not self.is_confirmed(item, known)
            for item in self.items
        )

    def _left(self, item: OutItem, peers: list[int], spare: int = 0) -> int:
        if item.is_void:
            return 0
        if item.num_sent == 0:
            return max(1, item.parts)
        if item.num_sent >= _MOST_TIMES * item.parts:
            return 0
        left = item.parts - item.num_sent  # the first time, whoever hears it
        for peer in peers:
            heard = item.peers.get(peer)
            if heard is None or heard[1] == 0:
                # It has said nothing of it yet: as many as it is likely to need.
                likely = math.floor(item.parts / (1.0 - min(self.loss, LOSS_LIMIT)))
                left = max(left, likely - item.num_sent)
                continue
            lacking, mark = heard
            if lacking:
                wanted = num_repairs(lacking, self.loss)
                if self.loss > _SPARE_LOSS:
                    wanted += spare
                left = max(left, wanted - (item.num_sent - mark))
        return left
