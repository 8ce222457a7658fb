"""Sonars that turn: beams, each with a time of its own, gathered to sweeps and placed one by one.

A turn takes 9 to 35 s, and a message may hold one beam, a sector or a turn. What is gathered
depends on the beams alone, so that one beam a message and a turn a message give the same map.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.se2 import SE2, wrap_angle
from uw_dslam_ros2.core.sonar.config import SonarConfig
from uw_dslam_ros2.core.sonar.detect import (
    BeamEchoes,
    beam_spacing,
    image_echoes,
    polar,
    scan_echoes,
)
from uw_dslam_ros2.core.sonar.types import Detections, SonarImage

__all__ = [
    "BeamGatherer",
    "Beams",
    "PlacedSweep",
    "Slice",
    "Sweep",
    "beams_of_image",
    "is_few_beams",
    "place_sweep",
]

FloatArray = NDArray[np.float64]

_MAX_GAP_NS = 5_000_000_000
_MAX_SPAN_NS = 60_000_000_000
_BACK_RAD = 0.05
"""A sonar that turns back by more begins a new sweep; less is jitter of its encoder."""
_SLICE_M = 0.05
"""Beams heard within this distance are drawn as heard at one place."""


@dataclass(frozen=True, slots=True, eq=False)
class Beams:
    """Beams of a sonar that turns: one, a sector or a turn.

    ``stamp_ns`` (B,) and ``bearing_rad`` (B,), counter-clockwise from the sonar's x axis, in any
    order. Without ``intensity``, ``range_m`` (B,) is each beam's echo: infinity where it met
    nothing up to ``range_max_m``, NaN where it says nothing. With ``intensity`` (R, B),
    ``range_m`` (R,) are the centres of its bins.
    """

    stamp_ns: NDArray[np.int64]
    bearing_rad: FloatArray
    range_m: FloatArray
    range_max_m: float
    intensity: NDArray[np.generic] | None = None

    def __post_init__(self) -> None:
        num_beams = len(self.stamp_ns)
        if num_beams == 0 or self.bearing_rad.shape != (num_beams,):
            raise InvalidInputError(
                f"bearings have shape {self.bearing_rad.shape} and stamps {self.stamp_ns.shape}, "
                "expected the same (B > 0,)"
            )
        if not np.isfinite(self.bearing_rad).all():
            raise InvalidInputError("bearing_rad holds values that are not finite")
        if not (math.isfinite(self.range_max_m) and self.range_max_m > 0.0):
            raise InvalidInputError(
                f"range_max_m is {self.range_max_m}, expected a positive number"
            )
        expected = (num_beams,)
        if self.intensity is not None:
            expected = (len(self.range_m),)
            if self.intensity.shape != (*expected, num_beams) or expected == (0,):
                raise InvalidInputError(
                    f"intensity has shape {self.intensity.shape}, "
                    f"expected (ranges, beams) = {(*expected, num_beams)}, none of them 0"
                )
        if self.range_m.shape != expected:
            raise InvalidInputError(f"range_m has shape {self.range_m.shape}, expected {expected}")


_MIN_FAN_BEAMS = 5
"""Fewer beams in an image are a piece of what a sonar that turns sees."""


def is_few_beams(image: SonarImage) -> bool:
    """Whether an image is only a piece of a turn."""
    return len(image.bearing_rad) < _MIN_FAN_BEAMS


def beams_of_image(image: SonarImage) -> Beams:
    """The few beams of an image, all of its time."""
    stamp_ns = np.full(len(image.bearing_rad), image.stamp_ns, np.int64)
    bearing = np.asarray(image.bearing_rad, np.float64)
    range_m = np.asarray(image.range_m, np.float64)
    return Beams(stamp_ns, bearing, range_m, float(range_m[-1]), image.intensity)


@dataclass(frozen=True, slots=True, eq=False)
class _Beam:
    """One beam: ``column`` (R,) of intensities over ``range_m`` (R,), or one range (1,).

    The bearing is in the horizontal plane; ``scale`` takes a range to there.
    """

    stamp_ns: int
    bearing_rad: float
    range_m: FloatArray
    range_max_m: float
    column: NDArray[np.generic] | None
    T_base_sonar: SE2
    scale: float

    def is_like(self, other: _Beam) -> bool:
        """Whether both can be columns of one image."""
        if self.column is None or other.column is None:
            return self.column is other.column
        return np.array_equal(self.range_m, other.range_m)


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """Beams of at most one turn, in the order of time.

    Roll and pitch move the sonar, so each beam has a mounting of its own.
    """

    beams: tuple[_Beam, ...]

    @property
    def stamp_ns(self) -> NDArray[np.int64]:
        """Time of each beam (B,)."""
        return np.array([beam.stamp_ns for beam in self.beams], np.int64)

    @property
    def bearing_rad(self) -> FloatArray:
        """Bearing of each beam (B,)."""
        return np.array([beam.bearing_rad for beam in self.beams])

    def since(self, stamp_ns: int) -> Sweep:
        """The beams from a time on."""
        return Sweep(tuple(beam for beam in self.beams if beam.stamp_ns >= stamp_ns))

    def until(self, stamp_ns: int) -> Sweep:
        """The beams up to a time."""
        return Sweep(tuple(beam for beam in self.beams if beam.stamp_ns <= stamp_ns))

    def echoes(self, config: SonarConfig) -> BeamEchoes:
        """Echoes along each beam; ranges in the plane."""
        beams = self.beams
        columns = [beam.column for beam in beams if beam.column is not None]
        if columns:
            stamp_ns, range_m = beams[0].stamp_ns, beams[0].range_m
            image = SonarImage(stamp_ns, np.column_stack(columns), range_m, self.bearing_rad)
            found = image_echoes(image, config)
        else:
            ranges = np.array([beam.range_m[0] for beam in beams])
            limits = np.array([beam.range_max_m for beam in beams])
            found = scan_echoes(self.bearing_rad, ranges, limits, config)
        scale = np.array([beam.scale for beam in beams])
        return BeamEchoes(
            found.beam,
            found.range_m * scale[found.beam],
            found.weight,
            _free_range(found) * scale,
            found.range_sigma_m,
        )


def _free_range(echoes: BeamEchoes) -> FloatArray:
    """Free ranges (B,): a beam without echo is as free as the beam beside it that has one.

    A wall between two beams that see it is there although it answers badly just so: a wide beam
    that turns misses more of a wall at a slant than a fan does.
    """
    nearest_m = np.full(len(echoes.free_range_m), np.inf)
    np.minimum.at(nearest_m, echoes.beam, echoes.range_m)
    beside_m = np.minimum(np.append(nearest_m[1:], np.inf), np.insert(nearest_m[:-1], 0, np.inf))
    is_silent = np.isinf(nearest_m)
    return np.where(is_silent, np.minimum(echoes.free_range_m, beside_m), echoes.free_range_m)


class BeamGatherer:
    """Puts beams of successive messages together to sweeps.

    A sweep ends with a full turn, where the sonar turns back, changes its bins or pauses.
    """

    def __init__(self) -> None:
        self._complete: list[Sweep] = []
        self._current: list[_Beam] = []
        self._last: _Beam | None = None
        self._angle_rad = self._low_rad = self._high_rad = 0.0
        self.num_late = 0

    def add(self, beams: Beams, T_base_sonar: SE2, projection: FloatArray | None = None) -> None:
        """Take beams; those not later than others before, or sent twice, are left out and counted.

        ``projection`` (2, 2) takes points of a fan that is not level to the plane.
        """
        newest_ns = self._last.stamp_ns if self._last is not None else -math.inf
        for beam in _split(beams, T_base_sonar, projection):
            if beam.stamp_ns > newest_ns:
                self._add(beam)
            else:
                self.num_late += 1

    def take(self, until_ns: int | None) -> list[Sweep]:
        """Sweeps that are complete, and older than a time; None: all, the last one too."""
        if until_ns is None:
            self._end()
            until_ns = np.iinfo(np.int64).max
        count = 0
        while count < len(self._complete) and self._complete[count].beams[-1].stamp_ns <= until_ns:
            count += 1
        taken, self._complete = self._complete[:count], self._complete[count:]
        return taken

    def _add(self, beam: _Beam) -> None:
        last, self._last = self._last, beam
        if not self._current or last is None:
            self._begin(beam)
            return
        angle = self._angle_rad + wrap_angle(beam.bearing_rad - last.bearing_rad)
        low, high = min(self._low_rad, angle), max(self._high_rad, angle)
        step = (high - low) / len(self._current)
        has_turned_back = min(high - angle, angle - low) > _BACK_RAD
        if (
            has_turned_back
            or high - low > 2.0 * math.pi - 0.5 * step
            or beam.stamp_ns - last.stamp_ns > _MAX_GAP_NS
            or beam.stamp_ns - self._current[0].stamp_ns > _MAX_SPAN_NS
            or not beam.is_like(last)
        ):
            self._end()
            self._begin(beam)
            return
        self._current.append(beam)
        self._angle_rad, self._low_rad, self._high_rad = angle, low, high

    def _begin(self, beam: _Beam) -> None:
        self._current = [beam]
        self._angle_rad = self._low_rad = self._high_rad = 0.0

    def _end(self) -> None:
        if self._current:
            self._complete.append(Sweep(tuple(self._current)))
        self._current = []


def _split(beams: Beams, T_base_sonar: SE2, projection: FloatArray | None) -> Iterator[_Beam]:
    """Single beams in the order of time, their directions as seen from above."""
    bearing = beams.bearing_rad
    scale = np.ones(len(bearing))
    if projection is not None:
        directions = polar(scale, bearing) @ projection.T
        scale = np.hypot(directions[:, 0], directions[:, 1])
        bearing = np.arctan2(directions[:, 1], directions[:, 0])
    for i in np.argsort(beams.stamp_ns, kind="stable"):
        yield _Beam(
            int(beams.stamp_ns[i]),
            float(bearing[i]),
            beams.range_m[i : i + 1] if beams.intensity is None else beams.range_m,
            beams.range_max_m,
            None if beams.intensity is None else beams.intensity[:, i],
            T_base_sonar,
            float(scale[i]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Slice:
    """Beams that were heard at nearly one place, as detections in the sonar's frame there."""

    detections: Detections
    T_reference_sonar: SE2


@dataclass(frozen=True, slots=True, eq=False)
class PlacedSweep:
    """A sweep whose beams lie where navigation says, relative to base_link at one time.

    ``detections`` has all echoes and beams in that reference frame, for matching. ``slices`` has
    each beam once, seen from its own place, for drawing. ``stamps_ns`` (B,) and ``path`` (B, 3)
    are the poses of base_link in the reference frame.
    """

    detections: Detections
    slices: tuple[Slice, ...]
    stamps_ns: NDArray[np.int64]
    path: FloatArray


def place_sweep(
    sweep: Sweep, T_reference_base: list[SE2], stamp_ns: int, config: SonarConfig
) -> PlacedSweep:
    """Place each beam of a sweep by the pose of base_link (B of them) at its own time.

    There is no filter by neighbours: on a wall at a slant the next echo is metres away.
    """
    echoes, bearing = sweep.echoes(config), sweep.bearing_rad
    sonar = np.array([
        (T @ beam.T_base_sonar).as_array()
        for T, beam in zip(T_reference_base, sweep.beams, strict=True)
    ])  # fmt: skip
    points = sonar[echoes.beam, :2] + polar(
        echoes.range_m, bearing[echoes.beam] + sonar[echoes.beam, 2]
    )
    width_rad = beam_spacing(bearing, config)
    beam, weight = echoes.beam, echoes.weight
    slices = []
    for part in _parts(sonar):
        T_reference_sonar = SE2.from_array(sonar[part.start])
        is_here = (beam >= part.start) & (beam < part.stop)
        found = Detections(
            int(sweep.stamp_ns[part.start]),
            T_reference_sonar.inverse().apply(points[is_here]),
            weight[is_here],
            bearing[part] + sonar[part, 2] - T_reference_sonar.yaw,
            echoes.free_range_m[part],
            width_rad,
            echoes.range_sigma_m,
        )
        slices.append(Slice(found, T_reference_sonar))
    whole = Detections(
        stamp_ns, points, weight, bearing + sonar[:, 2], echoes.free_range_m,
        width_rad, echoes.range_sigma_m,
    )  # fmt: skip
    path = np.array([T.as_array() for T in T_reference_base])
    return PlacedSweep(whole, tuple(slices), sweep.stamp_ns, path)


def _parts(sonar: FloatArray) -> Iterator[slice]:
    """Runs of poses (B, 3) within a short way of the first of each."""
    start = 0
    for i in range(1, len(sonar) + 1):
        if i == len(sonar) or math.hypot(*(sonar[i, :2] - sonar[start, :2])) > _SLICE_M:
            yield slice(start, i)
            start = i
