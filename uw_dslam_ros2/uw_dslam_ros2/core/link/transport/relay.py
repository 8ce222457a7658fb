"""Repairs of what others have said, where it is here and a third vehicle lacks it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from uw_dslam_ros2.core.link.coding.items import PeerReport
from uw_dslam_ros2.core.link.transport.erasure import MAX_INDEX
from uw_dslam_ros2.core.link.transport.packets import (
    FIRST_RELAYED,
    Packet,
    framed,
    num_parts,
    part_of,
)

__all__ = ["LOSS_LIMIT", "Relays", "num_repairs"]

LOSS_LIMIT = 0.6
"""Beyond that, more repair in advance only crowds the others out."""
_APART = 11  # between the first indices of two neighbouring vehicles

Place = tuple[int, int]
"""Of an item: sender and number."""


def num_repairs(lacking: int, loss: float) -> int:
    """How many fragments go out so that those that are lacking arrive, by the share of losses."""
    return math.floor(lacking / (1.0 - min(loss, LOSS_LIMIT)) + 0.5)


@dataclass(frozen=True, slots=True, eq=False)
class _Heard:
    """What a peer has of a sender's items, and how many fragments of each had gone by then."""

    report: PeerReport
    marks: Mapping[int, int]


class Relays:
    """Who lacks what of whom; only turns that are left empty go to it.

    Parameters
    ----------
    number
        Of this vehicle.
    max_bytes
        Of the fleet's packets.
    """

    def __init__(self, number: int, max_bytes: int) -> None:
        self.num_sent = 0
        self._number, self._max_bytes = number, max_bytes
        self._heard: dict[Place, _Heard] = {}  # by sender and peer
        self._gone: Counter[Place] = Counter()  # fragments that were heard or sent
        self._sent: Counter[Place] = Counter()  # of these the own ones

    def hear(self, sender: int, peer: int, report: PeerReport) -> None:
        """Learn what a peer has of a sender's items."""
        marks = {item[1]: num for item, num in self._gone.items() if item[0] == sender}
        self._heard[sender, peer] = _Heard(report, marks)

    def overhear(self, sender: int, number: int) -> None:
        """Note a fragment of an item, whoever sent it: who lacks the item may have got it."""
        self._gone[sender, number] += 1

    def next_packet(
        self,
        items: Mapping[int, Mapping[int, bytes]],
        lives: Mapping[int, tuple[int, int]],
        peers: Iterable[int],
        loss: float,
        key: bytes,
    ) -> bytes | None:
        """The fragment that brings somebody nearest to an item, as a packet of its sender.

        Parameters
        ----------
        items
            All that is here, by sender and number.
        lives
            Epoch of each sender and what it has drawn beyond; nothing of others is relayed.
        peers
            Who listens.
        loss
            Share of packets that get lost.
        key
            Of the fleet's checksums.
        """
        known = set(peers)
        best: tuple[tuple[int, int, int], bytes] | None = None
        for (sender, peer), heard in sorted(self._heard.items()):
            if peer not in known or sender not in lives:
                continue
            if heard.report.epoch != lives[sender][0]:
                continue
            for number, content in items.get(sender, {}).items():
                if number < heard.report.base:
                    continue
                data = framed(number, content)
                parts = num_parts(len(data), self._max_bytes)
                lacking = heard.report.lacking_of(number, parts) or 0
                left = num_repairs(lacking, loss) - self._since((sender, number), heard)
                order = (left, number, sender)
                if left > 0 and (best is None or order < best[0]):
                    best = order, data
        if best is None:
            return None
        (_, number, sender), data = best
        return self._cut((sender, number), data, lives[sender], key)

    def _since(self, item: Place, heard: _Heard) -> int:
        return self._gone[item] - heard.marks.get(item[1], 0)

    def _cut(self, item: Place, data: bytes, life: tuple[int, int], key: bytes) -> bytes:
        parts = num_parts(len(data), self._max_bytes)
        first = _APART * self._number + self._sent[item]
        index = FIRST_RELAYED + first % (MAX_INDEX + 1 - FIRST_RELAYED)
        payload = part_of(data, parts, index)
        self._gone[item] += 1
        self._sent[item] += 1
        self.num_sent += 1
        return Packet(life[0], item[0], item[1], parts, index, payload, life[1]).pack(key)
