"""What a modem carries: packets of 32 bytes to 2 kB, six of which are overhead.

A packet holds one fragment of a numbered item, or a bundle of short notes that are not worth
repeating. Layout, in bits: version 2, epoch 2, sender 5, number 10, parts needed 6 (0: a bundle),
index 7; then the payload; then 16 bits of checksum.

Fragments from index 96 on come from others than who said the item. Their checksum is the exclusive
or with the 16 bits that the sender has drawn when it began with nothing: so whoever knows these
tells old from new.
"""

from __future__ import annotations

from dataclasses import dataclass

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.link.coding.fields import ByteReader, ByteWriter, digest_of
from uw_dslam_ros2.core.link.transport.erasure import MAX_NEEDED, fragment

__all__ = [
    "FIRST_RELAYED",
    "MAX_PACKET_BYTES",
    "MAX_SENDERS",
    "MIN_PACKET_BYTES",
    "NUM_NUMBERS",
    "OVERHEAD_BYTES",
    "PACKET_VERSION",
    "Packet",
    "bundled",
    "framed",
    "num_parts",
    "part_of",
    "read_framed",
    "unbundled",
]

PACKET_VERSION = 0
"""Of two bits: what came before 0 was 3."""
OVERHEAD_BYTES = 6
MIN_PACKET_BYTES, MAX_PACKET_BYTES = 32, 2048
MAX_SENDERS = 32
NUM_NUMBERS = 1024
FIRST_RELAYED = 96
"""Fragments from this index on come from others than who said the item."""
_HEADER_BYTES = 4
_CHECK_BYTES = 2


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet; `num_needed` 0 is a bundle, else `payload` is fragment `index` of an item."""

    epoch: int
    sender: int
    number: int  # of the item, modulo 1024
    num_needed: int
    index: int
    payload: bytes
    life: int = 0
    """What the sender has drawn, of a relayed fragment; so it is for the caller to check."""

    @property
    def is_relayed(self) -> bool:
        """Whether it comes from another vehicle than the sender."""
        return self.num_needed > 0 and self.index >= FIRST_RELAYED

    def pack(self, key: bytes) -> bytes:
        """To bytes."""
        header = PACKET_VERSION << 2 | self.epoch % 4
        for value, num_bits in (
            (self.sender, 5),
            (self.number % NUM_NUMBERS, 10),
            (self.num_needed, 6),
        ):
            header = header << num_bits | value
        data = (header << 7 | self.index).to_bytes(_HEADER_BYTES, "big") + self.payload
        check = _check_of(data, key) ^ (self.life if self.is_relayed else 0)
        return data + check.to_bytes(_CHECK_BYTES, "big")

    @classmethod
    def unpack(cls, data: bytes, key: bytes) -> Packet:
        """From bytes; raises `InvalidInputError` where they are not what `pack` made."""
        if not OVERHEAD_BYTES < len(data) <= MAX_PACKET_BYTES:
            raise InvalidInputError(
                f"packet has {len(data)} bytes, expected {OVERHEAD_BYTES + 1} to "
                f"{MAX_PACKET_BYTES}"
            )
        content, check = data[:-_CHECK_BYTES], data[-_CHECK_BYTES:]
        header = int.from_bytes(content[:_HEADER_BYTES], "big")
        if header >> 30 != PACKET_VERSION:
            raise InvalidInputError(
                f"version of the packet is {header >> 30}, expected {PACKET_VERSION}"
            )
        packet = cls(
            header >> 28 & 3,
            header >> 23 & 31,
            header >> 13 & 1023,
            header >> 7 & 63,
            header & 127,
            content[_HEADER_BYTES:],
            int.from_bytes(check, "big") ^ _check_of(content, key),
        )
        if packet.life and not packet.is_relayed:
            raise InvalidInputError(f"checksum of the packet is not {check.hex()}")
        return packet


def _check_of(content: bytes, key: bytes) -> int:
    return int.from_bytes(digest_of(content, key, _CHECK_BYTES), "big")


def framed(number: int, item: bytes) -> bytes:
    """An item as it is cut into fragments: with its whole number and its length."""
    writer = ByteWriter()
    writer.varint(number)
    writer.varint(len(item))
    writer.raw(item)
    return bytes(writer)


def read_framed(data: bytes) -> tuple[int, bytes]:
    """Undo `framed`; what follows the item must be zero."""
    reader = ByteReader(data)
    number, length = reader.varint(), reader.varint()
    item = reader.raw(length)
    if reader.rest.strip(b"\0"):
        raise InvalidInputError("bytes follow the item, expected zeros")
    return number, item


def num_parts(length: int, max_bytes: int) -> int:
    """Fragments that so many bytes need in packets of that size."""
    parts = -(-length // (max_bytes - OVERHEAD_BYTES))
    if parts > MAX_NEEDED:
        raise InvalidInputError(
            f"an item of {length} bytes takes {parts} packets of {max_bytes} bytes, expected at "
            f"most {MAX_NEEDED}"
        )
    return parts


def part_of(data: bytes, parts: int, index: int) -> bytes:
    """A fragment of a framed item."""
    return fragment(data + bytes(-len(data) % parts), parts, index)


def bundled(notes: list[bytes]) -> bytes:
    """Several short notes as one payload."""
    writer = ByteWriter()
    for note in notes:
        writer.varint(len(note))
        writer.raw(note)
    return bytes(writer)


def unbundled(payload: bytes) -> list[bytes]:
    """Undo `bundled`."""
    reader, notes = ByteReader(payload), []
    while reader.rest:
        notes.append(reader.raw(reader.varint()))
    return notes
