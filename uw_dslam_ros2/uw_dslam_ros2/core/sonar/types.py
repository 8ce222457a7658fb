"""What a sonar says: images, and the detections made of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError

__all__ = ["Detections", "SonarImage"]

FloatArray = NDArray[np.float64]

_AROUND_RAD = np.pi
"""A fan leaves more than half of the circle, a turn less but where all walls lie on one side."""


@dataclass(frozen=True, slots=True, eq=False)
class SonarImage:
    """One ping of an imaging sonar in polar form.

    ``intensity`` (R, B), any real type, [range, beam]. ``range_m`` (R,) centres of the range
    bins, rising. ``bearing_rad`` (B,) of each beam, REP 103: positive to port (left), in either
    order, perhaps uneven.
    """

    stamp_ns: int
    intensity: NDArray[np.generic]
    range_m: FloatArray
    bearing_rad: FloatArray

    def __post_init__(self) -> None:
        expected = (len(self.range_m), len(self.bearing_rad))
        if self.intensity.shape != expected or 0 in expected:
            raise InvalidInputError(
                f"intensity has shape {self.intensity.shape}, "
                f"expected (ranges, beams) = {expected}, none of them 0"
            )


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """Echoes of one ping, and how far each beam saw nothing.

    ``points`` (N, 2) [m] in the sonar's frame (x forward, y left), ``weight`` (N,) in (0, 1].
    ``bearing_rad`` (B,) and ``free_range_m`` (B,): along each beam the water is free up to there
    (0: nothing known). ``beamwidth_rad`` and ``range_sigma_m`` size one echo's uncertainty.
    """

    stamp_ns: int
    points: FloatArray
    weight: FloatArray
    bearing_rad: FloatArray
    free_range_m: FloatArray
    beamwidth_rad: float
    range_sigma_m: float

    @property
    def is_turn(self) -> bool:
        """Whether its beams look almost all around, as those of a sonar that turned."""
        bearing = np.sort(np.mod(self.bearing_rad, 2.0 * np.pi))
        if len(bearing) < 2:
            return False
        gaps = np.diff(np.append(bearing, bearing[0] + 2.0 * np.pi))
        return bool(gaps.max() < _AROUND_RAD)

    def projected(self, projection: FloatArray) -> Detections:
        """The same seen from above: ``projection`` (2, 2) takes points of the fan to the plane."""
        ahead = np.stack([np.cos(self.bearing_rad), np.sin(self.bearing_rad)], axis=1)
        seen = ahead @ projection.T
        return replace(
            self,
            points=self.points @ projection.T,
            bearing_rad=np.arctan2(seen[:, 1], seen[:, 0]),
            free_range_m=self.free_range_m * np.hypot(seen[:, 0], seen[:, 1]),
        )
