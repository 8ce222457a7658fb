"""Position fixes of recordings, as fixes of submaps."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from uw_dslam_ros2.core.merging import Fix
from uw_dslam_ros2.core.merging.steering.track_fixes import fixes_along
from uw_dslam_ros2.core.submap import Submap, SubmapId
from uw_dslam_ros2.io.earth import utm_frame, utm_position
from uw_dslam_ros2.io.readings import FixEvent

__all__ = ["FixLog", "fixes_of_recordings"]

_NO_NAME = "coordinates of the fixes"
_SPAN_NS = 10_000_000_000
"""Of a live stream so long says no more than the surest of its fixes, as in `fixes_along`."""


def fixes_of_recordings(
    events: Mapping[str, Sequence[FixEvent]], submaps: Iterable[Submap], least_sigma_m: float
) -> list[Fix]:
    """Fixes of all vehicles' submaps.

    Latitude and longitude become UTM, in the zone of the first of them for all; other positions
    are in the coordinates that their frames name.

    Parameters
    ----------
    events
        By vehicle, in order of time.
    submaps
        Of all vehicles.
    least_sigma_m
        No fix is taken for surer, whatever it says of itself: see `fixes_along`.
    """
    own = list(submaps)
    zone = next(
        (utm_frame(*e.position.tolist()) for es in events.values() for e in es if e.is_geodetic),
        "",
    )
    fixes: list[Fix] = []
    for vehicle_id, of_vehicle in sorted(events.items()):
        by_frame: dict[str, list[FixEvent]] = {}
        for event in of_vehicle:
            frame = zone if event.is_geodetic else event.frame_id or _NO_NAME
            by_frame.setdefault(frame, []).append(event)
        for frame, found in by_frame.items():
            fixes += fixes_along(
                (submap for submap in own if submap.vehicle_id == vehicle_id),
                np.array([event.stamp_ns for event in found]),
                np.array([_position(event, frame) for event in found]),
                np.array([_sigma_m(event, least_sigma_m) for event in found]),
                frame,
            )
    return fixes


class FixLog:
    """Fixes that come one by one, in memory that grows with the minutes and not with the rate.

    Their `vehicle_id` is the name of a topic: it is of the vehicle whose name it begins with.

    Parameters
    ----------
    least_sigma_m
        As in `fixes_of_recordings`.
    """

    def __init__(self, least_sigma_m: float) -> None:
        self._least_sigma_m = least_sigma_m
        self._kept: dict[tuple[str, str, int], FixEvent] = {}

    def note(self, event: FixEvent) -> None:
        """Take one, in any order."""
        key = event.vehicle_id, event.frame_id, event.stamp_ns // _SPAN_NS
        held = self._kept.get(key)
        if held is None or self._worth(event) < self._worth(held):
            self._kept[key] = event

    def fixes(self, submaps: Iterable[Submap]) -> list[Fix]:
        """The surest of each submap: a graph that grows is solved often."""
        own = list(submaps)
        vehicles = sorted({submap.vehicle_id for submap in own}, key=len, reverse=True)
        events: dict[str, list[FixEvent]] = {}
        for event in sorted(self._kept.values(), key=lambda e: (e.stamp_ns, e.frame_id)):
            owner = next((v for v in vehicles if event.vehicle_id.startswith(f"{v}/")), None)
            if owner is not None:  # else its first submap may still come
                events.setdefault(owner, []).append(event)
        surest: dict[SubmapId, Fix] = {}
        for fix in fixes_of_recordings(events, own, self._least_sigma_m):
            held = surest.get(fix.submap_id)
            if held is None or fix.sigma_m < held.sigma_m:
                surest[fix.submap_id] = fix
        return list(surest.values())

    def _worth(self, event: FixEvent) -> tuple[float, int]:
        return _sigma_m(event, self._least_sigma_m), event.stamp_ns


def _position(event: FixEvent, frame: str) -> tuple[float, float]:
    first, second = event.position.tolist()
    return utm_position(first, second, frame) if event.is_geodetic else (first, second)


def _sigma_m(event: FixEvent, least_sigma_m: float) -> float:
    if event.covariance is None:
        return least_sigma_m
    return max(least_sigma_m, math.sqrt(0.5 * float(np.trace(event.covariance))))
