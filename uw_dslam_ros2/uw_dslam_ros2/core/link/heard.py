"""What has come of the other vehicles: items by sender, and when each was heard."""

from __future__ import annotations

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.link.coding.items import ItemKind, PeerReport
from uw_dslam_ros2.core.link.transport.inbox import Inbox
from uw_dslam_ros2.core.link.transport.packets import Packet
from uw_dslam_ros2.core.link.types import ReceivedState

__all__ = ["Heard"]


class Heard:
    """All senders, each while its epoch lasts."""

    def __init__(self) -> None:
        self.inboxes: dict[int, Inbox] = {}
        self.items: dict[int, dict[int, bytes]] = {}
        """All that is here, by sender and number."""
        self.last_s: dict[int, float] = {}
        self._told: dict[ItemKind, list[bytes]] = {}  # answers and decisions
        self._rumours: dict[int, tuple[int, int]] = {}  # lives that one relayed packet has named

    def begin(self, sender: int, epoch: int) -> Inbox:
        """Forget a sender, which has begun anew."""
        self.items[sender] = {}
        self.inboxes[sender] = inbox = Inbox(epoch)
        return inbox

    def keep(self, sender: int, number: int, item: bytes) -> None:
        """Have an item."""
        self.inboxes[sender].finish(number)
        self.items[sender][number] = item

    def has(self, content: bytes) -> bool:
        """Whether somebody has said it."""
        return any(content in items.values() for items in self.items.values())

    def tell(self, kind: ItemKind, content: bytes) -> None:
        """Keep what managers wait for, until `take`."""
        self._told.setdefault(kind, []).append(content)

    def take(self, kind: ItemKind) -> list[bytes]:
        """What has come of a kind since the last call."""
        return self._told.pop(kind, [])

    @property
    def is_complete(self) -> bool:
        """Whether all that the senders are known to have said is here."""
        return all(inbox.is_complete for inbox in self.inboxes.values())

    @property
    def num_lacking(self) -> int:
        """Items that they are known to have said and that are not here."""
        return sum(inbox.num_lacking for inbox in self.inboxes.values())

    def lives(self) -> dict[int, tuple[int, int]]:
        """Epoch of each sender and what it has drawn beyond, where that is known."""
        return {
            sender: (inbox.epoch, inbox.life)
            for sender, inbox in self.inboxes.items()
            if inbox.life is not None
        }

    def check_relayed(self, packet: Packet) -> None:
        """Refuse a relayed packet that is damaged, or older than what its sender says now.

        As long as no report has told what the sender has drawn, two of them must agree on it.
        """
        sender, life = packet.sender, (packet.epoch, packet.life)
        inbox = self.inboxes.get(sender)
        if inbox is not None and (inbox.life is not None or inbox.epoch != packet.epoch):
            if life != (inbox.epoch, inbox.life):
                raise InvalidInputError(f"a relayed packet of {sender} is damaged or of old")
        elif self._rumours.get(sender) != life:
            self._rumours[sender] = life
            raise InvalidInputError(f"a relayed packet of {sender} is the first of that life")
        else:
            (inbox or self.begin(sender, packet.epoch)).life = packet.life

    def reports(self, turn: int) -> dict[int, PeerReport]:
        """What has come of each; another one first each turn, as there may not be room for all."""
        senders = sorted(self.inboxes)
        first = turn % max(1, len(senders))
        return {s: self.inboxes[s].report() for s in senders[first:] + senders[:first]}

    def peers(self, now_s: float, silent_s: float) -> list[int]:
        """Who was heard lately."""
        return [peer for peer, heard_s in self.last_s.items() if now_s - heard_s <= silent_s]

    def states(self) -> dict[int, ReceivedState]:
        """What must outlive a restart."""
        return {
            sender: ReceivedState(
                inbox.epoch,
                tuple(sorted(self.items[sender].items())),
                inbox.fragments(),
                inbox.life,
            )
            for sender, inbox in self.inboxes.items()
        }
