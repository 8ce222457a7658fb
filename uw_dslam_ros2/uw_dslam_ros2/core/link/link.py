"""One vehicle's end of an acoustic link: submaps in, packets out; packets in, submaps out.

Sans-IO: the caller has the modem and the time. Nothing depends on what other clocks say.
"""

from __future__ import annotations

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.link.coding.items import ItemKind, Status, read_note
from uw_dslam_ros2.core.link.end import MAX_DECISION_BYTES, NUM_EPOCHS, LinkEnd
from uw_dslam_ros2.core.link.reporting import Reporting, fitted
from uw_dslam_ros2.core.link.transport.inbox import Inbox
from uw_dslam_ros2.core.link.transport.packets import (
    OVERHEAD_BYTES,
    Packet,
    bundled,
    read_framed,
    unbundled,
)
from uw_dslam_ros2.core.link.transport.relay import Relays
from uw_dslam_ros2.core.link.types import LinkConfig
from uw_dslam_ros2.core.submap import Submap

__all__ = ["MAX_DECISION_BYTES", "NUM_EPOCHS", "AcousticLink"]


class AcousticLink(LinkEnd):
    """A vehicle's end of the link.

    Parameters
    ----------
    config
        Settings.
    name
        The vehicle_id, told to the others.
    epoch
        0 to `NUM_EPOCHS` - 1; another one than before, if what was sent before is forgotten.
    """

    def __init__(self, config: LinkConfig, name: str, epoch: int = 0) -> None:
        super().__init__(config, name, epoch)
        self._relays = Relays(config.number, config.packet_bytes)
        self._reporting = Reporting(config)

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
        items, lives = self._heard.items, self._heard.lives()
        return self._relays.next_packet(items, lives, peers, self.loss, self._key)

    def _counted(self, label: str, packet: bytes) -> bytes:
        self._reporting.sent(is_report=label == "status")
        self.counts.repairs = self._outbox.num_repairs + self._relays.num_sent
        self.counts.count_sent(label, len(packet))
        return packet

    @property
    def _room(self) -> int:
        return self._config.packet_bytes - OVERHEAD_BYTES

    def _bundle(self, notes: list[bytes]) -> bytes:
        return Packet(self._epoch, self._config.number, 0, 0, 0, bundled(notes)).pack(self._key)

    def _report(self, now_s: float, peers: list[int]) -> bytes:
        """What has come, as a note."""
        self._reporting.told(now_s)
        reports = self._heard.reports(self._reporting.num_reports)
        voids = self._outbox.voids(peers)[:8]
        status = Status(len(self._outbox.items), voids, reports, life=self._life)
        return fitted(status, self._room)

    # --- packets in --------------------------------------------------------------------------

    def receive(self, data: bytes, now_s: float) -> list[Submap]:
        """Take a packet; returns submaps of its sender that are new or have changed by it.

        What is damaged, of another version or without the fleet's key is counted and dropped.
        """
        try:
            packet = Packet.unpack(data, self._key)
            if packet.sender == self._config.number:
                if packet.is_relayed and (packet.epoch, packet.life) == (self._epoch, self._life):
                    return []
                raise InvalidInputError(f"packet of sender {packet.sender}, which is this vehicle")
            if packet.is_relayed:
                self._heard.check_relayed(packet)
        except InvalidInputError as error:
            self._refuse(error)
            return []
        self.counts.received_packets += 1
        self.counts.received_bytes += len(data)
        sender = packet.sender
        inbox = self._heard.inboxes.get(sender)
        if not packet.is_relayed:
            self._heard.last_s[sender] = now_s
        if inbox is None or inbox.epoch != packet.epoch:
            inbox = self._begun(sender, packet.epoch)
        before = inbox.num_duplicates
        try:
            if packet.num_needed == 0:
                for note in unbundled(packet.payload):
                    self._take_note(sender, note)
            else:
                self._relays.overhear(sender, inbox.whole_number(packet.number))
                self._take_found(sender, inbox.add(packet))
        except InvalidInputError as error:
            self._refuse(error)
        self.counts.duplicates += inbox.num_duplicates - before
        return self._held.improved(sender)

    def _begun(self, sender: int, epoch: int) -> Inbox:
        """The inbox of a sender that has nothing of before, and knows nothing of what came."""
        self._outbox.forget(sender)
        return self._heard.begin(sender, epoch)

    def _take_note(self, sender: int, note: bytes) -> None:
        said, inbox = read_note(note), self._heard.inboxes[sender]
        if isinstance(said, bytes):
            self._relays.overhear(sender, read_framed(said)[0])
            self._take_found(sender, inbox.add_whole(said))
        else:
            if inbox.life not in (None, said.life):  # it began anew, by chance with that epoch
                inbox = self._begun(sender, inbox.epoch)
            inbox.life = said.life
            inbox.expect(said.num_items, said.voids)
            self._reporting.num_news += not inbox.is_complete  # tell what is lacking
            for other, its_inbox in self._heard.inboxes.items():
                if other != sender and (report := said.of(other, its_inbox.epoch)) is not None:
                    self._relays.hear(other, sender, report)
            if (report := said.of(self._config.number, self._epoch)) is not None:
                self._outbox.hear(sender, report)

    def _take_found(self, sender: int, found: tuple[int, bytes] | None) -> None:
        self._reporting.num_news += 1
        if found is not None:
            number, item = found
            self._take_item(sender, item)
            self._heard.keep(sender, number, item)
