"""Tiles of maps: every pixel shows the cell that lies under its middle."""

import cv2
import numpy as np
import pytest

from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sparse_cells import SQUARE, Window
from uw_dslam_ros2.view.tiles import TILE_PIXELS, Layer, colours_of_percent, tile_png


def decoded(png):
    return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)[:, :, [2, 1, 0, 3]]


def random_map(rng, rows=90, cols=120, pose=SE2()):
    values = rng.choice([-1, 0, 50, 100], size=(rows, cols)).astype(np.int8)
    return OccupancyMap(GridSpec(0.25, rows, cols, pose), values)


@pytest.mark.parametrize("zoom", [2, 3, 4])  # down to a pixel a cell
def test_pixels_show_the_cell_under_them(rng, zoom):
    occupancy = random_map(rng, pose=SE2(1.3, -2.1, 0.4))
    layer = Layer.of(occupancy, SE2(5.0, 7.0, -1.0))
    colours = colours_of_percent()
    pixel_m = 2.0**-zoom
    num_shown = 0
    for col, row in ((0, 0), (0, -1), (-1, -1), (1, -1)):
        png = tile_png([layer], zoom, col, row)
        picture = (
            np.zeros((TILE_PIXELS, TILE_PIXELS, 4), np.uint8) if png is None else decoded(png)
        )
        for i, j in rng.integers(0, TILE_PIXELS, (200, 2)):
            x, y = col * TILE_PIXELS + j + 0.5, -(row * TILE_PIXELS + i + 0.5)
            place = np.array([[x, y]]) * pixel_m
            cells = occupancy.spec.cells_of(layer.T_view_map.inverse().apply(place))
            expected = np.zeros(4, np.uint8)
            if occupancy.spec.contains(cells)[0]:
                expected = colours[occupancy.values[cells[0, 0], cells[0, 1]] + 1]
            if expected[3]:
                num_shown += 1
                np.testing.assert_array_equal(picture[i, j], expected)
            else:
                assert picture[i, j, 3] == 0
    assert num_shown > 10


def test_walls_outlast_a_coarse_zoom():
    values = np.zeros((1000, 1000), np.int8)
    values[500] = 100
    layer = Layer.of(OccupancyMap(GridSpec(0.05, 1000, 1000), values))
    picture = decoded(tile_png([layer], 0, 0, -1))
    is_dark = (picture[:, :, 0] < 100) & (picture[:, :, 3] > 0)
    assert is_dark[:, 10:40].any(axis=0).all()  # a quay of one cell is seen at a pixel a metre


def test_nothing_known_is_no_tile():
    unknown = OccupancyMap(GridSpec(0.1, 10, 10), np.full((10, 10), -1, np.int8))
    assert tile_png([Layer.of(unknown)], 3, 0, -1) is None
    assert tile_png([], 3, 0, 0) is None


def test_a_large_map_costs_a_tile_no_more_than_what_it_shows():
    """20,000 x 20,000 cells: bounded by squares asked for and bytes held, not by the clock."""
    side = -(-20_000 // SQUARE)
    asked = []
    pattern = np.zeros((SQUARE, SQUARE), np.int8)
    pattern[::16] = 100

    def square(row, col):
        asked.append((row, col))
        return pattern

    layer = Layer(GridSpec(0.1, 1, 1, SE2(0.0, 0.0, 0.3)), square)
    squares = [(row, col) for row in range(side) for col in range(side)]
    layer.change(squares)

    def look(zoom, x_m, y_m):
        """Squares asked for by the tile over a place."""
        asked.clear()
        tile_m = TILE_PIXELS * 2.0**-zoom
        assert tile_png([layer], zoom, int(x_m // tile_m), int(-y_m // tile_m)) is not None
        return len(asked)

    middle = SE2(0.0, 0.0, 0.3).apply(np.array([[1000.0, 1000.0]]))[0]
    zooms = range(-4, 7)
    first = [look(zoom, *middle) for zoom in zooms]
    assert first[0] == len(squares), "the whole map once, for the picture of all of it"
    assert max(first[1:]) <= 150
    assert layer.num_bytes < 70e6, "of 400 MB"
    for step in range(40):  # over the map, near, as who drags it
        place = SE2(0.0, 0.0, 0.3).apply(np.array([[100.0 + 40.0 * step, 300.0 + 30.0 * step]]))[0]
        assert look(3, *place) <= 16
    assert layer.num_bytes < 70e6
    row, col = side // 2, side // 2
    layer.change(
        squares, Window(row * SQUARE, col * SQUARE, (row + 1) * SQUARE, (col + 1) * SQUARE)
    )
    assert max(look(zoom, *middle) for zoom in zooms) <= 150, "what changes is made anew, alone"
