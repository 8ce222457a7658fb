"""Pings as they entered their submaps, kept to be drawn once more."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar.types import Detections
from uw_dslam_ros2.core.submap import SubmapId

__all__ = ["DrawnPing", "KeptPings", "pack_ping"]

Float32Array = NDArray[np.float32]
_OBJECT_BYTES = 850
"""Of a ping without its numbers: its own object, its poses, and three arrays' heads."""


@dataclass(frozen=True, slots=True, eq=False)
class DrawnPing:
    """Echoes and free water of one ping, and where in its submap it was heard.

    In single precision, and pings of one sonar share their bearings: what is kept of a ping is
    its echoes, not its image. Fields are those of `Detections`. ``T_dead_sonar`` is where the
    sonar was by dead reckoning alone, in a frame that drifts; None where that is not known.
    """

    stamp_ns: int
    T_submap_sonar: SE2
    points: Float32Array
    weight: Float32Array
    bearing_rad: NDArray[np.float64]
    free_range_m: Float32Array
    beamwidth_rad: float
    range_sigma_m: float
    T_dead_sonar: SE2 | None = None

    def num_bytes_after(self, before: DrawnPing | None) -> int:
        """Memory that it takes, beside the ping before it."""
        own = (self.points, self.weight, self.free_range_m)
        has_bearings = before is None or before.bearing_rad is not self.bearing_rad
        return (
            _OBJECT_BYTES
            + sum(array.nbytes for array in own)
            + has_bearings * self.bearing_rad.nbytes
        )

    def detections(self, range_scale: float = 1.0) -> Detections:
        """In full, with a factor on all ranges."""
        return Detections(
            self.stamp_ns,
            self.points.astype(np.float64) * range_scale,
            self.weight.astype(np.float64),
            self.bearing_rad,
            self.free_range_m.astype(np.float64) * range_scale,
            self.beamwidth_rad,
            self.range_sigma_m,
        )


def pack_ping(
    detections: Detections,
    T_submap_sonar: SE2,
    before: DrawnPing | None = None,
    T_dead_sonar: SE2 | None = None,
) -> DrawnPing:
    """Keep a ping; `before` is the one before it, whose bearings may be the same."""
    bearing_rad = detections.bearing_rad
    if before is not None and np.array_equal(before.bearing_rad, bearing_rad):
        bearing_rad = before.bearing_rad
    return DrawnPing(
        detections.stamp_ns,
        T_submap_sonar,
        detections.points.astype(np.float32),
        detections.weight.astype(np.float32),
        bearing_rad,
        detections.free_range_m.astype(np.float32),
        detections.beamwidth_rad,
        detections.range_sigma_m,
        T_dead_sonar,
    )


class KeptPings:
    """Watches a mapper and keeps what enters its submaps.

    Parameters
    ----------
    max_bytes
        How much is kept at most; what comes after that is left out, and counted.
    """

    def __init__(self, max_bytes: float = math.inf) -> None:
        self.of_submap: dict[SubmapId, list[DrawnPing]] = {}
        self.num_bytes = self.num_left_out = 0
        self._max_bytes = max_bytes
        self._last: DrawnPing | None = None

    def take(self, pings: Mapping[SubmapId, Sequence[DrawnPing]]) -> None:
        """Keep what another has kept."""
        for submap_id, own in pings.items():
            self.of_submap[submap_id] = list(own)
            for ping in own:
                last, self._last = self._last, ping
                self.num_bytes += ping.num_bytes_after(last)

    def __call__(
        self,
        submap_id: SubmapId,
        detections: Detections,
        T_submap_sonar: SE2,
        T_dead_sonar: SE2 | None,
    ) -> None:
        """Keep one ping."""
        if self.num_bytes >= self._max_bytes:
            self.num_left_out += 1
            return
        packed = pack_ping(detections, T_submap_sonar, self._last, T_dead_sonar)
        last, self._last = self._last, packed
        self.num_bytes += self._last.num_bytes_after(last)
        self.of_submap.setdefault(submap_id, []).append(self._last)
