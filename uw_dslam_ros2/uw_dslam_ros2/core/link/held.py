"""What one end of a link knows of all submaps, its own ones as the others have them too."""

from __future__ import annotations

from collections.abc import Iterator

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.link.coding.codec import Layer, LayeredSubmap, read_outline
from uw_dslam_ros2.core.link.coding.items import LayerKey
from uw_dslam_ros2.core.link.coding.moves import Move
from uw_dslam_ros2.core.submap import Submap

__all__ = ["HeldSubmaps"]

Place = tuple[int, int, int]
"""Sender, run (16 bits), sequence."""


class HeldSubmaps:
    """Layers by submap, and the vehicles' names.

    Parameters
    ----------
    number, name
        Of this vehicle.
    key
        Of the fleet's checksums.
    """

    def __init__(self, number: int, name: str, key: bytes) -> None:
        self.names: dict[int, str] = {number: name}
        self.submaps: dict[Place, LayeredSubmap] = {}
        self._number, self._key = number, key
        self._waiting: dict[tuple[int, LayerKey], bytes] = {}  # finer layers that came too early
        self._moves: dict[Place, Move] = {}  # of outlines that have not come
        self._given: dict[Place, int] = {}  # revision of the submap given out

    def own(self, key: LayerKey) -> LayeredSubmap | None:
        """An own submap as the others have it."""
        return self.submaps.get((self._number, key.run, key.sequence))

    def likeness(self, key: LayerKey) -> float:
        """How much walls an own submap could have in common with one of another vehicle [m]."""
        held = self.own(key)
        if held is None or held.outline is None:
            return 0.0
        others = [
            other.outline for place, other in self.submaps.items() if place[0] != self._number
        ]
        likeness = [held.outline.likeness(other) for other in others if other is not None]
        return max(likeness, default=0.0)

    def take_name(self, sender: int, name: str) -> None:
        """Hear a vehicle's name; `InvalidInputError` where name or number is another's already."""
        known = self.names.get(sender)
        if known == name:
            return
        if known is not None or name in self.names.values():
            raise InvalidInputError(f"two vehicles are {name!r} or number {sender}")
        self.names[sender] = name

    def take_layer(self, sender: int, key: LayerKey, data: bytes) -> None:
        """Add a layer, or keep it until the one below has come; `InvalidInputError` if unsound."""
        if key.layer is Layer.OUTLINE:
            outline = read_outline(data, self._key)
            if LayerKey.of(outline.run_id, outline.sequence, key.layer) != key:
                raise InvalidInputError(f"outline of submap {outline.sequence} came as {key}")
        place = (sender, key.run, key.sequence)
        held = self.submaps.get(place) or LayeredSubmap(self._key)
        if key.layer is Layer.FINE and held.cells is None:
            self._waiting[sender, key] = data
            return
        if held.add(data) is not key.layer:
            raise InvalidInputError(f"a layer came as {key.layer.name}, which it is not")
        self.submaps[place] = held
        if key.layer is Layer.OUTLINE and (move := self._moves.pop(place, None)) is not None:
            self.take_move(sender, move)
        fine = LayerKey(key.run, key.sequence, Layer.FINE)
        if key.layer is Layer.COARSE and (early := self._waiting.pop((sender, fine), None)):
            self.take_layer(sender, fine, early)

    def take_move(self, sender: int, move: Move) -> None:
        """Move a submap; kept until its outline has come, if it is not the one that is here."""
        place = (sender, move.key.run, move.key.sequence)
        held = self.submaps.get(place)
        outline = None if held is None else held.outline
        if outline is not None and outline.revision >= move.revision:
            return
        moved = None if outline is None else move.applied(outline, self._key)
        if held is not None and moved is not None:
            held.add(moved)
        else:
            self._moves[place] = move

    def improved(self, sender: int) -> list[Submap]:
        """Submaps of a vehicle as they are now, if they were not given out like that before."""
        name = self.names.get(sender)
        if name is None:
            return []
        found = []
        for place in sorted(place for place in self.submaps if place[0] == sender):
            revision = self.submaps[place].revision
            if revision is not None and revision > self._given.get(place, -1):
                submap = self.submaps[place].submap(name)
                assert submap is not None, "it has a revision"
                self._given[place] = revision
                found.append(submap)
        return found

    def drawn(self) -> Iterator[Submap]:
        """All submaps that can be drawn, of all vehicles whose names are known."""
        for (sender, _, _), held in sorted(self.submaps.items()):
            name = self.names.get(sender)
            submap = None if name is None else held.submap(name)
            if submap is not None:
                yield submap
