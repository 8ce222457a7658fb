"""What packets are filled with: items, which everybody shall get, and notes, which pass."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.link.coding.fields import ByteReader, ByteWriter
from uw_dslam_ros2.core.link.coding.layer import Layer

__all__ = [
    "ItemKind",
    "LayerKey",
    "PeerReport",
    "Status",
    "hello_item",
    "layer_item",
    "read_hello",
    "read_item",
    "read_layer",
    "read_note",
    "whole_note",
]

_MAX_NAME_BYTES = 64
_MAX_ENTRIES = 200
_RUN_BYTES = _LIFE_BYTES = 2


class ItemKind(enum.IntEnum):
    """First byte of an item or a note."""

    HELLO = 1
    LAYER = 2
    ANSWER = 3
    STATUS = 4
    WHOLE = 5
    """Of a note: an item that needs no cutting."""
    DECISION = 6
    MOVED = 7


@dataclass(frozen=True, slots=True, order=True)
class LayerKey:
    """One layer of one submap of a sender; of its run the last 16 bits."""

    run: int
    sequence: int
    layer: Layer

    @classmethod
    def of(cls, run_id: int, sequence: int, layer: Layer) -> LayerKey:
        """Name a layer."""
        return cls(run_id & 0xFFFF, sequence, layer)

    def write(self, writer: ByteWriter) -> None:
        """Append it."""
        writer.fixed(self.run, _RUN_BYTES)
        writer.varint(4 * self.sequence + self.layer)

    @classmethod
    def read(cls, reader: ByteReader) -> LayerKey:
        """Take one."""
        run, value = reader.fixed(_RUN_BYTES), reader.varint()
        return cls(run, value // 4, Layer.numbered(value % 4))


def hello_item(name: str) -> bytes:
    """The sender's name."""
    data = name.encode()
    if not 0 < len(data) <= _MAX_NAME_BYTES:
        raise InvalidInputError(
            f"vehicle_id {name[:80]!r} has {len(data)} bytes, expected 1 to {_MAX_NAME_BYTES}"
        )
    return bytes([ItemKind.HELLO]) + data


def read_hello(body: ByteReader) -> str:
    """Undo `hello_item`."""
    try:
        name = body.rest.decode()
    except UnicodeDecodeError as error:
        raise InvalidInputError(f"the sender's name is {body.rest!r}, expected UTF-8") from error
    hello_item(name)
    return name


def layer_item(key: LayerKey, data: bytes) -> bytes:
    """A layer, and whose it is."""
    writer = ByteWriter()
    writer.fixed(ItemKind.LAYER, 1)
    key.write(writer)
    writer.raw(data)
    return bytes(writer)


def read_layer(body: ByteReader) -> tuple[LayerKey, bytes]:
    """Undo `layer_item`."""
    return LayerKey.read(body), body.rest


def read_item(item: bytes) -> tuple[ItemKind, ByteReader]:
    """Kind of an item and its content."""
    reader = ByteReader(item)
    kind = reader.fixed(1)
    if kind not in list(ItemKind):
        raise InvalidInputError(f"kind of the item is {kind}, expected one of {list(ItemKind)}")
    return ItemKind(kind), reader


@dataclass(frozen=True, slots=True)
class PeerReport:
    """What one vehicle has of another's items.

    All below `base`; of those from there on `lacking` says how many fragments are missing: 0 none,
    None where nothing has come. Of later ones nothing has come either, unless the report is cut.
    """

    epoch: int
    base: int
    lacking: tuple[int | None, ...] = ()
    is_cut: bool = False

    def lacking_of(self, number: int, parts: int) -> int | None:
        """How many fragments of an item of so many parts are missing; None where it says not."""
        offset = number - self.base
        if offset < 0:
            return 0
        if offset >= len(self.lacking):
            return None if self.is_cut else parts
        said = self.lacking[offset]
        return parts if said is None else min(said, parts)


@dataclass(frozen=True, slots=True)
class Status:
    """What a vehicle has sent, and what it has received."""

    num_items: int
    voids: tuple[int, ...] = ()
    """Items that are not worth having any more."""
    peers: dict[int, PeerReport] = field(default_factory=dict)
    is_cut: bool = False
    """Whether there was no room for all peers; else nothing has come of those not named."""
    life: int = 0
    """16 bits that the sender has drawn when it began with nothing: packets tell only two."""

    def of(self, sender: int, epoch: int) -> PeerReport | None:
        """What has come of a sender since an epoch began; None where that is not said."""
        report = self.peers.get(sender)
        if report is None and self.is_cut:
            return None
        return report if report is not None and report.epoch == epoch else PeerReport(epoch, 0)

    def pack(self) -> bytes:
        """To a note."""
        writer = ByteWriter()
        writer.fixed(ItemKind.STATUS, 1)
        writer.fixed(self.life, _LIFE_BYTES)
        writer.varint(self.num_items)
        writer.varint(2 * len(self.voids) + self.is_cut)
        for number in self.voids:
            writer.varint(number)
        for sender, report in self.peers.items():
            writer.fixed(sender << 3 | report.is_cut << 2 | report.epoch, 1)
            writer.varint(report.base)
            writer.varint(len(report.lacking))
            for lacking in report.lacking:
                writer.fixed(255 if lacking is None else lacking, 1)
        return bytes(writer)

    @classmethod
    def read(cls, reader: ByteReader) -> Status:
        """Undo `pack`."""
        life, num_items = reader.fixed(_LIFE_BYTES), reader.varint()
        head = reader.bounded("the number of void items, twice", 0, 2 * _MAX_ENTRIES)
        voids = tuple(reader.varint() for _ in range(head // 2))
        peers = {}
        while reader.rest:
            first, base = reader.fixed(1), reader.varint()
            num = reader.bounded("the number of open items", 0, _MAX_ENTRIES)
            values = [reader.fixed(1) for _ in range(num)]
            lacking = tuple(None if value == 255 else value for value in values)
            peers[first >> 3] = PeerReport(first & 3, base, lacking, bool(first & 4))
        return cls(num_items, voids, peers, bool(head & 1), life)


def whole_note(framed_item: bytes) -> bytes:
    """A framed item as a note."""
    return bytes([ItemKind.WHOLE]) + framed_item


def read_note(note: bytes) -> Status | bytes:
    """A note of a bundle; bytes are a framed item."""
    kind, reader = read_item(note)
    if kind is ItemKind.STATUS:
        return Status.read(reader)
    if kind is ItemKind.WHOLE:
        return reader.rest
    raise InvalidInputError(f"a note of kind {kind.name}, expected STATUS or WHOLE")
