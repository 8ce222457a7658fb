"""One vehicle's end of an acoustic link: submaps in, packets out; packets in, submaps out.

Sans-IO: the caller has the modem and the time. Nothing depends on what other clocks say.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.link.coding.answers import decode_answer
from uw_dslam_ros2.core.link.coding.codec import (
    Layer,
    LayeredSubmap,
    encode_submap,
    write_outline,
)
from uw_dslam_ros2.core.link.coding.items import (
    ItemKind,
    LayerKey,
    Status,
    hello_item,
    layer_item,
    read_hello,
    read_item,
    read_layer,
    read_note,
)
from uw_dslam_ros2.core.link.held import HeldSubmaps
from uw_dslam_ros2.core.link.reporting import Reporting, fitted
from uw_dslam_ros2.core.link.transport.inbox import Inbox
from uw_dslam_ros2.core.link.transport.outbox import Outbox, OutItem
from uw_dslam_ros2.core.link.transport.packets import (
    OVERHEAD_BYTES,
    Packet,
    bundled,
    read_framed,
    unbundled,
)
from uw_dslam_ros2.core.link.transport.relay import FIRST_RELAYED, Relays
from uw_dslam_ros2.core.link.types import LinkConfig, LinkCounts, LinkState, ReceivedState
from uw_dslam_ros2.core.submap import Submap, SubmapId

__all__ = ["MAX_DECISION_BYTES", "AcousticLink"]

MAX_DECISION_BYTES = 1000

_OUTLINE_RANK, _CELLS_RANK, _ANSWER_RANK, _MOVED_RANK = 0.0, 1.0, 1.5, 1.8
_ECHO_RANK = 2.5  # of an answer that somebody else is likely to tell
_DECISION_RANK = -1.0  # seldom, and somebody waits to see what comes of it
_LAYER_RANKS = {
    Layer.OUTLINE: _OUTLINE_RANK,
    Layer.COARSE: _CELLS_RANK,
    Layer.FINE: 2.0,
}
"""The lower, the sooner."""


class AcousticLink:
    """A vehicle's end of the link.

    Parameters
    ----------
    config
        Settings.
    name
        The vehicle_id, told to the others.
    epoch
        0 to 3; another one than before, if what was sent before is forgotten.
    """

    def __init__(self, config: LinkConfig, name: str, epoch: int = 0) -> None:
        self._config, self._key = config, config.key.encode()
        self._name, self._epoch = name, epoch % 4
        self.counts = LinkCounts()
        self._outbox = Outbox()
        self._relays = Relays(config.number, config.packet_bytes)
        self._own: dict[LayerKey, OutItem] = {}
        self._sources: dict[tuple[int, int], Submap] = {}
        self._inboxes: dict[int, Inbox] = {}
        self._items: dict[int, dict[int, bytes]] = {}
        self._held = HeldSubmaps(config.number, name, self._key)
        self._heard: dict[ItemKind, list[bytes]] = {}  # answers and decisions
        self._heard_s: dict[int, float] = {}
        self._reporting = Reporting(config)
        self._outbox.add(hello_item(name), _OUTLINE_RANK, "hello")

    # --- own submaps -------------------------------------------------------------------------

    def add_submap(self, submap: Submap) -> list[Submap]:
        """Take a submap of this vehicle; returns it as the others will have it, if it is new."""
        if submap.vehicle_id != self._name:
            raise InvalidInputError(
                f"submap of {submap.vehicle_id!r} on the link of {self._name!r}"
            )
        layers = encode_submap(submap, self._key)
        self._sources[submap.run_id & 0xFFFF, submap.sequence] = submap
        for layer, data in layers.items():
            self._say(LayerKey.of(submap.run_id, submap.sequence, layer), data)
        self._rank_cells()
        return self._held.improved(self._config.number)

    def own_submap(self, submap_id: SubmapId) -> Submap | None:
        """A submap of this vehicle: as it came or, after a restart, as the others have it."""
        key = LayerKey.of(submap_id.run_id, submap_id.sequence, Layer.OUTLINE)
        source, held = self._sources.get((key.run, key.sequence)), self._held.own(key)
        return source or (None if held is None else held.submap(self._name))

    def move_submap(self, submap: Submap) -> list[Submap]:
        """Take a new pose of an own submap, whose cells are as before; as `add_submap`."""
        key = LayerKey.of(submap.run_id, submap.sequence, Layer.OUTLINE)
        held = self._held.own(key)
        if held is None or held.outline is None:
            raise InvalidInputError(f"submap {submap.submap_id} moves before it has come")
        outline = dataclasses.replace(
            held.outline,
            revision=submap.revision,
            is_final=submap.is_final,
            T_odom_submap=submap.T_odom_submap,
            covariance=submap.covariance,
        )
        self._say(key, write_outline(outline, self._key))
        return self._held.improved(self._config.number)

    def add_answer(self, answer: bytes) -> None:
        """Tell the others the answer to a question; see `answers`.

        Raises
        ------
        InvalidInputError
            Where the bytes are no answer.
        """
        decode_answer(answer)
        content = bytes([ItemKind.ANSWER]) + answer
        if self._is_told(content):
            return
        # All who have searched have the same to say: one begins, and who hears it need not.
        is_first = self._config.number < min(self._heard_s, default=self._config.number + 1)
        self._tell(content, _ANSWER_RANK if is_first else _ECHO_RANK, "answers")

    def take_answers(self) -> list[bytes]:
        """Answers that have come since the last call."""
        return self._heard.pop(ItemKind.ANSWER, [])

    def add_decision(self, decision: bytes) -> None:
        """Tell the others what a person decided; the bytes are the caller's business.

        Raises
        ------
        InvalidInputError
            Where they are none, or too many.
        """
        if not 0 < len(decision) <= MAX_DECISION_BYTES:
            raise InvalidInputError(
                f"a decision has {len(decision)} bytes, expected 1 to {MAX_DECISION_BYTES}"
            )
        content = bytes([ItemKind.DECISION]) + decision
        # A manager that begins again tells what it had of others, too.
        if not self._is_told(content):
            self._tell(content, _DECISION_RANK, "decisions")

    def take_decisions(self) -> list[bytes]:
        """Decisions that have come since the last call."""
        return self._heard.pop(ItemKind.DECISION, [])

    def outlines(self) -> dict[tuple[int, int, int], LayeredSubmap]:
        """What is known of all submaps, by sender, run (16 bits) and sequence."""
        return dict(self._held.submaps)

    def name_of(self, sender: int) -> str | None:
        """The vehicle with that number; None while it is not known."""
        return self._held.names.get(sender)

    def _is_told(self, content: bytes) -> bool:
        """Whether somebody else has said it."""
        return any(content in items.values() for items in self._items.values())

    def _tell(self, content: bytes, rank: float, label: str) -> None:
        if all(item.content != content for item in self._outbox.items):
            self._outbox.add(content, rank, label)

    def _say(self, key: LayerKey, data: bytes) -> None:
        item, content = self._own.get(key), layer_item(key, data)
        self._held.take_layer(self._config.number, key, data)
        if item is None:
            added = self._outbox.add(content, _LAYER_RANKS[key.layer], key.layer.name.lower())
            self._own[key] = added
        elif item.content != content:
            self._own[key] = self._outbox.replace(item, content)
            if self._own[key] is not item:  # the others have it where it was: that will do first
                self._own[key].rank = _MOVED_RANK

    def _rank_cells(self) -> None:
        """Own cells that look most like what others have seen go first: they may join."""
        for key, item in self._own.items():
            if key.layer is Layer.COARSE:
                item.rank = _CELLS_RANK + 0.4 / (1.0 + 0.1 * self._held.likeness(key))

    # --- packets out -------------------------------------------------------------------------

    def next_packet(self, now_s: float) -> bytes | None:
        """What to send now; None where there is nothing worth a packet."""
        peers = self._peers(now_s)
        item = self._outbox.next_item(peers)
        notes: list[bytes] = []
        is_due = self._reporting.is_due(
            now_s,
            is_idle=item is None,
            is_complete=self.is_complete,
            is_unheard=self._outbox.is_unheard(peers),
        )
        is_free = item is None and not (is_due and self._reporting.is_turn)
        if is_free and (relayed := self._relayed(peers)) is not None:
            return self._counted("relayed", relayed)
        if is_due:
            notes = [self._report(now_s, peers)]
        while note := self._outbox.take_whole(self._room - len(bundled(notes)), peers):
            notes.append(note)
        if not notes:
            if item is None:
                return None
            packet = self._outbox.cut(
                item, self._config.packet_bytes, self._config.number, self._epoch, self._key
            )
            label = item.label
        else:
            packet = self._bundle(notes)
            label = "mixed"
            if all(note[0] != ItemKind.WHOLE for note in notes):
                label = "status"
            elif len(notes) == 1 and item is not None:
                label = item.label
        return self._counted(label, packet)

    def _relayed(self, peers: list[int]) -> bytes | None:
        """A repair of what somebody else has said, for a turn that would be left empty."""
        epochs = {sender: inbox.epoch for sender, inbox in self._inboxes.items()}
        return self._relays.next_packet(self._items, epochs, peers, self.loss, self._key)

    def _counted(self, label: str, packet: bytes) -> bytes:
        self._reporting.sent(is_report=label == "status")
        self.counts.repairs = self._outbox.num_repairs + self._relays.num_sent
        self.counts.count_sent(label, len(packet))
        return packet

    def num_open(self, now_s: float) -> int:
        """Own items that somebody lacks, or that were not sent yet."""
        return self._outbox.num_open(self._peers(now_s))

    def num_unconfirmed(self, now_s: float) -> int:
        """Own items of which some vehicle that is heard has not said that it has them."""
        return self._outbox.num_unconfirmed(self._peers(now_s))

    @property
    def num_lacking(self) -> int:
        """Items that others are known to have said and that are not here."""
        return sum(inbox.num_lacking for inbox in self._inboxes.values())

    @property
    def is_complete(self) -> bool:
        """Whether all that the others are known to have said is here."""
        return all(inbox.is_complete for inbox in self._inboxes.values())

    @property
    def loss(self) -> float:
        """Share of own packets that do not arrive, by the others' reports."""
        return self._outbox.loss

    def age_s(self, sender: int, now_s: float) -> float | None:
        """Time since a vehicle was heard; None where it never was."""
        heard_s = self._heard_s.get(sender)
        return None if heard_s is None else now_s - heard_s

    def _peers(self, now_s: float) -> list[int]:
        silent_s = self._config.silent_s
        return [peer for peer, heard_s in self._heard_s.items() if now_s - heard_s <= silent_s]

    @property
    def _room(self) -> int:
        return self._config.packet_bytes - OVERHEAD_BYTES

    def _bundle(self, notes: list[bytes]) -> bytes:
        return Packet(self._epoch, self._config.number, 0, 0, 0, bundled(notes)).pack(self._key)

    def _report(self, now_s: float, peers: list[int]) -> bytes:
        """What has come, as a note."""
        self._reporting.told(now_s)
        # Another one first each time: there may not be room for all.
        senders = sorted(self._inboxes)
        first = self._reporting.num_reports % max(1, len(senders))
        reports = {s: self._inboxes[s].report() for s in senders[first:] + senders[:first]}
        status = Status(len(self._outbox.items), self._outbox.voids(peers)[:8], reports)
        return fitted(status, self._room)

    # --- packets in --------------------------------------------------------------------------

    def receive(self, data: bytes, now_s: float) -> list[Submap]:
        """Take a packet; returns submaps of its sender that are new or have changed by it.

        What is damaged, of another version or without the fleet's key is counted and dropped.
        """
        try:
            packet = Packet.unpack(data, self._key)
            is_relayed = packet.num_needed > 0 and packet.index >= FIRST_RELAYED
            if packet.sender == self._config.number and not is_relayed:
                raise InvalidInputError(f"packet of sender {packet.sender}, which is this vehicle")
        except InvalidInputError as error:
            self._refuse(error)
            return []
        self.counts.received_packets += 1
        self.counts.received_bytes += len(data)
        sender = packet.sender
        inbox = self._inboxes.get(sender)
        if is_relayed:
            is_old = inbox is not None and inbox.epoch != packet.epoch
            if is_old or sender == self._config.number:
                return []
        else:
            self._heard_s[sender] = now_s
        if inbox is None or inbox.epoch != packet.epoch:
            inbox = self._inboxes[sender] = Inbox(packet.epoch)
            self._items[sender] = {}
            self._outbox.forget(sender)
        before = inbox.num_duplicates
        try:
            if packet.num_needed == 0:
                for note in unbundled(packet.payload):
                    self._take_note(sender, inbox, note)
            else:
                self._relays.overhear(sender, inbox.whole_number(packet.number))
                self._take_found(sender, inbox, inbox.add(packet))
        except InvalidInputError as error:
            self._refuse(error)
        self.counts.duplicates += inbox.num_duplicates - before
        return self._held.improved(sender)

    def _refuse(self, error: InvalidInputError) -> None:
        reason = " ".join(str(error).split()[:3])
        self.counts.refused[reason] = self.counts.refused.get(reason, 0) + 1

    def _take_note(self, sender: int, inbox: Inbox, note: bytes) -> None:
        said = read_note(note)
        if isinstance(said, bytes):
            self._relays.overhear(sender, read_framed(said)[0])
            self._take_found(sender, inbox, inbox.add_whole(said))
        else:
            inbox.expect(said.num_items, said.voids)
            self._reporting.num_news += not inbox.is_complete  # tell what is lacking
            for other, its_inbox in self._inboxes.items():
                if other != sender and (report := said.of(other, its_inbox.epoch)) is not None:
                    self._relays.hear(other, sender, report)
            if (report := said.of(self._config.number, self._epoch)) is not None:
                self._outbox.hear(sender, report)

    def _take_found(self, sender: int, inbox: Inbox, found: tuple[int, bytes] | None) -> None:
        self._reporting.num_news += 1
        if found is not None:
            number, item = found
            self._take_item(sender, item)
            inbox.finish(number)
            self._items[sender][number] = item

    def _take_item(self, sender: int, item: bytes) -> None:
        kind, body = read_item(item)
        if kind is ItemKind.HELLO:
            name = read_hello(body)
            try:
                self._held.take_name(sender, name)
            except InvalidInputError as error:
                self._refuse(error)  # no damage, so that sending it again would not help
        elif kind is ItemKind.LAYER:
            key, data = read_layer(body)
            self._held.take_layer(sender, key, data)
            if key.layer is Layer.OUTLINE:
                self._rank_cells()
        elif kind is ItemKind.ANSWER:
            decode_answer(body.rest)  # else it is refused
            self._heard.setdefault(kind, []).append(body.rest)
            self._outbox.drop(item)
        elif kind is ItemKind.DECISION:
            self._heard.setdefault(kind, []).append(body.rest)
        else:
            raise InvalidInputError(f"an item of kind {kind.name}, expected one to keep")

    # --- restarts ----------------------------------------------------------------------------

    def to_state(self) -> LinkState:
        """Everything that was received, and what was said."""
        return LinkState(
            self._epoch,
            tuple(
                (i.content, i.rank, i.label, i.parts, i.num_sent, i.is_void)
                for i in self._outbox.items
            ),
            {
                sender: ReceivedState(
                    inbox.epoch, tuple(sorted(self._items[sender].items())), inbox.fragments()
                )
                for sender, inbox in self._inboxes.items()
            },
        )

    @classmethod
    def from_state(cls, config: LinkConfig, name: str, state: LinkState) -> AcousticLink:
        """Go on; `submaps` gives all that is known, and what the others lack they will say."""
        link = cls(config, name, state.epoch)
        link._outbox.items.clear()
        for content, rank, label, parts, num_sent, is_void in state.own:
            item = link._outbox.add(content, rank, label)
            item.parts, item.num_sent, item.is_void = parts, num_sent, is_void
            kind, body = read_item(content)
            if kind is ItemKind.LAYER:
                key, data = read_layer(body)
                link._own[key] = item
                link._held.take_layer(config.number, key, data)
        for sender, received in state.received.items():
            inbox = link._inboxes[sender] = Inbox(received.epoch)
            link._items[sender] = dict(received.items)
            for number, item_content in received.items:
                link._take_item(sender, item_content)
                inbox.finish(number)
            inbox.put_back(received.fragments)
        return link

    def submaps(self) -> Iterator[Submap]:
        """All submaps that can be drawn, of all vehicles whose names are known."""
        return self._held.drawn()
