"""How a sonar that turns counts its bearings, by how well one turn's echoes meet the next one's.

A turn takes seconds, in which the vehicle moves and turns: only if the zero of the bearings, their
direction and the delay of the heading are right do echoes of one wall, heard in several turns, lie
in one place. No map is needed, and no motion from ping to ping.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from uw_dslam_ros2.core.doctor.motions.fits import at_times
from uw_dslam_ros2.core.doctor.samples.sample import NavigationSample
from uw_dslam_ros2.core.doctor.turning.kernels import mean_nearness
from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.se2 import SE2

__all__ = [
    "MAX_DELAY_S",
    "BeamSample",
    "TurningFit",
    "TurningReading",
    "TurningTrial",
    "choose_windows",
]

FloatArray = NDArray[np.float64]

_WINDOW_S = 75.0
_NUM_WINDOWS = 32
_MIN_WINDOWS = 4
_MIN_WAY_M = 4.0
"""A vehicle that moves less in a window sees the same, wherever the sonar's zero is."""
_MIN_POINTS, _MAX_POINTS = 60, 1000
_MIN_PAIRS = 1000
_MIN_APART_S = 4.0
"""Echoes nearer in time are of one turn: that they lie side by side says nothing."""
_MAX_SILENCE_S = 5.0
"""Where the vehicle went while its velocity was missing for longer, nobody knows."""
_STEP_S = 0.1
_COARSE_M, _MIDDLE_M, _FINE_M = 2.0, 0.8, 0.4
_COARSE_STEP = 5
"""Where the kernel is wide, a fifth of the pairs says the same."""
MAX_DELAY_S = 2.0
"""Of the heading, as long as any that is tried."""
_CLIMB = (
    (_COARSE_M, math.radians(5.0), 0.5),
    (_MIDDLE_M, math.radians(2.0), 0.25),
    (_FINE_M, math.radians(1.0), 0.1),
    (_FINE_M, math.radians(0.4), 0.05),
)
_AROUND = ((-1, 0), (1, 0), (0, -1), (0, 1), (1, 1), (-1, -1), (1, -1), (-1, 1))


@dataclass(frozen=True, slots=True, eq=False)
class BeamSample:
    """First echoes (N,) of beams: ``stamp_s`` rising, ``bearing_rad``, ``range_m``, all finite.

    Bearings are in the plane, counter-clockwise from the axis of ``T_base_sonar``, by which the
    recording says where the sonar sits.
    """

    stamp_s: FloatArray
    bearing_rad: FloatArray
    range_m: FloatArray
    T_base_sonar: SE2 = SE2()

    def __post_init__(self) -> None:
        if not self.stamp_s.shape == self.bearing_rad.shape == self.range_m.shape:
            raise InvalidInputError("stamp_s, bearing_rad and range_m differ in length")
        if (np.diff(self.stamp_s) < 0.0).any():
            raise InvalidInputError("stamp_s does not rise")


@dataclass(frozen=True, slots=True)
class TurningReading:
    """One way to read the beams: a bearing b means ``side * b + offset_rad``.

    ``delay_s`` is how much later than the sonar's the heading's stamps are; with ``heading`` -1
    the vehicle turns against what the IMU says.
    """

    offset_rad: float = 0.0
    side: int = 1
    delay_s: float = 0.0
    heading: int = 1


@dataclass(frozen=True, slots=True, eq=False)
class TurningFit:
    """A reading and how well echoes meet in each window: ``score`` (W,), higher is better."""

    reading: TurningReading
    score: FloatArray

    @property
    def mean(self) -> float:
        """Over all windows."""
        return float(self.score.mean())


def choose_windows(
    start_s: float, end_s: float, imu_s: FloatArray, yaw_rad: FloatArray
) -> list[tuple[float, float]]:
    """Spans [s] of a recording that show most: half of them where the vehicle turns most.

    ``yaw_rad`` (K,) at ``imu_s`` is not wrapped.
    """
    length_s = min(_WINDOW_S, end_s - start_s)
    count = max(1, int((end_s - start_s) / (0.5 * length_s)) - 1) if length_s > 0.0 else 0
    begin = start_s + 0.5 * length_s * np.arange(count)
    turned = np.zeros(count)
    for i, begin_s in enumerate(begin):
        inside = yaw_rad[(imu_s >= begin_s) & (imu_s < begin_s + length_s)]
        turned[i] = float(np.std(inside)) if len(inside) else 0.0
    half = _NUM_WINDOWS // 2
    most = np.argsort(-turned, kind="stable")[:half]
    evenly = np.linspace(0, count - 1, half).astype(np.int64) if count else np.empty(0, np.int64)
    chosen = np.unique(np.concatenate([most, evenly]))
    return [(float(begin[i]), float(begin[i] + length_s)) for i in chosen]


class _Window:
    """The beams of one span, and the vehicle's way through it."""

    def __init__(
        self,
        beams: BeamSample,
        inside: NDArray[np.int64],
        navigation: NavigationSample,
        yaw_rad: FloatArray,
    ) -> None:
        # The way over a silence is guessed: what was heard before and after it is not compared.
        heard_s = navigation.velocity_s
        silences = np.flatnonzero(np.diff(heard_s) > _MAX_SILENCE_S)
        begun = np.searchsorted(heard_s[silences], beams.stamp_s[inside])
        ended = np.searchsorted(heard_s[silences + 1], beams.stamp_s[inside])
        inside, stretch = inside[begun == ended], ended[begun == ended]
        few = slice(None, None, max(1, -(-len(inside) // _MAX_POINTS)))
        inside, self._stretch = inside[few], stretch[few]
        self._stamp_s = beams.stamp_s[inside]
        self._bearing, self._range_m = beams.bearing_rad[inside], beams.range_m[inside]
        self._mount = beams.T_base_sonar
        self._imu_s, self._yaw = navigation.imu_s, yaw_rad
        lead_s = MAX_DELAY_S + 1.0
        first_s, last_s = (self._stamp_s[0], self._stamp_s[-1]) if len(inside) else (0.0, 0.0)
        self._grid = np.arange(first_s - lead_s, last_s + lead_s, _STEP_S)
        velocity = navigation.velocity_m_s
        self._velocity = sum(
            unit * _held(self._grid, navigation.velocity_s, velocity[:, i])
            for i, unit in enumerate((1.0, 1j))
        )
        self._lever = complex(*navigation.velocity_lever_m)

    @property
    def is_usable(self) -> bool:
        """Whether the vehicle moved, its velocity and heading are known, and pairs are many."""
        if len(self._stamp_s) < _MIN_POINTS:
            return False
        yaw = at_times(self._grid, self._imu_s, self._yaw)
        _, num_pairs = self._nearness(np.zeros(len(self._stamp_s), np.complex128), _FINE_M)
        way_m = float(np.abs(self._velocity).sum()) * _STEP_S  # NaN where a gap is
        return (
            num_pairs >= _MIN_PAIRS and way_m > _MIN_WAY_M and bool(np.isfinite(yaw).mean() > 0.9)
        )

    def points(self, reading: TurningReading) -> NDArray[np.complex128]:
        """Echoes (N,) as x + iy where they lie by this reading."""
        yaw = reading.heading * np.interp(self._grid + reading.delay_s, self._imu_s, self._yaw)
        direction = np.exp(1j * yaw)
        # The velocity is that of the instrument's place: its way, less the lever's swing.
        way = np.cumsum(direction * self._velocity) * _STEP_S - direction * self._lever
        here = np.interp(self._stamp_s, self._grid, way.real) + 1j * np.interp(
            self._stamp_s, self._grid, way.imag
        )
        ahead = np.exp(1j * np.interp(self._stamp_s, self._grid, yaw))
        bearing = reading.side * self._bearing + reading.offset_rad + self._mount.yaw
        echo = complex(self._mount.x, self._mount.y) + self._range_m * np.exp(1j * bearing)
        return np.asarray(here + ahead * echo)

    def score(self, reading: TurningReading, width_m: float) -> float:
        """Mean nearness of echoes that were heard at different times, 0 to 1."""
        return self._nearness(self.points(reading), width_m)[0]

    def _nearness(self, points: NDArray[np.complex128], width_m: float) -> tuple[float, int]:
        step = _COARSE_STEP if width_m >= _COARSE_M else 1
        real, imag = points.real.copy(), points.imag.copy()
        return mean_nearness(self._stamp_s, self._stretch, real, imag, _MIN_APART_S, width_m, step)


def _held(grid: FloatArray, known_s: FloatArray, known: FloatArray) -> FloatArray:
    """Interpolate over dropouts, hold beyond the ends; NaN where nothing is known."""
    if len(known_s) == 0:
        return np.full(len(grid), np.nan)
    # A velocity that is wrong by metres is wrong for one message.
    return np.asarray(
        np.interp(grid, known_s, scipy.ndimage.median_filter(known, 3, mode="nearest"))
    )


class TurningTrial:
    """Readings of the beams of a recording, tried on some spans [s] of it.

    Parameters
    ----------
    yaw_rad : (K,) of base_link at ``navigation.imu_s``, not wrapped.
    """

    def __init__(
        self,
        beams: BeamSample,
        navigation: NavigationSample,
        yaw_rad: FloatArray,
        spans: Iterable[tuple[float, float]],
    ) -> None:
        windows = []
        for begin_s, end_s in spans:
            inside = np.flatnonzero((beams.stamp_s >= begin_s) & (beams.stamp_s < end_s))
            if len(inside) >= _MIN_POINTS:
                window = _Window(beams, inside, navigation, yaw_rad)
                if window.is_usable:
                    windows.append(window)
        self._windows = windows if len(windows) >= _MIN_WINDOWS else []

    @property
    def num_windows(self) -> int:
        """Spans in which turns can be compared; 0 where they are too few."""
        return len(self._windows)

    def score(self, reading: TurningReading, width_m: float = _FINE_M) -> TurningFit:
        """How well echoes meet by a reading."""
        return TurningFit(reading, np.array([w.score(reading, width_m) for w in self._windows]))

    def best(self, side: int) -> TurningFit:
        """The best of all offsets and delays."""
        readings = (
            TurningReading(offset, side, delay_s)
            for offset in np.radians(np.arange(-180.0, 180.0, 10.0))
            for delay_s in (-1.0, 0.0, 1.0)
        )
        return self.refined(self._best(readings, _COARSE_M).reading)

    def refined(self, reading: TurningReading) -> TurningFit:
        """Climb to the top, with ever finer steps and ever narrower kernels."""
        for width_m, step_rad, step_s in _CLIMB:
            best = self.score(reading, width_m)
            while True:
                here = best.reading
                around = (
                    replace(here, offset_rad=here.offset_rad + i * step_rad, delay_s=delay_s)
                    for i, j in _AROUND
                    if abs(delay_s := round(here.delay_s + j * step_s, 3)) <= MAX_DELAY_S
                )
                better = self._best(around, width_m)
                if better.mean <= best.mean:
                    break
                best = better
            reading = best.reading
        offset = math.remainder(reading.offset_rad, 2.0 * math.pi)
        return TurningFit(replace(reading, offset_rad=offset), best.score)

    def offset_sigma_rad(self, fit: TurningFit) -> float:
        """Standard deviation of the offset, by how much the windows' own ones differ."""
        here = fit.reading
        offsets = here.offset_rad + np.radians(np.arange(-10.0, 10.1, 1.0))
        scores = np.array([self.score(replace(here, offset_rad=o)).score for o in offsets])
        own = offsets[np.argmax(scores, axis=0)]
        spread = 1.48 * float(np.median(np.abs(own - np.median(own))))
        return max(spread, math.radians(1.0)) / math.sqrt(len(own))

    def _best(self, readings: Iterable[TurningReading], width_m: float) -> TurningFit:
        return max((self.score(r, width_m) for r in readings), key=lambda fit: fit.mean)
