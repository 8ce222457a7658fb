"""Pictures of maps in square tiles, for any zoom."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sparse_cells import SQUARE, Window

__all__ = ["TILE_PIXELS", "Layer", "colours_of_percent", "png_bytes", "rectangle_of", "tile_png"]

ByteArray = NDArray[np.uint8]

TILE_PIXELS = 256
_FINE_LEVELS, _MAX_FINE = 2, 512
"""Squares held of these levels: 32 MB, some screens full."""
_FREE = (247, 249, 250)  # red, green, blue
_WALL = (22, 38, 54)


def colours_of_percent() -> ByteArray:
    """(102, 4) red, green, blue, opacity of a stored cell: 0 unknown, else percent + 1.

    What is as likely free as not looks like what is unknown.
    """
    sure = np.linspace(-1.0, 1.0, 101)
    table = np.zeros((102, 4), np.uint8)
    table[1:, :3] = np.where(sure[:, None] < 0.0, _FREE, _WALL)
    table[1:, 3] = np.rint(255.0 * np.abs(sure))
    return table


_COLOURS = colours_of_percent()


class Layer:
    """A map and where it is shown, in squares of cells, which are made when they are looked at.

    Each level is half as fine as the one before; walls outlast the rest. Of the two finest, which
    are nearly all of a map's bytes, only those are held that were looked at last.

    Parameters
    ----------
    lattice
        Where cell (0, 0) lies, and how large cells are; its size does not count.
    square
        Percent (SQUARE, SQUARE) of a square of cells by row and column of squares, -1 unknown.
    T_view_map
        Takes the map's frame to that of the page, in which groups that are not joined stand side
        by side.
    """

    def __init__(
        self,
        lattice: GridSpec,
        square: Callable[[int, int], NDArray[np.int8]],
        T_view_map: SE2 = SE2(),
    ) -> None:
        self.lattice, self.T_view_map = lattice, T_view_map
        self._square = square
        self._known: list[set[tuple[int, int]]] = [set()]
        self._made: dict[tuple[int, int, int], ByteArray] = {}
        self._fine: dict[tuple[int, int, int], ByteArray] = {}  # the last looked at comes last

    @classmethod
    def of(cls, occupancy: OccupancyMap, T_view_map: SE2 = SE2()) -> Layer:
        """A map that does not change."""
        values = occupancy.values
        rows, cols = (-(-side // SQUARE) for side in values.shape)

        def square(row: int, col: int) -> NDArray[np.int8]:
            found = np.full((SQUARE, SQUARE), -1, np.int8)
            part = values[row * SQUARE :, col * SQUARE :][:SQUARE, :SQUARE]
            found[: part.shape[0], : part.shape[1]] = part
            return found

        layer = cls(occupancy.spec, square, T_view_map)
        layer.change((row, col) for row in range(rows) for col in range(cols))
        return layer

    def change(self, known: Iterable[tuple[int, int]], window: Window | None = None) -> None:
        """Say which squares there are, and in which rectangle of cells they changed; None: all."""
        self._known = [set(known)]
        if window is None:
            self._made.clear()
            self._fine.clear()
            return
        for held in (self._made, self._fine):
            for level, row, col in list(held):
                side = SQUARE << level
                if (
                    row * side < window.row_1
                    and (row + 1) * side > window.row_0
                    and col * side < window.col_1
                    and (col + 1) * side > window.col_0
                ):
                    del held[level, row, col]

    @property
    def num_bytes(self) -> int:
        """Held for what was looked at."""
        return sum(made.nbytes for held in (self._made, self._fine) for made in held.values())

    def sampled(
        self, x_m: NDArray[np.float64], y_m: NDArray[np.float64], pixel_m: float
    ) -> ByteArray:
        """Stored cells under places (N,) of the page, at the level that suits a pixel's size."""
        resolution_m = self.lattice.resolution_m
        # Cells no smaller than pixels, so that none is passed over.
        level = math.ceil(math.log2(max(pixel_m / resolution_m, 1.0)) - 1e-9)
        T_grid_view = (self.T_view_map @ self.lattice.T_frame_grid).inverse()
        local = T_grid_view.apply(np.column_stack([x_m, y_m])) / (resolution_m * 2**level)
        col, row = np.floor(local).astype(np.int64).T
        first = int(row.min()) // SQUARE, int(col.min()) // SQUARE
        last = int(row.max()) // SQUARE, int(col.max()) // SQUARE
        size = (last[0] - first[0] + 1) * SQUARE, (last[1] - first[1] + 1) * SQUARE
        cells = np.zeros(size, np.uint8)
        for i in range(first[0], last[0] + 1):
            for j in range(first[1], last[1] + 1):
                if (i, j) in self._squares(level):
                    top, left = (i - first[0]) * SQUARE, (j - first[1]) * SQUARE
                    cells[top : top + SQUARE, left : left + SQUARE] = self._at(level, i, j)
        return np.asarray(cells[row - first[0] * SQUARE, col - first[1] * SQUARE])

    def bounds(self) -> tuple[float, float, float, float] | None:
        """Rectangle around all squares on the page, as `rectangle_of`; None without any."""
        if not self._known[0]:
            return None
        rows, cols = np.array(sorted(self._known[0])).T * SQUARE
        low, high = (int(rows.min()), int(cols.min())), (int(rows.max()), int(cols.max()))
        return self.bounds_of_cells(Window(*low, high[0] + SQUARE, high[1] + SQUARE))

    def bounds_of_cells(self, window: Window) -> tuple[float, float, float, float]:
        """Rectangle around a rectangle of cells on the page, as `rectangle_of`."""
        spec = self.lattice.part(window.row_0, window.col_0, *window.shape)
        return rectangle_of(spec, self.T_view_map)

    def _squares(self, level: int) -> set[tuple[int, int]]:
        while len(self._known) <= level:
            self._known.append({(row // 2, col // 2) for row, col in self._known[-1]})
        return self._known[level]

    def _at(self, level: int, row: int, col: int) -> ByteArray:
        key = level, row, col
        if level >= _FINE_LEVELS:
            if key not in self._made:
                self._made[key] = self._coarser(*key)
            return self._made[key]
        made = self._fine.pop(key, None)
        if made is None:
            while len(self._fine) >= _MAX_FINE:
                del self._fine[next(iter(self._fine))]
            if level == 0:
                made = (self._square(row, col).view(np.uint8) + np.uint8(1)).astype(np.uint8)
            else:
                made = self._coarser(*key)
        self._fine[key] = made
        return made

    def _coarser(self, level: int, row: int, col: int) -> ByteArray:
        """A square from the four of the level before."""
        fine = np.zeros((2 * SQUARE, 2 * SQUARE), np.uint8)
        for i in (0, 1):
            for j in (0, 1):
                child = 2 * row + i, 2 * col + j
                if child in self._squares(level - 1):
                    part = self._at(level - 1, *child)
                    fine[i * SQUARE :, j * SQUARE :][:SQUARE, :SQUARE] = part
        pairs = np.maximum(fine[::2], fine[1::2])
        return np.asarray(np.maximum(pairs[:, ::2], pairs[:, 1::2]))


def rectangle_of(spec: GridSpec, T_view_frame: SE2) -> tuple[float, float, float, float]:
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
    shown = np.zeros(TILE_PIXELS * TILE_PIXELS, np.uint8)
    for layer in layers:
        bounds = layer.bounds()
        if bounds is None:
            continue
        low_x, low_y, high_x, high_y = bounds
        if low_x < x_min + side_m and high_x > x_min and low_y < y_max and high_y > y_max - side_m:
            x, y = np.meshgrid(x_min + centers, y_max - centers)
            shown = np.maximum(shown, layer.sampled(x.ravel(), y.ravel(), pixel_m))
    if not shown.any():
        return None
    return png_bytes(_COLOURS[shown].reshape(TILE_PIXELS, TILE_PIXELS, 4))


def png_bytes(rgba: ByteArray) -> bytes:
    """A picture (R, C, 4) red, green, blue, opacity as PNG."""
    ok, data = cv2.imencode(".png", rgba[:, :, [2, 1, 0, 3]], [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if not ok:
        raise RuntimeError("cannot encode a picture")
    return data.tobytes()
