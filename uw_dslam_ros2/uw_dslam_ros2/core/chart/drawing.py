"""Pings of all vehicles in one map, each at its own pose."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.chart.bending import Track
from uw_dslam_ros2.core.chart.pings import DrawnPing
from uw_dslam_ros2.core.chart.refine import range_scales, refine_tracks
from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import MAX_MAP_SIDE, UNKNOWN, GridSpec, OccupancyMap, bounds_of
from uw_dslam_ros2.core.mapping.config import OccupancyConfig
from uw_dslam_ros2.core.mapping.drawing.occupancy import SIGHT_CELLS, GrowingGrid
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sparse_cells import Window

__all__ = ["SHARE_AGAINST", "PingTrack", "draw_chart", "refined"]

FloatArray = NDArray[np.float64]

_BLOCK_M, _BLOCK_CELLS = 0.5, 6.0
"""A wall is straight within squares of this side, and as many cells of the map more."""
_BLOCK_SIDE = 2048
"""Cells of the map are summed in squares of this side, one after the other."""
SHARE_AGAINST = 0.4
"""What a ping that looked through a wall says against it: most beams that meet a wall slantwise
miss it, ping after ping. A submap, of a few pings, has to be sure of its walls."""
_FACE_M = 0.05
"""How far from its crest a face is drawn: where cells are larger, each crest takes one of them."""
_ROUNDED = 5
"""Digits kept of metres and radians: an equation's last digits depend on the machine."""


@dataclass(frozen=True, slots=True, eq=False)
class PingTrack:
    """Pings of one vehicle in order of time, and ``T_map_sonar`` (K, 3) of each.

    Ranges are drawn times ``range_scale``. ``drift`` (K, 2) are standard deviations of what the
    path [m] and its heading [rad] gain on one metre there; ``mounting_rad`` is the turn of the
    sonar on its vehicle that is in the poses but not in the recording. ``told_scale`` is that part
    of ``range_scale`` by which ranges are surely too long.
    """

    pings: Sequence[DrawnPing]
    T_map_sonar: FloatArray
    drift: FloatArray | None = None
    range_scale: float = 1.0
    mounting_rad: float = 0.0
    told_scale: float = 1.0

    def __post_init__(self) -> None:
        expected = (len(self.pings), 3)
        if self.T_map_sonar.shape != expected:
            raise InvalidInputError(
                f"T_map_sonar has shape {self.T_map_sonar.shape}, expected {expected}"
            )

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Time of each ping (K,)."""
        return np.array([ping.stamp_ns for ping in self.pings], dtype=np.int64)

    @property
    def times_s(self) -> FloatArray:
        """Since the first ping (K,)."""
        return np.asarray((self.stamps_ns - self.stamps_ns[:1]) * 1e-9, np.float64)

    @property
    def dead_reckoning(self) -> FloatArray | None:
        """Poses of the sonar (K, 3) by navigation alone; None unless all are known."""
        poses = [ping.T_dead_sonar for ping in self.pings if ping.T_dead_sonar is not None]
        if len(poses) < max(2, len(self.pings)):
            return None
        return np.array([pose.as_array() for pose in poses])


def refined(tracks: Sequence[PingTrack], resolution_m: float) -> list[PingTrack]:
    """The same pings where all of them see the same walls; see `refine_tracks`."""
    block_m = _BLOCK_M + _BLOCK_CELLS * resolution_m
    paths = [
        Track(
            t.T_map_sonar, [p.points for p in t.pings], 1.0, t.drift, t.times_s, t.dead_reckoning
        )
        for t in tracks
    ]
    scales = range_scales(paths, resolution_m, block_m)
    scaled = [
        dataclasses.replace(path, range_scale=scale)
        for path, scale in zip(paths, scales, strict=True)
    ]
    found = refine_tracks(scaled, resolution_m, block_m)
    return [
        dataclasses.replace(
            track,
            T_map_sonar=np.round(path.poses, _ROUNDED),
            range_scale=round(scale * path.range_scale, _ROUNDED),
            told_scale=round(scale, _ROUNDED),
            mounting_rad=round(path.mounting_rad, _ROUNDED),
        )
        for track, path, scale in zip(tracks, found, scales, strict=True)
    ]


def draw_chart(
    tracks: Sequence[PingTrack], config: OccupancyConfig, log_odds_max: float
) -> OccupancyMap | None:
    """Draw all pings in one map, whose lattice goes through the frame's zero; None without any.

    Parameters
    ----------
    config
        Grid and sensor model.
    log_odds_max
        Limit of a cell's log-odds.

    Raises
    ------
    InvalidInputError
        If the map would be too large.
    """
    pings = [
        (ping, track.range_scale, SE2.from_array(pose))
        for track in tracks
        for ping, pose in zip(track.pings, track.T_map_sonar, strict=True)
    ]
    if not pings:
        return None
    lattice = GrowingGrid(config)
    reach = [lattice.reach_of(ping.detections(scale), motion) for ping, scale, motion in pings]
    whole = functools.reduce(Window.union, reach)
    if max(whole.shape) > MAX_MAP_SIDE:
        raise InvalidInputError(
            f"the chart would have {whole.shape[0]} x {whole.shape[1]} cells of "
            f"{config.resolution_m:g} m, expected at most {MAX_MAP_SIDE} a side"
        )
    values = np.full(whole.shape, UNKNOWN, np.int8)
    face_cells = min(1.0, max(0.5, _FACE_M / config.resolution_m))
    for block in _blocks(whole):
        near = [p for p, own in zip(pings, reach, strict=True) if _meet(own, block)]
        if near:
            grid = GrowingGrid(config, _grown(block), SHARE_AGAINST, face_cells)
            for ping, scale, motion in near:
                grid.add(ping.detections(scale), motion)
            drawn, percent = grid.percent(log_odds_max)
            common = drawn.intersection(block)
            if min(common.shape) > 0:
                values[common.slices(whole)] = percent[common.slices(drawn)]
    return _trimmed(whole, values, config.resolution_m)


def _blocks(whole: Window) -> Iterator[Window]:
    """Squares that cover it: what is summed takes ten times the room of what is drawn."""
    for row in range(whole.row_0, whole.row_1, _BLOCK_SIDE):
        for col in range(whole.col_0, whole.col_1, _BLOCK_SIDE):
            yield Window(row, col, row + _BLOCK_SIDE, col + _BLOCK_SIDE).intersection(whole)


def _grown(block: Window) -> Window:
    return Window(
        block.row_0 - SIGHT_CELLS,
        block.col_0 - SIGHT_CELLS,
        block.row_1 + SIGHT_CELLS,
        block.col_1 + SIGHT_CELLS,
    )


def _meet(reach: Window, block: Window) -> bool:
    return min(reach.intersection(_grown(block)).shape) > 0


def _trimmed(whole: Window, values: NDArray[np.int8], resolution_m: float) -> OccupancyMap:
    """What is known, at least one cell."""
    box = bounds_of(values != UNKNOWN)
    row, col = (0, 0) if box is None else (whole.row_0 + box[0].start, whole.col_0 + box[1].start)
    known = np.full((1, 1), UNKNOWN, np.int8) if box is None else values[box].copy()
    corner = SE2(col * resolution_m, row * resolution_m)
    num_rows, num_cols = known.shape
    return OccupancyMap(GridSpec(resolution_m, num_rows, num_cols, corner), known)
