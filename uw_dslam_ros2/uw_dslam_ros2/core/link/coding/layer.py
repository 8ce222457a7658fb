"""Which layers there are, and how the bytes of each begin."""

from __future__ import annotations

import enum

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.link.coding.fields import ByteReader, ByteWriter

__all__ = ["CODEC_VERSION", "Layer", "begun", "head_of"]

CODEC_VERSION = 5
"""Of layers, and of what is drawn of them; others are refused."""


class Layer(enum.IntEnum):
    """What is sent of a submap, in this order."""

    OUTLINE = 0
    COARSE = 1
    """Walls in cells of 0.3 m, what is free in blocks of 0.6 m, and the path."""
    FINE = 2
    """Where the walls are in cells of 0.1 m; what is free is told no better than before."""

    @classmethod
    def numbered(cls, number: int) -> Layer:
        """The layer of a number; `InvalidInputError` where there is none."""
        if number not in list(cls):
            raise InvalidInputError(f"number of the layer is {number}, expected 0 to {max(cls)}")
        return cls(number)


def begun(layer: Layer) -> ByteWriter:
    """Bytes of a layer, to go on with."""
    writer = ByteWriter()
    writer.fixed(CODEC_VERSION << 2 | layer, 1)
    return writer


def head_of(data: bytes) -> tuple[Layer, ByteReader]:
    """Which layer some bytes say that they are, and what follows; `InvalidInputError` if none."""
    reader = ByteReader(data)
    head = reader.fixed(1)
    if head >> 2 != CODEC_VERSION:
        raise InvalidInputError(f"version of the codec is {head >> 2}, expected {CODEC_VERSION}")
    return Layer.numbered(head & 3), reader
