"""What one end of a link knows and has to say; the packets are in `link`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Self

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.link.coding.answers import decode_answer
from uw_dslam_ros2.core.link.coding.codec import Layer, LayeredSubmap
from uw_dslam_ros2.core.link.coding.items import ItemKind, read_hello, read_item, read_layer
from uw_dslam_ros2.core.link.coding.moves import Move
from uw_dslam_ros2.core.link.heard import Heard
from uw_dslam_ros2.core.link.held import HeldSubmaps
from uw_dslam_ros2.core.link.own import ANSWER_RANK, DECISION_RANK, ECHO_RANK, OwnItems
from uw_dslam_ros2.core.link.types import LinkConfig, LinkCounts, LinkState
from uw_dslam_ros2.core.submap import Submap, SubmapId

__all__ = ["MAX_DECISION_BYTES", "NUM_EPOCHS", "LinkEnd"]

MAX_DECISION_BYTES = 1000
NUM_EPOCHS = 1 << 18
"""Two bits of it are in every packet, the others in reports."""


class LinkEnd:
    """Submaps, answers and decisions in and out; `AcousticLink` is the whole of it."""

    def __init__(self, config: LinkConfig, name: str, epoch: int = 0) -> None:
        self._config, self._key = config, config.key.encode()
        self._name = name
        self._life, self._epoch = divmod(epoch % NUM_EPOCHS, 4)
        self.counts = LinkCounts()
        self._held = HeldSubmaps(config.number, name, self._key)
        self._own = OwnItems(config.number, name, self._key, self._held)
        self._outbox = self._own.outbox
        self._heard = Heard()

    def add_submap(self, submap: Submap) -> list[Submap]:
        """Take a submap of this vehicle; returns it as the others will have it, if it is new."""
        if submap.vehicle_id != self._name:
            raise InvalidInputError(
                f"submap of {submap.vehicle_id!r} on the link of {self._name!r}"
            )
        self._own.add_submap(submap)
        return self._held.improved(self._config.number)

    def own_submap(self, submap_id: SubmapId) -> Submap | None:
        """A submap of this vehicle: as it came or, after a restart, as the others have it."""
        return self._own.submap(submap_id)

    def move_submap(self, submap: Submap) -> list[Submap]:
        """Take a new pose of an own submap, whose cells are as before; as `add_submap`."""
        self._own.move_submap(submap, self._heard.last_s.keys())
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
        if self._heard.has(content):
            return
        # All who have searched have the same to say: one begins, and who hears it need not.
        is_first = all(self._config.number < peer for peer in self._heard.last_s)
        self._own.tell(content, ANSWER_RANK if is_first else ECHO_RANK, "answers")

    def take_answers(self) -> list[bytes]:
        """Answers that have come since the last call."""
        return self._heard.take(ItemKind.ANSWER)

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
        if not self._heard.has(content):
            self._own.tell(content, DECISION_RANK, "decisions")

    def take_decisions(self) -> list[bytes]:
        """Decisions that have come since the last call."""
        return self._heard.take(ItemKind.DECISION)

    def outlines(self) -> dict[tuple[int, int, int], LayeredSubmap]:
        """What is known of all submaps, by sender, run (16 bits) and sequence."""
        return dict(self._held.submaps)

    def name_of(self, sender: int) -> str | None:
        """The vehicle with that number; None while it is not known."""
        return self._held.names.get(sender)

    # --- how it stands -----------------------------------------------------------------------

    def num_open(self, now_s: float) -> int:
        """Own items that somebody lacks, or that were not sent yet."""
        return self._outbox.num_open(self._peers(now_s))

    def num_unconfirmed(self, now_s: float) -> int:
        """Own items of which some vehicle that is heard has not said that it has them."""
        return self._outbox.num_unconfirmed(self._peers(now_s))

    @property
    def num_lacking(self) -> int:
        """Items that others are known to have said and that are not here."""
        return self._heard.num_lacking

    @property
    def is_complete(self) -> bool:
        """Whether all that the others are known to have said is here."""
        return self._heard.is_complete

    @property
    def loss(self) -> float:
        """Share of own packets that do not arrive, by the others' reports."""
        return self._outbox.loss

    def age_s(self, sender: int, now_s: float) -> float | None:
        """Time since a vehicle was heard; None where it never was."""
        heard_s = self._heard.last_s.get(sender)
        return None if heard_s is None else now_s - heard_s

    def _peers(self, now_s: float) -> list[int]:
        return self._heard.peers(now_s, self._config.silent_s)

    # --- items of others ---------------------------------------------------------------------

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
                self._own.rank_cells()
        elif kind is ItemKind.MOVED:
            self._held.take_move(sender, Move.read(body))
        elif kind is ItemKind.ANSWER:
            decode_answer(body.rest)  # else it is refused
            self._heard.tell(kind, body.rest)
            self._outbox.drop(item)
        elif kind is ItemKind.DECISION:
            self._heard.tell(kind, body.rest)
        else:
            raise InvalidInputError(f"an item of kind {kind.name}, expected one to keep")

    def _refuse(self, error: InvalidInputError) -> None:
        reason = " ".join(str(error).split()[:3])
        self.counts.refused[reason] = self.counts.refused.get(reason, 0) + 1

    # --- restarts ----------------------------------------------------------------------------

    def to_state(self) -> LinkState:
        """Everything that was received, and what was said."""
        epoch = 4 * self._life + self._epoch
        return LinkState(epoch, self._own.states(), self._heard.states())

    @classmethod
    def from_state(cls, config: LinkConfig, name: str, state: LinkState) -> Self:
        """Go on; `submaps` gives all that is known, and what the others lack they will say."""
        link = cls(config, name, state.epoch)
        link._own.put_back(state.own)
        for sender, received in state.received.items():
            inbox = link._heard.begin(sender, received.epoch)
            inbox.life = received.life
            for number, item in received.items:
                link._take_item(sender, item)
                link._heard.keep(sender, number, item)
            inbox.put_back(received.fragments)
        return link

    def submaps(self) -> Iterator[Submap]:
        """All submaps that can be drawn, of all vehicles whose names are known."""
        return self._held.drawn()
