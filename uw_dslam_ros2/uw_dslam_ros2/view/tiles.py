"""Pictures of maps in square tiles, for any zoom."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["TILE_PIXELS", "Layer", "colours_of_percent", "png_bytes", "tile_png"]

ByteArray = NDArray[np.uint8]

TILE_PIXELS = 256
_FREE = (247, 249, 250)  # red, green, blue
_WALL = (22, 38, 54)


def colours_of_percent() -> ByteArray:
    """(102, 4) red, green, blue, opacity of a stored cell: 0 unknown, else percent + 1."""
    share = np.linspace(0.0, 1.0, 101)[:, None]
    table = np.zeros((102, 4), np.uint8)
    table[1:, :3] = np.rint((1.0 - share) * np.array(_FREE) + share * np.array(_WALL))
    table[1:, 3] = 255
    return table


_COLOURS = colours_of_percent()


@dataclass(frozen=True, eq=False)
class Layer:
    """A map and where it is shown.

    ``T_view_map`` takes the map's frame to that of the page, in which groups that are not joined
    stand side by side.
    """

    occupancy: OccupancyMap
    T_view_map: SE2 = SE2()

    @cached_property
    def levels(self) -> list[ByteArray]:
        """Stored cells, each level half as fine as the one before; walls outlast the rest."""
        values = self.occupancy.values
        levels = [(values.astype(np.int16) + 1).astype(np.uint8)]
        while max(levels[-1].shape) > 1:
            fine = levels[-1]
            rows, cols = -(-fine.shape[0] // 2), -(-fine.shape[1] // 2)
            even = np.zeros((2 * rows, 2 * cols), np.uint8)
            even[: fine.shape[0], : fine.shape[1]] = fine
            levels.append(even.reshape(rows, 2, cols, 2).max(axis=(1, 3)))
        return levels

    def sampled(
        self, x_m: NDArray[np.float64], y_m: NDArray[np.float64], pixel_m: float
    ) -> ByteArray:
        """Stored cells under places (N,) of the page, at the level that suits a pixel's size."""
        spec = self.occupancy.spec
        # Cells no smaller than pixels, so that none is passed over.
        level = math.ceil(math.log2(max(pixel_m / spec.resolution_m, 1.0)) - 1e-9)
        level = min(level, len(self.levels) - 1)
        cells = self.levels[level]
        T_grid_view = (self.T_view_map @ spec.T_frame_grid).inverse()
        local = T_grid_view.apply(np.column_stack([x_m, y_m])) / (spec.resolution_m * 2**level)
        col, row = np.floor(local).astype(np.int64).T
        inside = (row >= 0) & (col >= 0) & (row < cells.shape[0]) & (col < cells.shape[1])
        found = np.zeros(len(row), np.uint8)
        found[inside] = cells[row[inside], col[inside]]
        return found

    def bounds(self) -> tuple[float, float, float, float]:
        """``x_min, y_min, x_max, y_max`` [m] on the page."""
        return bounds_of(self.occupancy.spec, self.T_view_map)


def bounds_of(spec: GridSpec, T_view_frame: SE2) -> tuple[float, float, float, float]:
    """Rectangle around a grid, ``x_min, y_min, x_max, y_max`` [m]."""
    corners = T_view_frame.apply(spec.corners())
    low, high = corners.min(axis=0), corners.max(axis=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def tile_png(layers: Sequence[Layer], zoom: int, col: int, row: int) -> bytes | None:
    """One tile as PNG; None where nothing is known.

    A pixel is 2^-zoom metres; tile (0, 0) has its upper left corner at the page's origin, columns
    grow with x, rows against y.
    """
    pixel_m = 2.0**-zoom
    side_m = TILE_PIXELS * pixel_m
    x_min, y_max = col * side_m, -row * side_m
    centers = (np.arange(TILE_PIXELS) + 0.5) * pixel_m
    x, y = np.meshgrid(x_min + centers, y_max - centers)
    shown = np.zeros(TILE_PIXELS * TILE_PIXELS, np.uint8)
    for layer in layers:
        low_x, low_y, high_x, high_y = layer.bounds()
        if low_x < x_min + side_m and high_x > x_min and low_y < y_max and high_y > y_max - side_m:
            found = layer.sampled(x.ravel(), y.ravel(), pixel_m)
            shown = np.maximum(shown, found)
    if not shown.any():
        return None
    return png_bytes(_COLOURS[shown].reshape(TILE_PIXELS, TILE_PIXELS, 4))


def png_bytes(rgba: ByteArray) -> bytes:
    """A picture (R, C, 4) red, green, blue, opacity as PNG."""
    ok, data = cv2.imencode(".png", rgba[:, :, [2, 1, 0, 3]], [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if not ok:
        raise RuntimeError("cannot encode a picture")
    return data.tobytes()
