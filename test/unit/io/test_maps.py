"""Map files against literal bytes and numbers, in each direction."""

import os

import cv2
import numpy as np
import pytest
import yaml

from uw_dslam_ros2.core.errors import DataError, InvalidInputError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.maps import image_of, read_map, write_map

# Three rows (lowest y first), four columns; asymmetric under every flip and turn.
VALUES = np.array([[0, 100, -1, -1], [100, 100, 0, 0], [-1, 0, 0, 100]], dtype=np.int8)
PIXELS_TOP_DOWN = [[205, 254, 254, 0], [0, 0, 254, 254], [254, 0, 205, 205]]


def hand_made() -> OccupancyMap:
    return OccupancyMap(GridSpec(0.25, 3, 4, SE2(-1.5, 2.0, 0.0)), VALUES)


def write_pgm(folder, pixels, **keys):
    pixels = np.array(pixels, dtype=np.uint8)
    header = f"P5\n# CREATOR: somebody\n{pixels.shape[1]} {pixels.shape[0]}\n255\n".encode()
    (folder / "map.pgm").write_bytes(header + pixels.tobytes())
    content = {
        "image": "map.pgm",
        "resolution": 0.25,
        "origin": [-1.5, 2.0, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    } | keys
    content = {key: value for key, value in content.items() if value is not None}
    (folder / "map.yaml").write_text(yaml.safe_dump(content))
    return folder / "map.yaml"


def test_written_files_hold_the_literal_pixels_and_keys(tmp_path):
    paths = write_map(tmp_path / "new" / "map", hand_made())
    assert [p.name for p in paths] == ["map.pgm", "map.png", "map.yaml"]
    expected = b"P5\n4 3\n255\n" + bytes(np.array(PIXELS_TOP_DOWN, np.uint8))
    assert (tmp_path / "new" / "map.pgm").read_bytes() == expected
    assert yaml.safe_load((tmp_path / "new" / "map.yaml").read_text()) == {
        "image": "map.pgm",
        "mode": "trinary",
        "resolution": 0.25,
        "origin": [-1.5, 2.0, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }
    png = cv2.imread(str(tmp_path / "new" / "map.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(png, PIXELS_TOP_DOWN)
    assert sorted(p.name for p in (tmp_path / "new").iterdir()) == [
        "map.pgm",
        "map.png",
        "map.yaml",
    ]


def test_literal_pixels_are_read_into_the_literal_grid(tmp_path):
    occupancy = read_map(write_pgm(tmp_path, PIXELS_TOP_DOWN))
    np.testing.assert_array_equal(occupancy.values, VALUES)
    assert occupancy.spec == GridSpec(0.25, 3, 4, SE2(-1.5, 2.0, 0.0))


def test_a_rotated_origin_is_kept_both_ways(tmp_path):
    occupancy = OccupancyMap(GridSpec(0.1, 3, 4, SE2(1.0, -2.0, 0.5)), VALUES)
    back = read_map(write_map(tmp_path / "map", occupancy)[-1])
    assert back.spec == occupancy.spec
    np.testing.assert_array_equal(back.values, VALUES)


def test_trinary_keeps_the_side_of_every_decided_cell(tmp_path):
    """Map_server's saver loses 26..64 percent to unknown; here only 50, which decides nothing."""
    values = np.arange(-1, 101, dtype=np.int8).reshape(1, -1)
    occupancy = OccupancyMap(GridSpec(0.05, 1, values.size), values)
    back = read_map(write_map(tmp_path / "map", occupancy)[-1]).values[0]
    expected = [-1] + [0] * 50 + [-1] + [100] * 50
    np.testing.assert_array_equal(back, expected)


def test_raw_keeps_every_percentage(tmp_path):
    values = np.arange(-1, 101, dtype=np.int8).reshape(2, 51)
    occupancy = OccupancyMap(GridSpec(0.05, 2, 51), values)
    back = read_map(write_map(tmp_path / "map", occupancy, mode="raw")[-1])
    np.testing.assert_array_equal(back.values, values)


def test_trinary_thresholds_are_strict_as_in_map_server(tmp_path):
    # (255 - pixel) / 255: 0.19608 unknown, 0.1922 free, 0.65098 occupied, 0.647 unknown.
    occupancy = read_map(write_pgm(tmp_path, [[205, 206, 89, 90]]))
    np.testing.assert_array_equal(occupancy.values, [[-1, 0, 100, -1]])


def test_scale_spreads_the_range_between_the_thresholds(tmp_path):
    path = write_pgm(tmp_path, [[255, 153, 0]], mode="scale", free_thresh=0.2, occupied_thresh=0.8)
    np.testing.assert_array_equal(read_map(path).values, [[0, 33, 100]])  # (0.4 - 0.2) / 0.6


def test_scale_takes_transparent_pixels_as_unknown(tmp_path):
    path = write_pgm(tmp_path, [[0]], mode="scale", image="map.png")
    bgra = np.array([[[0, 0, 0, 255], [0, 0, 0, 0], [255, 255, 255, 255]]], dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "map.png"), bgra)
    np.testing.assert_array_equal(read_map(path).values, [[100, -1, 0]])


def test_negate_swaps_black_and_white_but_not_in_raw_mode(tmp_path):
    np.testing.assert_array_equal(
        read_map(write_pgm(tmp_path, [[254, 0]], negate=1)).values, [[100, 0]]
    )
    path = write_pgm(tmp_path, [[7, 100, 101]], negate=1, mode="raw")
    np.testing.assert_array_equal(read_map(path).values, [[7, 100, -1]])


def test_the_picture_has_its_first_row_on_top():
    np.testing.assert_array_equal(image_of(hand_made()), PIXELS_TOP_DOWN)


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"resolution": 0.0}, "resolution is 0.0"),
        ({"resolution": "fine"}, "resolution is 'fine'"),
        ({"resolution": None}, "resolution is None"),
        ({"origin": [0.0, 0.0]}, "origin is"),
        ({"origin": [0.0, float("nan"), 0.0]}, "origin is"),
        ({"mode": "quaternary"}, "mode is 'quaternary'"),
        ({"negate": 2}, "negate is 2"),
        ({"free_thresh": 0.7}, "free_thresh is 0.7"),
        ({"occupied_thresh": None}, "occupied_thresh is None"),
        ({"image": None}, "image is None"),
        ({"image": "missing.pgm"}, "missing.pgm: No such file"),
    ],
)
def test_a_bad_yaml_file_is_refused_by_name(tmp_path, keys, sentence):
    path = write_pgm(tmp_path, PIXELS_TOP_DOWN, **keys)
    with pytest.raises(DataError) as caught:
        read_map(path)
    assert sentence in str(caught.value)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"", "0 bytes"),
        (b"P5\n4 3\n255\n" + b"\0" * 11, "truncated: 11 bytes of pixels, expected 12"),
        (b"P5\n4", "header is broken"),
        (b"P5\n0 3\n255\n", "header is broken"),
        (b"P5\n900000 900000\n255\n", "at most"),
        (b"no image at all", "no complete"),
    ],
)
def test_a_bad_image_is_refused_by_name(tmp_path, content, sentence):
    path = write_pgm(tmp_path, PIXELS_TOP_DOWN)
    (tmp_path / "map.pgm").write_bytes(content)
    with pytest.raises(DataError, match=r"map\.pgm") as caught:
        read_map(path)
    assert sentence in str(caught.value)


def test_a_missing_or_foreign_yaml_file_is_refused(tmp_path):
    with pytest.raises(DataError, match="No such file"):
        read_map(tmp_path / "nothing.yaml")
    (tmp_path / "list.yaml").write_text("[1, 2")
    with pytest.raises(DataError, match="not a YAML file"):
        read_map(tmp_path / "list.yaml")
    (tmp_path / "list.yaml").write_text("[1, 2]")
    with pytest.raises(DataError, match="holds a list"):
        read_map(tmp_path / "list.yaml")


def test_an_unknown_mode_is_refused_when_writing(tmp_path):
    with pytest.raises(InvalidInputError, match="mode is 'scale'"):
        write_map(tmp_path / "map", hand_made(), mode="scale")


def test_a_failed_write_leaves_the_old_map_whole(tmp_path, monkeypatch):
    """Fail at every file in turn: the old map is still there, whole, and no litter stays."""
    old, new = hand_made(), OccupancyMap(GridSpec(0.25, 1, 1), np.array([[100]], dtype=np.int8))
    write_map(tmp_path / "map", old)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    for fail_at in range(3):
        calls = iter(range(100))

        def failing_fsync(_descriptor, calls=calls, fail_at=fail_at):
            if next(calls) == fail_at:
                raise OSError(28, "No space left on device")

        monkeypatch.setattr(os, "fsync", failing_fsync)
        with pytest.raises(DataError, match="No space left on device"):
            write_map(tmp_path / "map", new)
        assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before
