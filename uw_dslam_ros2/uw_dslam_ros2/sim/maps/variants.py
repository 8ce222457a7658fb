"""The same pair of maps told otherwise: what no answer of a registration may depend on."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.grid import FREE, OCCUPIED, UNKNOWN, GridSpec, OccupancyMap
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.maps.pairs import MapPair

__all__ = [
    "VARIANTS",
    "coarser",
    "coarser_pair",
    "doubled",
    "mirrored",
    "turned",
    "with_margins",
    "with_specks",
]

Values = NDArray[np.int8]
_UTM = SE2(412_345.6, 5_312_345.7, 0.8)
_NUM_SPECKS = 12
_SPECK_CELLS = 2
_FAR_CELLS = 900


def with_margins(
    occupancy: OccupancyMap, left: int, right: int, low: int, high: int
) -> OccupancyMap:
    """A map on a larger canvas, with so many unknown cells added on each side."""
    margins = ((low, high), (left, right))
    values = np.pad(occupancy.values, margins, constant_values=UNKNOWN)
    return _placed(occupancy, values, -float(left), -float(low))


def with_specks(occupancy: OccupancyMap, seed: int) -> OccupancyMap:
    """A map with a few free and occupied cells far outside of it, as stray echoes leave them."""
    rng = np.random.default_rng(seed)
    wide = with_margins(occupancy, *rng.integers(_FAR_CELLS // 2, _FAR_CELLS, 4).tolist())
    values = wide.values.copy()
    for row, col in rng.integers(0, _FAR_CELLS // 2 - _SPECK_CELLS, (_NUM_SPECKS, 2)):
        values[row : row + _SPECK_CELLS, col : col + _SPECK_CELLS] = rng.choice([FREE, OCCUPIED])
    return OccupancyMap(wide.spec, values)


def turned(occupancy: OccupancyMap) -> OccupancyMap:
    """The same map in the same frame, its rows along what were its columns."""
    spec = occupancy.spec
    corner = spec.T_frame_grid @ SE2(spec.num_cols * spec.resolution_m, 0.0, 0.5 * math.pi)
    values = np.ascontiguousarray(np.rot90(occupancy.values))
    return OccupancyMap(GridSpec(spec.resolution_m, spec.num_cols, spec.num_rows, corner), values)


def doubled(occupancy: OccupancyMap) -> OccupancyMap:
    """The same map on cells half as large."""
    values = np.kron(occupancy.values, np.ones((2, 2), np.int8))
    spec = _of_values(occupancy.spec, values, 0.5 * occupancy.spec.resolution_m)
    return OccupancyMap(spec, values)


def coarser(occupancy: OccupancyMap, times: int) -> OccupancyMap:
    """The same map on cells so many times as large, a wall where any that it is made of is one."""
    rows, cols = (size // times for size in occupancy.spec.shape)
    cut = occupancy.values[: rows * times, : cols * times]
    blocks = cut.reshape(rows, times, cols, times)
    values = np.ascontiguousarray(blocks.max(axis=(1, 3)))
    spec = _of_values(occupancy.spec, values, times * occupancy.spec.resolution_m)
    return OccupancyMap(spec, values)


def mirrored(occupancy: OccupancyMap) -> OccupancyMap:
    """What a vehicle would map that takes left for right."""
    return OccupancyMap(occupancy.spec, np.ascontiguousarray(occupancy.values[:, ::-1]))


def _of_values(spec: GridSpec, values: Values, resolution_m: float) -> GridSpec:
    """The specification of these values from the same corner."""
    num_rows, num_cols = values.shape
    return GridSpec(resolution_m, num_rows, num_cols, spec.T_frame_grid)


def _placed(occupancy: OccupancyMap, values: Values, col: float, row: float) -> OccupancyMap:
    spec = occupancy.spec
    corner = spec.T_frame_grid @ SE2(col * spec.resolution_m, row * spec.resolution_m)
    num_rows, num_cols = values.shape
    return OccupancyMap(GridSpec(spec.resolution_m, num_rows, num_cols, corner), values)


def _both(change: Callable[[OccupancyMap], OccupancyMap]) -> Callable[[MapPair], MapPair]:
    return lambda pair: replace(pair, source=change(pair.source), target=change(pair.target))


def _exchanged(pair: MapPair) -> MapPair:
    truth = pair.T_target_source
    inverse = None if truth is None else truth.inverse()
    return replace(pair, source=pair.target, target=pair.source, T_target_source=inverse)


def _moved(pair: MapPair) -> MapPair:
    """The target's frame is moved to coordinates as of UTM, the source's is turned."""
    turn = SE2(-3.0, 8.0, 2.2)

    def moved(occupancy: OccupancyMap, T: SE2) -> OccupancyMap:
        spec = occupancy.spec
        return OccupancyMap(
            GridSpec(spec.resolution_m, *spec.shape, T @ spec.T_frame_grid), occupancy.values
        )

    truth = pair.T_target_source
    return replace(
        pair,
        source=moved(pair.source, turn),
        target=moved(pair.target, _UTM),
        T_target_source=None if truth is None else _UTM @ truth @ turn.inverse(),
    )


def coarser_pair(times: int) -> Callable[[MapPair], MapPair]:
    """The change of both maps to cells so many times as large."""
    return _both(lambda occupancy: coarser(occupancy, times))


VARIANTS: dict[str, Callable[[MapPair], MapPair]] = {
    "margins about both": _both(lambda m: with_margins(m, 37, 410, 205, 3)),
    "a canvas of 4000 cells about the source": lambda pair: replace(
        pair, source=with_margins(pair.source, 2600, 1400, 900, 3100)
    ),
    "a quarter turn of both": _both(turned),
    "a quarter turn of the source": lambda pair: replace(pair, source=turned(pair.source)),
    "origins far away and turned": _moved,
    "exchanged": _exchanged,
    "specks far away": lambda pair: replace(pair, source=with_specks(pair.source, 1)),
    "cells half as large": _both(doubled),
    "cells twice as large": coarser_pair(2),
}
"""Changes of a pair, by name; the truth of the pair is changed with it."""
