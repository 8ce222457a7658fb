"""What a vehicle says itself: layers of its submaps, answers and decisions, as items by rank."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.link.coding.codec import Layer, encode_submap, write_outline
from uw_dslam_ros2.core.link.coding.items import (
    ItemKind,
    LayerKey,
    hello_item,
    layer_item,
    read_item,
    read_layer,
)
from uw_dslam_ros2.core.link.coding.moves import Move, move_item, moved
from uw_dslam_ros2.core.link.held import HeldSubmaps
from uw_dslam_ros2.core.link.transport.outbox import Outbox, OutItem
from uw_dslam_ros2.core.link.types import OwnState
from uw_dslam_ros2.core.submap import Submap, SubmapId

__all__ = ["ANSWER_RANK", "DECISION_RANK", "ECHO_RANK", "OwnItems"]

DECISION_RANK = -1.0
"""Seldom, and somebody waits to see what comes of it. The lower, the sooner."""
_OUTLINE_RANK, _CELLS_RANK, _MOVED_RANK = 0.0, 1.0, 1.8
ANSWER_RANK = 1.5
ECHO_RANK = 2.5
"""Of an answer that somebody else is likely to tell."""
_LAYER_RANKS = {
    Layer.OUTLINE: _OUTLINE_RANK,
    Layer.COARSE: _CELLS_RANK,
    Layer.FINE: 2.0,
}


class OwnItems:
    """The items of a vehicle, and whose layers they are.

    Parameters
    ----------
    number, name
        Of the vehicle.
    key
        Of the fleet's checksums.
    held
        Where the own submaps are kept as the others have them.
    """

    def __init__(self, number: int, name: str, key: bytes, held: HeldSubmaps) -> None:
        self.outbox = Outbox()
        self._number, self._name, self._key, self._held = number, name, key, held
        self._layers: dict[LayerKey, OutItem] = {}
        self._moves: dict[LayerKey, OutItem] = {}
        self._sources: dict[tuple[int, int], Submap] = {}
        self.outbox.add(hello_item(name), _OUTLINE_RANK, "hello")

    def add_submap(self, submap: Submap) -> None:
        """Say all layers of a submap."""
        layers = encode_submap(submap, self._key)
        self._sources[submap.run_id & 0xFFFF, submap.sequence] = submap
        for layer, data in layers.items():
            self._say(LayerKey.of(submap.run_id, submap.sequence, layer), data)
        self.rank_cells()

    def move_submap(self, submap: Submap, peers: Collection[int]) -> None:
        """Say the pose of a submap whose cells are as before, to these peers."""
        key = LayerKey.of(submap.run_id, submap.sequence, Layer.OUTLINE)
        held = self._held.own(key)
        if held is None or held.outline is None:
            raise InvalidInputError(f"submap {submap.submap_id} moves before it has come")
        outline = moved(held.outline, submap)
        data = write_outline(outline, self._key)
        if self.outbox.is_confirmed(self._layers[key], peers):
            self._held.take_layer(self._number, key, data)
            self._move(key, move_item(key, outline, data))
        else:
            self._say(key, data)

    def submap(self, submap_id: SubmapId) -> Submap | None:
        """A submap as it came or, after a restart, as the others have it."""
        key = LayerKey.of(submap_id.run_id, submap_id.sequence, Layer.OUTLINE)
        source, held = self._sources.get((key.run, key.sequence)), self._held.own(key)
        return source or (None if held is None else held.submap(self._name))

    def tell(self, content: bytes, rank: float, label: str) -> None:
        """Say something else, once."""
        if all(item.content != content for item in self.outbox.items):
            self.outbox.add(content, rank, label)

    def rank_cells(self) -> None:
        """Own cells that look most like what others have seen go first: they may join."""
        for key, item in self._layers.items():
            if key.layer is Layer.COARSE:
                item.rank = _CELLS_RANK + 0.4 / (1.0 + 0.1 * self._held.likeness(key))

    def put_back(self, states: Iterable[OwnState]) -> None:
        """Say what was said before a restart, in the place of all."""
        self.outbox.items.clear()
        for content, rank, label, parts, num_sent, is_void in states:
            item = self.outbox.add(content, rank, label)
            item.parts, item.num_sent, item.is_void = parts, num_sent, is_void
            kind, body = read_item(content)
            if kind is ItemKind.LAYER:
                key, data = read_layer(body)
                self._layers[key] = item
                self._held.take_layer(self._number, key, data)
            elif kind is ItemKind.MOVED:
                move = Move.read(body)
                self._held.take_move(self._number, move)
                if not is_void:
                    self._moves[move.key] = item

    def states(self) -> tuple[OwnState, ...]:
        """For `put_back`."""
        return tuple(
            (i.content, i.rank, i.label, i.parts, i.num_sent, i.is_void) for i in self.outbox.items
        )

    def _move(self, key: LayerKey, content: bytes) -> None:
        """Say a move in the place of the one before it."""
        before = self._moves.get(key)
        if before is None:
            self._moves[key] = self.outbox.add(content, _MOVED_RANK, "moved")
        elif before.content != content:
            self._moves[key] = self.outbox.replace(before, content)

    def _say(self, key: LayerKey, data: bytes) -> None:
        if key.layer is Layer.OUTLINE and (move := self._moves.pop(key, None)) is not None:
            move.is_void = True
        item, content = self._layers.get(key), layer_item(key, data)
        self._held.take_layer(self._number, key, data)
        if item is None:
            rank = _LAYER_RANKS[key.layer]
            self._layers[key] = self.outbox.add(content, rank, key.layer.name.lower())
        elif item.content != content:
            self._layers[key] = self.outbox.replace(item, content)
            # Others have it where it was: that will do first.
            if self._layers[key] is not item:
                self._layers[key].rank = _MOVED_RANK
