"""Occupancy grids that grow as pings come in."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import (
    UNITS_PER_NAT,
    UNKNOWN,
    UNSEEN,
    GridSpec,
    OccupancyMap,
    percent_table,
)
from uw_dslam_ros2.core.mapping.config import OccupancyConfig
from uw_dslam_ros2.core.mapping.grid_kernels import (
    NUM_DIRECTIONS,
    add_ping,
    beam_table,
    draw_faces,
)
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar.types import Detections

__all__ = ["CompressedGrid", "GrowingGrid", "LogOddsGrid"]

_MAX_SPREAD_M = 0.5
"""Largest half width of an echo across the beam: far off, a wide one would paint whole arcs."""

_LEAST_SIGMA_CELLS = 0.8
"""Least spread of an echo: a narrower heap of echoes has no shape on the lattice."""
_FACE_CELLS = 1.0
"""How far from the crest of the echoes a cell still belongs to a wall's face."""
_SMOOTHING = np.array([math.comb(8, k) for k in range(9)], np.int64)
"""In the form of a Gaussian of 1.4 cells, about as wide as the echoes of one face scatter."""
_MARGIN_CELLS = len(_SMOOTHING) // 2 + 1
_SMOOTHING_GAIN = math.sqrt(1.0 + 2.0 / _LEAST_SIGMA_CELLS**2)
"""Keeps the height of a long wall; a lone echo sinks to half of what it said."""
_TAIL_REACH_CELLS, _TAIL_SHARE = 6, 0.3
"""A crest so much lower than what lies so near is a tail of that."""

# Growing means copying everything, so it goes in long steps.
_TILE = 256


@dataclass(frozen=True, slots=True, eq=False)
class LogOddsGrid:
    """A drawn grid: integer log-odds (R, C) and mask.

    Its cell (0, 0) lies at lattice cell `row`, `col`.
    """

    log_odds: NDArray[np.int32]
    observed: NDArray[np.bool_]
    row: int
    col: int
    resolution_m: float

    @property
    def spec(self) -> GridSpec:
        """Where it lies."""
        return _spec_of(self.log_odds.shape, self.row, self.col, self.resolution_m)

    def units(self) -> NDArray[np.int16]:
        """Log-odds (R, C), cut at 32 nats; `UNSEEN` where nothing was observed."""
        return np.where(self.observed, np.clip(self.log_odds, -32767, 32767), UNSEEN).astype(
            np.int16
        )

    def trimmed(self) -> LogOddsGrid:
        """A copy of the observed part, at least one cell."""
        rows = np.flatnonzero(self.observed.any(axis=1))
        cols = np.flatnonzero(self.observed.any(axis=0))
        if len(rows) == 0:
            nothing = np.zeros((1, 1), np.int32), np.zeros((1, 1), np.bool_)
            return LogOddsGrid(*nothing, 0, 0, self.resolution_m)
        window = (slice(rows[0], rows[-1] + 1), slice(cols[0], cols[-1] + 1))
        return LogOddsGrid(
            self.log_odds[window].copy(),
            self.observed[window].copy(),
            self.row + int(rows[0]),
            self.col + int(cols[0]),
            self.resolution_m,
        )

    def to_occupancy(self, log_odds_max: float) -> OccupancyMap:
        """Probability in percent."""
        table = percent_table(log_odds_max)
        limit = len(table) // 2
        values = table[np.clip(self.log_odds, -limit, limit) + limit]
        return OccupancyMap(self.spec, np.where(self.observed, values, np.int8(UNKNOWN)))

    def compressed(self) -> CompressedGrid:
        """Compressed for keeping; log-odds are cut at 32 nats."""
        data = zlib.compress(self.units().tobytes(), 1)
        return CompressedGrid(data, self.log_odds.shape, self.row, self.col, self.resolution_m)


@dataclass(frozen=True, slots=True, eq=False)
class CompressedGrid:
    """`LogOddsGrid` at a twentieth of its size."""

    data: bytes
    shape: tuple[int, int]
    row: int
    col: int
    resolution_m: float

    @property
    def spec(self) -> GridSpec:
        """Where it lies."""
        return _spec_of(self.shape, self.row, self.col, self.resolution_m)

    def units(self) -> NDArray[np.int16]:
        """Log-odds (R, C); `UNSEEN` where nothing was observed."""
        return np.frombuffer(zlib.decompress(self.data), np.int16).reshape(self.shape).copy()

    def decompressed(self) -> LogOddsGrid:
        """The grid again."""
        units = self.units()
        observed = units != UNSEEN
        log_odds = np.where(observed, units, 0).astype(np.int32)
        return LogOddsGrid(log_odds, observed, self.row, self.col, self.resolution_m)


def _spec_of(shape: tuple[int, int], row: int, col: int, resolution_m: float) -> GridSpec:
    return GridSpec(resolution_m, *shape, SE2(col * resolution_m, row * resolution_m))


class GrowingGrid:
    """Evidence on a lattice through the frame's zero: of echoes, and of water looked through.

    It grows by whole tiles, so cells never move by fractions. Both are kept apart until a map is
    drawn, because where a wall's face lies is seen from all its echoes together only.
    """

    def __init__(self, config: OccupancyConfig = OccupancyConfig()) -> None:  # noqa: B008 (frozen)
        self._config = config
        self._row, self._col = 0, 0
        self._echoes = np.zeros((0, 0), np.int32)
        self._water = np.zeros((0, 0), np.int32)
        self._scratch = np.zeros((0, 0), np.int16)
        self.num_pings = 0

    def add(self, detections: Detections, T_frame_sonar: SE2) -> None:
        """Add one ping, seen from ``T_frame_sonar``."""
        config = self._config
        free_range = np.minimum(
            detections.free_range_m - config.free_margin_m, config.free_range_max_m
        )
        free_range = np.maximum(free_range, 0.0)
        self._grow_for(detections, T_frame_sonar, float(free_range.max(initial=0.0)))
        beams = beam_table(detections.bearing_rad, 0.75 * detections.beamwidth_rad, NUM_DIRECTIONS)
        add_ping(
            self._echoes, self._water, self._scratch, self._row, self._col,
            config.resolution_m, T_frame_sonar.x, T_frame_sonar.y, T_frame_sonar.yaw,
            detections.points, detections.weight,
            detections.range_sigma_m, detections.beamwidth_rad, _MAX_SPREAD_M,
            _LEAST_SIGMA_CELLS * config.resolution_m,
            beams, free_range, config.hit_log_odds * UNITS_PER_NAT,
        )  # fmt: skip
        self.num_pings += 1

    def trimmed(self) -> LogOddsGrid:
        """The observed part as a map, at least one cell."""
        config = self._config
        seen = (self._echoes > 0) | (self._water > 0)
        rows, cols = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
        if len(rows) == 0:
            nothing = np.zeros((1, 1), np.int32), np.zeros((1, 1), np.bool_)
            return LogOddsGrid(*nothing, 0, 0, config.resolution_m)
        # A heap of echoes is wider than the cells that they lie in.
        row, col = (max(0, int(seen[0]) - _MARGIN_CELLS) for seen in (rows, cols))
        window = slice(row, rows[-1] + 1 + _MARGIN_CELLS), slice(col, cols[-1] + 1 + _MARGIN_CELLS)
        log_odds, observed = draw_faces(
            self._echoes[window],
            self._water[window],
            _SMOOTHING,
            _SMOOTHING_GAIN,
            round(config.free_log_odds * UNITS_PER_NAT),
            _FACE_CELLS,
            _TAIL_REACH_CELLS,
            _TAIL_SHARE,
        )
        drawn = LogOddsGrid(
            log_odds, observed, self._row + row, self._col + col, config.resolution_m
        )
        return drawn.trimmed()

    def _grow_for(self, detections: Detections, T_frame_sonar: SE2, reach_m: float) -> None:
        config = self._config
        points = T_frame_sonar.apply(detections.points)
        margin = 3.0 * (_MAX_SPREAD_M + detections.range_sigma_m)
        margin += (1 + _MARGIN_CELLS) * config.resolution_m
        here = np.array([[T_frame_sonar.x, T_frame_sonar.y]])
        low = np.vstack([points - margin, here - reach_m]).min(axis=0)
        high = np.vstack([points + margin, here + reach_m]).max(axis=0)
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise InvalidInputError(
                "a ping reaches to infinity, expected finite points and ranges"
            )
        first = np.floor(low / config.resolution_m).astype(np.int64)[::-1]
        last = np.floor(high / config.resolution_m).astype(np.int64)[::-1]
        num_rows, num_cols = self._echoes.shape
        if self._echoes.size:
            old_last = (self._row + num_rows - 1, self._col + num_cols - 1)
            first = np.minimum(first, (self._row, self._col))
            last = np.maximum(last, old_last)
        row, col = (math.floor(v / _TILE) * _TILE for v in first)
        rows, cols = (
            math.ceil((v + 1) / _TILE) * _TILE - start
            for v, start in zip(last, (row, col), strict=True)
        )
        if (row, col, rows, cols) == (self._row, self._col, num_rows, num_cols):
            return
        echoes, water = np.zeros((rows, cols), np.int32), np.zeros((rows, cols), np.int32)
        if self._echoes.size:
            window = (
                slice(self._row - row, self._row - row + num_rows),
                slice(self._col - col, self._col - col + num_cols),
            )
            echoes[window], water[window] = self._echoes, self._water
        self._row, self._col, self._echoes, self._water = row, col, echoes, water
        self._scratch = np.zeros((rows, cols), np.int16)
