"""A submap's new pose in some 22 bytes, for who has its outline."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.link.coding.codec import Layer, write_outline
from uw_dslam_ros2.core.link.coding.fields import ByteReader, ByteWriter
from uw_dslam_ros2.core.link.coding.items import ItemKind, LayerKey
from uw_dslam_ros2.core.link.coding.outline import Outline
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap

__all__ = ["Move", "move_item", "moved"]

_TAG_BYTES = 4


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """What of an outline another pose changes; ``tag`` is the checksum of the outline then."""

    key: LayerKey
    revision: int
    is_final: bool
    T_odom_submap: SE2
    covariance: NDArray[np.float64]
    tag: bytes

    @classmethod
    def read(cls, reader: ByteReader) -> Move:
        """Take one; raises `InvalidInputError` where the bytes are none."""
        key, head = LayerKey.read(reader), reader.varint()
        if key.layer is not Layer.OUTLINE:
            raise InvalidInputError(f"a {key.layer.name} moves, expected an OUTLINE")
        move = cls(
            key,
            head // 2,
            bool(head % 2),
            reader.pose(),
            reader.covariance(),
            reader.raw(_TAG_BYTES),
        )
        if reader.rest:
            raise InvalidInputError(f"{len(reader.rest)} bytes follow a move, expected none")
        return move

    def applied(self, outline: Outline, key: bytes) -> bytes | None:
        """The layer of the outline that has moved; None where another one was meant."""
        data = write_outline(moved(outline, self), key)
        return data if data[-_TAG_BYTES:] == self.tag else None


def moved(outline: Outline, to: Move | Submap) -> Outline:
    """An outline with the pose, and what goes with it, of a move or of a submap."""
    return dataclasses.replace(
        outline,
        revision=to.revision,
        is_final=to.is_final,
        T_odom_submap=to.T_odom_submap,
        covariance=to.covariance,
    )


def move_item(key: LayerKey, outline: Outline, data: bytes) -> bytes:
    """What moves an older outline to this one, whose layer is `data`."""
    writer = ByteWriter()
    writer.fixed(ItemKind.MOVED, 1)
    key.write(writer)
    writer.varint(2 * outline.revision + outline.is_final)
    writer.pose(outline.T_odom_submap)
    writer.covariance(outline.covariance)
    writer.raw(data[-_TAG_BYTES:])
    return bytes(writer)
