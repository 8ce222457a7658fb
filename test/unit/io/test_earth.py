"""Coordinates on earth against numbers of others, and pictures against another reader."""

import io
import math

import numpy as np
import pytest
import tifffile
from PIL import Image
from scipy.integrate import quad

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.earth import (
    geotiff_bytes,
    projection_bytes,
    utm_frame,
    utm_position,
    world_file_bytes,
)

E2 = 6.69437999014e-3  # square of the eccentricity of WGS 84


@pytest.mark.parametrize(
    ("latitude", "longitude", "frame", "east", "north"),
    [
        (0.0, 3.0, "EPSG:32631", 500_000.0, 0.0),
        (-1e-12, 3.0, "EPSG:32731", 500_000.0, 10_000_000.0),
        # The CN Tower, as encyclopedias have it, to a metre.
        (43.642567, -79.387139, "EPSG:32617", 630_084.0, 4_833_438.0),
        (0.0, -180.0, "EPSG:32601", 166_021.443, 0.0),
    ],
)
def test_utm_as_others_have_it(latitude, longitude, frame, east, north):
    assert utm_frame(latitude, longitude) == frame
    found = utm_position(latitude, longitude, frame)
    assert found == pytest.approx((east, north), abs=1.0 if latitude == 43.642567 else 2e-3)


@pytest.mark.parametrize("latitude", [10.0, 54.0, 84.0])
def test_north_along_the_middle_of_a_zone_is_the_length_of_the_meridian(latitude):
    def radius_m(angle):
        return 6378137.0 * (1.0 - E2) / (1.0 - E2 * math.sin(angle) ** 2) ** 1.5

    length_m, _ = quad(radius_m, 0.0, math.radians(latitude), epsabs=1e-6)
    found = utm_position(latitude, 9.0, "EPSG:32632")
    assert found == pytest.approx((500_000.0, 0.9996 * length_m), abs=1e-3)


def test_a_step_on_the_ellipsoid_is_as_long_in_utm():
    latitude, longitude = math.radians(-33.0), 151.9
    curve = 1.0 - E2 * math.sin(latitude) ** 2
    meridian_m = 6378137.0 * (1.0 - E2) / curve**1.5
    parallel_m = 6378137.0 * math.cos(latitude) / math.sqrt(curve)
    here = np.array(utm_position(-33.0, longitude, "EPSG:32756"))
    step = 1e-4
    north = np.array(utm_position(-33.0 + step, longitude, "EPSG:32756")) - here
    east = np.array(utm_position(-33.0, longitude + step, "EPSG:32756")) - here
    # Scale 0.9996 at the middle of the zone, and up to a thousandth more towards its edges.
    turn = math.radians(step)
    assert math.hypot(*north) / (turn * meridian_m) == pytest.approx(0.9998, abs=3e-4)
    assert math.hypot(*east) / (turn * parallel_m) == pytest.approx(
        math.hypot(*north) / (turn * meridian_m), abs=1e-6
    )
    assert abs(north @ east) < 1e-3


def test_a_frame_that_is_no_zone_is_refused():
    for frame in ("EPSG:4326", "EPSG:32661", "chart"):
        with pytest.raises(InvalidInputError, match=f"frame is '{frame}'"):
            utm_position(60.0, 10.0, frame)
    assert projection_bytes("EPSG:4326") is None
    assert b"UTM zone 32N" in projection_bytes("EPSG:32632")


VALUES = np.array([[0, 100, -1], [50, -1, 7]], np.int8)
MAP = OccupancyMap(GridSpec(0.5, 2, 3, SE2(10.0, 20.0)), VALUES)


@pytest.mark.parametrize("frame", ["EPSG:32632", "the harbour's chart"])
def test_a_geotiff_lies_where_the_map_does(frame):
    T_earth_map = SE2(512_000.0, 5_912_000.0, 0.5 * math.pi)
    content = geotiff_bytes(MAP, T_earth_map, frame)
    with tifffile.TiffFile(io.BytesIO(content)) as file:
        page = file.pages[0]
        picture, told = page.asarray(), page.geotiff_tags
        assert page.tags[42113].value == "255"
    assert picture.tolist() == [[50, 255, 7], [0, 100, 255]]
    assert told["GTRasterTypeGeoKey"] == 1
    assert told["GTCitationGeoKey"] == frame
    code = 32632 if frame.startswith("EPSG") else 32767
    assert int(told["ProjectedCSTypeGeoKey"]) == code
    matrix = np.array(told["ModelTransformation"])
    # Each cell's middle: half a pixel from the corner that the matrix is about.
    for row in range(2):
        for col in range(3):
            place = matrix @ (col + 0.5, row + 0.5, 0.0, 1.0)
            middle = MAP.spec.centers_of(np.array([[1 - row, col]]))[0]
            assert place[:2] == pytest.approx(T_earth_map.apply(middle), abs=1e-6)
    assert Image.open(io.BytesIO(content)).size == (3, 2)
    # The world file is about the middle of the first pixel.
    a, d, b, e, x, y = map(float, world_file_bytes(MAP.spec, T_earth_map).split())
    first = matrix @ (0.5, 0.5, 0.0, 1.0)
    assert (x, y) == pytest.approx(first[:2].tolist(), abs=1e-6)
    assert np.array([[a, b], [d, e]]) == pytest.approx(matrix[:2, :2], abs=1e-8)
