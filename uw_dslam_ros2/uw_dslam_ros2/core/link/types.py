"""Settings, counts and memory of a link."""

from __future__ import annotations

from dataclasses import dataclass, field

from uw_dslam_ros2.core.config import Config, setting
from uw_dslam_ros2.core.link.transport.packets import (
    MAX_PACKET_BYTES,
    MAX_SENDERS,
    MIN_PACKET_BYTES,
)

__all__ = ["LinkConfig", "LinkCounts", "LinkState", "OwnState", "ReceivedState"]


@dataclass(frozen=True, slots=True)
class LinkConfig(Config):
    """How a vehicle speaks."""

    number: int = setting(
        1, 0, MAX_SENDERS - 1, "the vehicle's number on the link; no two share one"
    )
    packet_bytes: int = setting(
        64,
        MIN_PACKET_BYTES,
        MAX_PACKET_BYTES,
        "largest packet of the modem [bytes]",
    )
    key: str = setting(
        "", doc="secret of the fleet: packets that were made without it are refused"
    )
    status_s: float = setting(
        10.0,
        0.1,
        3600.0,
        "what has come is told at most this often, but for every sixteen packets [s]",
    )
    heartbeat_s: float = setting(
        60.0, 1.0, 36000.0, "a vehicle that has nothing to say says so this often [s]"
    )
    silent_s: float = setting(
        300.0, 1.0, 1e6, "for a vehicle not heard for so long nothing is repeated [s]"
    )


@dataclass(slots=True)
class LinkCounts:
    """What went over the link so far."""

    sent_packets: dict[str, int] = field(default_factory=dict)
    sent_bytes: dict[str, int] = field(default_factory=dict)
    received_packets: int = 0
    received_bytes: int = 0
    duplicates: int = 0
    repairs: int = 0
    refused: dict[str, int] = field(default_factory=dict)
    """Packets and items that were not taken, by the reason's first words."""

    def count_sent(self, label: str, num_bytes: int) -> None:
        """Note a packet that leaves, by what it holds."""
        self.sent_packets[label] = self.sent_packets.get(label, 0) + 1
        self.sent_bytes[label] = self.sent_bytes.get(label, 0) + num_bytes


@dataclass(frozen=True, slots=True)
class ReceivedState:
    """What has come of one sender."""

    epoch: int
    items: tuple[tuple[int, bytes], ...]
    """Numbers and content."""
    fragments: tuple[tuple[int, int, int, bytes], ...]
    """Of items that are not complete: number, parts needed, index and content of each fragment."""
    life: int | None = None
    """What its reports say beyond the epoch."""


OwnState = tuple[bytes, float, str, int, int, bool]
"""Of an own item: content, rank, label, parts, fragments sent, and whether it is void."""


@dataclass(frozen=True, slots=True)
class LinkState:
    """What must outlive a restart."""

    epoch: int
    own: tuple[OwnState, ...]
    received: dict[int, ReceivedState]
    """Of each sender."""
