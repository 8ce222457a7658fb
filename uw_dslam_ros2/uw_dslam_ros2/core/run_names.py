"""Names of vehicles' runs for people, who cannot tell numbers apart that were drawn at random."""

from __future__ import annotations

import re
from collections.abc import Iterable

from uw_dslam_ros2.core.submap import Submap, SubmapId, Track, track_name

__all__ = ["RunNames"]

_NUMBERED = re.compile(r"#(\d+)")


class RunNames:
    """A run's number becomes the first, second, ... run of its vehicle.

    Parameters
    ----------
    submaps
        All; a vehicle's runs are counted by the times of their first submaps.
    """

    def __init__(self, submaps: Iterable[Submap]) -> None:
        runs: dict[str, list[Track]] = {}
        for submap in sorted(submaps, key=lambda s: (s.stamp_ns, s.submap_id)):
            track = submap.submap_id.track
            known = runs.setdefault(track.vehicle_id, [])
            if track not in known:
                known.append(track)
        self._counted = {
            track: Track(vehicle_id, number)
            for vehicle_id, tracks in runs.items()
            for number, track in enumerate(tracks, start=1)
        }

    def number(self, track: Track) -> int:
        """1 for the first run of its vehicle; of one that is not known what it was given."""
        return self._counted.get(track, track).run_id

    def track(self, track: Track) -> str:
        """``auv_1``, and from a second run on ``auv_1#2``."""
        return track_name(self._counted.get(track, track))

    def submap(self, submap_id: SubmapId) -> str:
        """``auv_1/3``."""
        return f"{self.track(submap_id.track)}/{submap_id.sequence}"

    def file(self, track: Track, vehicle: str = "") -> str:
        """For files and frames: ``auv_1``, and from a second run on ``auv_1_run2``.

        `vehicle` stands for the vehicle's name where that is none for a file.
        """
        number = self.number(track)
        name = vehicle or track.vehicle_id
        if number <= 1:
            return name
        name = f"{name}_run{number}"
        while any(name == other.vehicle_id for other in self._counted):
            name += "_"  # somebody is called so
        return name

    def in_text(self, text: str) -> str:
        """A sentence with the runs' numbers, ``auv_1#1936390121/0``, as people read it."""
        if "#" not in text:
            return text
        own = {track.run_id: shown for track, shown in self._counted.items() if track.run_id > 1}

        def shown(match: re.Match[str]) -> str:
            track = own.get(int(match[1]))
            if track is None or not text[: match.start()].endswith(track.vehicle_id):
                return match[0]
            return track_name(track)[len(track.vehicle_id) :]

        return _NUMBERED.sub(shown, text)
