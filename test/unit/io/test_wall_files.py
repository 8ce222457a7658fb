"""Walls in GeoJSON and DXF are those that were written."""

import json

import numpy as np

from uw_dslam_ros2.core.chart.lines import Pier, Wall
from uw_dslam_ros2.io.maps.walls import dxf_bytes, walls_geojson_bytes

WALLS = [
    Wall(np.array([[0.0, 0.0], [10.0, 0.5], [12.0, 4.0]]), 0.25, 1_700_000_000_500_000_000),
    Wall(np.array([[-3.0, 2.0], [-3.0, -2.12345]]), 0.1),
]
PIERS = [Pier(5.0, -6.0, 0.8)]


def test_geojson_holds_lines_points_widths_and_ages():
    features = json.loads(walls_geojson_bytes(WALLS, PIERS))["features"]
    assert [f["geometry"]["type"] for f in features] == ["LineString", "LineString", "Point"]
    assert [f["properties"]["kind"] for f in features] == ["wall", "wall", "pier"]
    assert [f["properties"]["width_m"] for f in features] == [0.25, 0.1, 0.8]
    assert [f["properties"]["last_seen_s"] for f in features] == [1_700_000_000.5, None, None]
    for wall, feature in zip(WALLS, features, strict=False):
        np.testing.assert_allclose(feature["geometry"]["coordinates"], wall.points, atol=5e-4)
    assert features[2]["geometry"]["coordinates"] == [5.0, -6.0]


def read_dxf(content):
    """Entities of a DXF file: name, and values by group code; polylines have their vertices."""
    lines = content.decode("ascii").splitlines()
    assert len(lines) % 2 == 0
    groups = list(zip((int(code) for code in lines[::2]), lines[1::2], strict=True))
    assert groups[-1] == (0, "EOF")
    entities = []
    for code, value in groups:
        if code == 0:
            entities.append((value, {}))
        else:
            entities[-1][1][code] = value
    return entities


def test_dxf_holds_polylines_and_circles():
    entities = read_dxf(dxf_bytes(WALLS, PIERS))
    names = [name for name, _ in entities]
    assert names.count("SECTION") == names.count("ENDSEC") == 2
    wide = [float(values[40]) for name, values in entities if name == "POLYLINE"]
    assert wide == [0.25, 0.1]
    corners = [(float(v[10]), float(v[20])) for name, v in entities if name == "VERTEX"]
    np.testing.assert_allclose(corners, np.vstack([w.points for w in WALLS]), atol=5e-4)
    (circle,) = [values for name, values in entities if name == "CIRCLE"]
    assert (circle[8], float(circle[10]), float(circle[20]), float(circle[40])) == (
        "PIERS", 5.0, -6.0, 0.4,
    )  # fmt: skip


def test_no_walls_are_files_without_entities():
    assert json.loads(walls_geojson_bytes([], []))["features"] == []
    assert "POLYLINE" not in [name for name, _ in read_dxf(dxf_bytes([], []))]
