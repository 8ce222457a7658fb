"""A look into one answer: both maps laid on each other, and where their walls agree."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import UNKNOWN, GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging.config import LOG_ODDS_MAX
from uw_dslam_ros2.core.merging.graph.answers import Query
from uw_dslam_ros2.core.merging.graph.submap_groups import StoredSubmap, SubmapGroup, render_group
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sparse_cells import Window
from uw_dslam_ros2.core.submap import SubmapId

__all__ = ["KEY", "PAIR_LAYERS", "Pair", "lay_on", "map_picture", "pair_of", "rendered"]

ByteArray = NDArray[np.uint8]

PAIR_LAYERS = ("target", "source", "agreement")
_WALL_PERCENT, _FREE_PERCENT = 65, 20
_REACH_CELLS = 2
"""Walls so near are the same wall to the eye: their own thickness."""
_MARGIN_CELLS = 4
_CLEAR = 90  # opacity, of 255
# Okabe and Ito's colours, which colour-blind people tell apart: red, green, blue, opacity. What
# tells more comes later: it outlasts the others where cells become fewer.
_COLOURS = {
    "unknown": (0, 0, 0, 0),
    "free": (226, 232, 237, 255),
    "target": (86, 180, 233, 255),
    "source": (230, 159, 0, 255),
    "agree": (0, 78, 56, 255),
    "conflict": (204, 40, 0, 255),
}
_INDEX = {name: index for index, name in enumerate(_COLOURS)}
_TABLE = np.array(list(_COLOURS.values()), np.uint8)

KEY = {
    "walls of both": _COLOURS["agree"],
    "wall of one in free water of the other": _COLOURS["conflict"],
    "walls of the target alone": _COLOURS["target"],
    "walls of the source alone": _COLOURS["source"],
}
"""What the colours of agreement mean; the same in the view, the report and ``register``."""


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Two maps on one lattice, int8 (R, C) each as in `OccupancyMap`; rows grow with y."""

    spec: GridSpec
    target: NDArray[np.int8]
    source: NDArray[np.int8]

    def picture(self, layer: str, max_side: int | None = None) -> bytes:
        """PNG of one layer, north up; see `PAIR_LAYERS`.

        With `max_side` that of agreement has no more pixels a side: walls outlast the rest.
        """
        if layer != "agreement":
            return map_picture(self.target if layer == "target" else self.source, layer)
        return _png(self._told(max_side), _TABLE)

    def agreement(self) -> ByteArray:
        """(R, C, 4) red, green, blue, opacity: what agrees and what conflicts, see `KEY`."""
        return _TABLE[self._told(None)]

    def _told(self, max_side: int | None) -> ByteArray:
        """Of each cell the index of its colour."""
        maps = self.target, self.source
        walls = self.target >= _WALL_PERCENT, self.source >= _WALL_PERCENT
        told = ((self.target >= 0) | (self.source >= 0)).astype(np.uint8) * _INDEX["free"]
        side = 2 * _REACH_CELLS + 1
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
        near = [cv2.dilate(wall.astype(np.uint8), kernel).astype(bool) for wall in walls]
        for own, other, name in ((0, 1, "target"), (1, 0, "source")):
            told[walls[own]] = _INDEX[name]
            is_free = (maps[other] >= 0) & (maps[other] <= _FREE_PERCENT)
            told[walls[own] & is_free & ~near[other]] = _INDEX["conflict"]
        told[(walls[0] & near[1]) | (walls[1] & near[0])] = _INDEX["agree"]
        if max_side is not None:
            told = _reduced(told, math.ceil(max(told.shape) / max_side))
        return told.astype(np.uint8)


def _reduced(values: ByteArray, step: int) -> ByteArray:
    """The largest of each square of cells."""
    rows, cols = (-(-side // step) for side in values.shape)
    even = np.zeros((rows * step, cols * step), np.uint8)
    even[: values.shape[0], : values.shape[1]] = values
    return np.asarray(even.reshape(rows, step, cols, step).max(axis=(1, 3)))


def map_picture(values: NDArray[np.int8], layer: str, *, is_clear: bool = False) -> bytes:
    """PNG of a map in the colour of a layer, ``source`` or ``target``, north up.

    Parameters
    ----------
    values
        (R, C), as in `OccupancyMap`.
    layer
        Whose colour its walls have.
    is_clear
        Let what lies below shine through free water.
    """
    if layer not in ("source", "target"):
        raise InvalidInputError(f"layer is {layer!r}, expected source or target")
    told = (values >= 0).astype(np.uint8) * np.uint8(_INDEX["free"])
    told[values >= _WALL_PERCENT] = _INDEX[layer]
    table = _TABLE.copy()
    if is_clear:
        table[_INDEX["free"], 3] = _CLEAR
    return _png(told, table)


def _png(told: ByteArray, table: ByteArray) -> bytes:
    """PNG with a palette (K, 4), north up: a quarter of the size."""
    picture = Image.fromarray(np.ascontiguousarray(told[::-1])).convert("P")
    picture.putpalette(table[:, :3].tobytes())
    buffer = io.BytesIO()
    # A page waits for it: the last tenth of the bytes costs most of the time.
    picture.save(buffer, "PNG", transparency=table[:, 3].tobytes(), compress_level=4)
    return buffer.getvalue()


def pair_of(query: Query, T_target_source: SE2, submaps: Mapping[SubmapId, StoredSubmap]) -> Pair:
    """Both maps of a question laid on each other.

    Raises
    ------
    InvalidInputError
        If a submap of it is missing, or a map is empty.
    """
    source, target = rendered(query.source, submaps), rendered(query.target, submaps)
    return lay_on(target, source, T_target_source)


def rendered(group: SubmapGroup, submaps: Mapping[SubmapId, StoredSubmap]) -> OccupancyMap:
    """The map of a group; an error where its submaps are not here, or empty."""
    missing = [str(submap_id) for submap_id in group.ids if submap_id not in submaps]
    if missing:
        raise InvalidInputError(f"the submaps {', '.join(missing)} are not here any more")
    occupancy = render_group(group, submaps, LOG_ODDS_MAX)
    if occupancy is None:
        raise InvalidInputError("the map of this pair is empty")
    return occupancy


def lay_on(target: OccupancyMap, source: OccupancyMap, T_target_source: SE2) -> Pair:
    """Lay the source on the target's lattice, as far as either knows something."""
    spec = target.spec
    # Corners of the source in cells of the target.
    T_grid_source = spec.T_frame_grid.inverse() @ T_target_source
    corners = T_grid_source.apply(source.spec.corners()) / spec.resolution_m
    low = np.floor(np.minimum(corners.min(axis=0), 0.0)).astype(int) - _MARGIN_CELLS
    size = np.array([spec.num_cols, spec.num_rows])
    high = np.ceil(np.maximum(corners.max(axis=0), size)).astype(int) + _MARGIN_CELLS
    window = Window(int(low[1]), int(low[0]), int(high[1]), int(high[0]))
    laid = spec.part(window.row_0, window.col_0, *window.shape)
    own = np.full(laid.shape, UNKNOWN, np.int8)
    own[
        -window.row_0 : spec.num_rows - window.row_0, -window.col_0 : spec.num_cols - window.col_0
    ] = target.values
    other = _resampled(source, T_target_source.inverse(), laid)
    known = (own != UNKNOWN) | (other != UNKNOWN)
    if not known.any():
        return Pair(laid, own, other)
    (row_0, row_1), (col_0, col_1) = (_span(known.any(axis=axis)) for axis in (1, 0))
    shown = slice(row_0, row_1), slice(col_0, col_1)
    spec = laid.part(row_0, col_0, row_1 - row_0, col_1 - col_0)
    return Pair(spec, own[shown].copy(), other[shown].copy())


def _span(known: NDArray[np.bool_]) -> tuple[int, int]:
    """First, and one past the last, with a margin where there is room for one."""
    found = np.flatnonzero(known)
    return max(0, int(found[0]) - _MARGIN_CELLS), min(
        len(known), int(found[-1]) + _MARGIN_CELLS + 1
    )


def _resampled(source: OccupancyMap, T_source_target: SE2, laid: GridSpec) -> NDArray[np.int8]:
    T = source.spec.T_frame_grid.inverse() @ T_source_target @ laid.T_frame_grid
    scale = laid.resolution_m / source.spec.resolution_m
    c, s = np.cos(T.yaw) * scale, np.sin(T.yaw) * scale
    x, y = T.x / source.spec.resolution_m, T.y / source.spec.resolution_m
    # Centres to centres: a cell's middle lies half a cell from its corner on both sides.
    matrix = np.array(
        [[c, -s, x + 0.5 * (c - s) - 0.5], [s, c, y + 0.5 * (s + c) - 0.5]], dtype=np.float64
    )
    found = cv2.warpAffine(
        (source.values.astype(np.int16) + 1).astype(np.uint8),
        matrix,
        (laid.num_cols, laid.num_rows),
        flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=0,
    )
    return (found.astype(np.int16) - 1).astype(np.int8)
