"""Occupancy grids that grow as pings come in."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import (
    UNITS_PER_NAT,
    UNKNOWN,
    bounds_of,
    percent_table,
    strips_of,
)
from uw_dslam_ros2.core.mapping.config import OccupancyConfig
from uw_dslam_ros2.core.mapping.drawing.face_kernels import draw_faces
from uw_dslam_ros2.core.mapping.drawing.grid_kernels import NUM_DIRECTIONS, add_ping, beam_table
from uw_dslam_ros2.core.mapping.drawing.log_odds_grid import LogOddsGrid, percent_of
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar.types import Detections
from uw_dslam_ros2.core.sparse_cells import Window

__all__ = ["SIGHT_CELLS", "GrowingGrid"]

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_MAX_SPREAD_M = 0.5
"""Largest half width of an echo across the beam: far off, a wide one would paint whole arcs."""

_LEAST_SIGMA_CELLS = 0.8
"""Least spread of an echo: a narrower heap of echoes has no shape on the lattice."""
_SMOOTHING = np.array([math.comb(8, k) for k in range(9)], np.int64)
"""In the form of a Gaussian of 1.4 cells, about as wide as the echoes of one face scatter."""
_MARGIN_CELLS = len(_SMOOTHING) // 2 + 1
_SMOOTHING_GAIN = math.sqrt(1.0 + 2.0 / _LEAST_SIGMA_CELLS**2)
"""Keeps the height of a long wall; a lone echo sinks to half of what it said."""
_TAIL_REACH_CELLS, _TAIL_SHARE = 6, 0.3
"""A crest so much lower than what lies so near is a tail of that."""
SIGHT_CELLS = _TAIL_REACH_CELLS + _MARGIN_CELLS
"""What lies farther off does not count for a cell."""

# Growing means copying everything, so it goes in long steps.
_TILE = 256


class GrowingGrid:
    """Evidence on a lattice through the frame's zero: of echoes, and of water looked through.

    It grows by whole tiles, so cells never move by fractions. Both are kept apart until a map is
    drawn, because where a wall's face lies is seen from all its echoes together only.

    Parameters
    ----------
    config
        Grid and sensor model.
    only
        Lattice cells that are looked at, however far pings reach; None: all.
    share_against
        A ping that looked through a wall's face counts against it with that share of what it
        says of water.
    face_cells
        How far from the crest of the echoes a cell still belongs to a wall's face.
    """

    def __init__(
        self,
        config: OccupancyConfig = OccupancyConfig(),  # noqa: B008 (frozen)
        only: Window | None = None,
        share_against: float = 1.0,
        face_cells: float = 1.0,
    ) -> None:
        self._config = config
        self._face_cells = face_cells
        self._share_against = share_against
        self._is_fixed = only is not None
        window = only or Window(0, 0, 0, 0)
        self._row, self._col = window.row_0, window.col_0
        self._echoes = np.zeros(window.shape, np.int32)
        self._water = np.zeros(window.shape, np.int32)
        self._scratch = np.zeros(window.shape, np.int16)
        self.num_pings = 0

    def add(self, detections: Detections, T_frame_sonar: SE2) -> None:
        """Add one ping, seen from ``T_frame_sonar``."""
        config = self._config
        free_range = self._free_range_m(detections)
        if not self._is_fixed:
            self._grow_to(self.reach_of(detections, T_frame_sonar))
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

    def reach_of(self, detections: Detections, T_frame_sonar: SE2) -> Window:
        """Lattice cells that a ping may touch."""
        config = self._config
        reach_m = float(self._free_range_m(detections).max(initial=0.0))
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
        col_0, row_0 = np.floor(low / config.resolution_m).astype(np.int64).tolist()
        col_1, row_1 = np.floor(high / config.resolution_m).astype(np.int64).tolist()
        return Window(row_0, col_0, row_1 + 1, col_1 + 1)

    def trimmed(self) -> LogOddsGrid:
        """The observed part as a map, at least one cell."""
        reached, window = self._reached()
        shape, resolution_m = reached.shape, self._config.resolution_m
        log_odds, observed = np.zeros(shape, np.int32), np.zeros(shape, np.bool_)
        for rows, *band in self._bands(window):
            log_odds[rows], observed[rows] = band
        return LogOddsGrid(
            log_odds, observed, reached.row_0, reached.col_0, resolution_m
        ).trimmed()

    def percent(self, log_odds_max: float) -> tuple[Window, NDArray[np.int8]]:
        """Probability in percent, -1 where nothing was observed, of the lattice cells reached."""
        reached, window = self._reached()
        values, table = np.full(reached.shape, UNKNOWN, np.int8), percent_table(log_odds_max)
        for rows, log_odds, observed in self._bands(window):
            values[rows] = percent_of(log_odds, observed, table)
        return reached, values

    def _reached(self) -> tuple[Window, tuple[slice, slice]]:
        """Where all that can be drawn lies: on the lattice, and in the arrays."""
        box = bounds_of((self._echoes > 0) | (self._water > 0))
        rows, cols = box or (slice(0, 0), slice(0, 0))
        if box is not None:
            # A heap of echoes is wider than the cells that they lie in.
            rows, cols = (
                slice(max(0, own.start - _MARGIN_CELLS), min(num, own.stop + _MARGIN_CELLS))
                for own, num in zip(box, self._echoes.shape, strict=True)
            )
        row, col = self._row, self._col
        reached = Window(row + rows.start, col + cols.start, row + rows.stop, col + cols.stop)
        return reached, (rows, cols)

    def _bands(
        self, window: tuple[slice, slice]
    ) -> Iterator[tuple[slice, NDArray[np.int32], BoolArray]]:
        """What is drawn, by bands of rows: which, their log-odds, and what of them is observed."""
        free = self._config.free_log_odds * UNITS_PER_NAT
        echoes, water = self._echoes[window], self._water[window]
        for rows, around, inside in strips_of(len(echoes), SIGHT_CELLS):
            log_odds, observed = draw_faces(
                echoes[around],
                water[around],
                _SMOOTHING,
                _SMOOTHING_GAIN,
                round(free),
                round(self._share_against * free),
                self._face_cells,
                _TAIL_REACH_CELLS,
                _TAIL_SHARE,
            )
            yield rows, log_odds[inside], observed[inside]

    def _free_range_m(self, detections: Detections) -> FloatArray:
        config = self._config
        free_range = np.minimum(
            detections.free_range_m - config.free_margin_m, config.free_range_max_m
        )
        return np.maximum(free_range, 0.0)

    def _grow_to(self, reach: Window) -> None:
        first, last = (reach.row_0, reach.col_0), (reach.row_1 - 1, reach.col_1 - 1)
        num_rows, num_cols = self._echoes.shape
        if self._echoes.size:
            old_last = (self._row + num_rows - 1, self._col + num_cols - 1)
            first = min(first[0], self._row), min(first[1], self._col)
            last = max(last[0], old_last[0]), max(last[1], old_last[1])
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
