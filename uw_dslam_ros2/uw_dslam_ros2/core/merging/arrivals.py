"""Which submaps came, and which are known to be missing."""

from __future__ import annotations

import itertools

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.merging.graph.submap_groups import StoredSubmap
from uw_dslam_ros2.core.submap import Submap, SubmapId, Track

__all__ = ["Arrivals"]

_MAX_REVISION_LEAP = 10_000
"""A vehicle that settles its graph after each submap for hours does not come so far."""


class Arrivals:
    """The newest revision of each submap.

    Parameters
    ----------
    max_cells
        Of a submap's grid.
    """

    def __init__(self, max_cells: int) -> None:
        self.submaps: dict[SubmapId, StoredSubmap] = {}
        self.tracks: list[Track] = []
        """In order of first arrival."""
        self._max_cells = max_cells
        self._lacking: set[SubmapId] = set()

    def add(self, submap: Submap) -> bool:
        """Take a submap; see `MapQueue.add_submap`."""
        submap_id = submap.submap_id
        stored = StoredSubmap.of(submap, self._max_cells)
        held = self.submaps.get(submap_id)
        if held is not None and submap.revision <= held.submap.revision:
            is_other = held.fingerprint != stored.fingerprint
            if submap.revision == held.submap.revision and is_other:
                raise InvalidInputError(
                    f"submap {submap_id} revision {submap.revision} "
                    "differs from the one received before: are there two vehicles of this name?"
                )
            return False
        leap = submap.revision - (0 if held is None else held.submap.revision)
        if leap > _MAX_REVISION_LEAP:
            raise InvalidInputError(
                f"submap {submap_id} leaps to revision {submap.revision}, expected at most "
                f"{_MAX_REVISION_LEAP} more than were received before"
            )
        self.submaps[submap_id] = stored
        self._lacking.discard(submap_id)
        if submap_id.track not in self.tracks:
            self.tracks.append(submap_id.track)
        return True

    def put(self, submap: Submap) -> None:
        """Take a submap that was taken before."""
        self.submaps[submap.submap_id] = StoredSubmap.of(submap, self._max_cells)

    def missing(self, max_per_track: int) -> dict[Track, list[int]]:
        """Sequence numbers of each run that never came; see `MapQueue.missing`."""
        held: dict[Track, list[int]] = {}
        lacking = [i for i in self._lacking if i not in self.submaps]
        for submap_id in sorted(self.submaps):
            held.setdefault(submap_id.track, []).append(submap_id.sequence)
        found: dict[Track, list[int]] = {}
        for track, sequences in held.items():
            gaps = (
                number
                for before, after in itertools.pairwise([-1, *sequences])
                for number in range(before + 1, after)
            )
            if first := list(itertools.islice(gaps, max_per_track)):
                found[track] = first
        for submap_id in lacking:
            numbers = found.setdefault(submap_id.track, [])
            if submap_id.sequence not in numbers and len(numbers) < max_per_track:
                numbers.append(submap_id.sequence)
        return found

    def note_missing(self, submap_id: SubmapId) -> None:
        """There is such a submap, and it did not come."""
        self._lacking.add(submap_id)

    def newest_run(self, vehicle_id: str) -> int:
        """Run of a vehicle that was heard of last; 0 without any."""
        runs = [track.run_id for track in self.tracks if track.vehicle_id == vehicle_id]
        return runs[-1] if runs else 0
