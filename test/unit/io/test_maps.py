"""Map files against literal bytes and numbers, in each direction."""

import math
import os
import struct

import cv2
import numpy as np
import pytest
import yaml

from uw_dslam_ros2.core.errors import DataError, InvalidInputError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.maps.files import read_map, write_map

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


def test_the_picture_has_its_first_row_on_top(tmp_path):
    write_map(tmp_path / "map", hand_made())
    pixels = cv2.imread(str(tmp_path / "map.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(pixels, PIXELS_TOP_DOWN)


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"resolution": 0.0}, "resolution is 0.0"),
        ({"resolution": "fine"}, "resolution is 'fine'"),
        ({"resolution": None}, "resolution is missing, expected a finite number"),
        ({"resolution": "0.05 m"}, "resolution is '0.05 m', expected a finite number"),
        ({"resolution": "1_0"}, "resolution is '1_0', expected a finite number"),
        ({"resolution": "-0.05"}, "resolution is -0.05, expected metres per cell > 0"),
        ({"resolution": [0.05]}, "resolution is [0.05], expected a finite number"),
        ({"origin": [0.0, 0.0]}, "origin is"),
        (
            {"origin": [0.0, float("nan"), 0.0]},
            "origin is [0.0, '.nan', 0.0], expected [x, y, yaw]",
        ),
        ({"origin": [0.0, 1.0, "east"]}, "origin is [0.0, 1.0, 'east'], expected [x, y, yaw]"),
        (
            {"origin": [0.0, 1.0, "-nan"]},
            "in metres and radians; if the map is not turned, write 0 for nan",
        ),
        ({"origin": "0 0 0"}, "origin is '0 0 0', expected [x, y, yaw]"),
        ({"origin": None}, "origin is missing, expected [x, y, yaw]"),
        ({"mode": "quaternary"}, "mode is 'quaternary', expected trinary, scale or raw"),
        ({"negate": 2}, "negate is 2, expected 0 or 1"),
        ({"negate": "perhaps"}, "negate is 'perhaps', expected 0 or 1"),
        ({"free_thresh": 0.7}, "free_thresh is 0.7"),
        ({"occupied_thresh": None}, "occupied_thresh is missing"),
        ({"image": None}, "image is missing, expected the name of a file"),
        ({"image": ""}, "image is '', expected the name of a file"),
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
        (
            b"P5\n20001 3\n255\n",
            "the image has 20001 x 3 pixels, expected at least 1 and at most 20000",
        ),
        (b"P5\n3 20001\n255\n", "3 x 20001 pixels"),
        (b"P2 2 2 255 0 1 2", "truncated: 3 numbers of pixels, expected 4"),
        (b"P2 2 1 255 0 x", "expected pixels as numbers"),
        (b"P2 2 1 9 0 10", "a pixel is 10, expected at most 9"),
        (b"P2 2 1 9 0 -1", "a pixel is -1, expected at least 0"),
        (b"P5 4 3 70000\n" + b"\0" * 24, "header is broken"),
        (b"P5 4 3 300\n" + b"\0" * 12, "truncated: 12 bytes of pixels, expected 24"),
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
    for nothing in ("", "# only a comment", "---\n---\nimage: map.pgm"):
        (tmp_path / "list.yaml").write_text(nothing)
        with pytest.raises(DataError, match="holds nothing, expected keys"):
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


# --- the forms that nav2's map_server takes -----------------------------------------------------

PLAIN = """image: map.pgm
mode: trinary
resolution: 0.25
origin: [-1.5, 2.0, 0.5]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""


def same_as_plain(folder, content: bytes) -> None:
    write_pgm(folder, PIXELS_TOP_DOWN)
    (folder / "other.yaml").write_bytes(content)
    occupancy = read_map(folder / "other.yaml")
    np.testing.assert_array_equal(occupancy.values, VALUES)
    assert occupancy.spec == GridSpec(0.25, 3, 4, SE2(-1.5, 2.0, 0.5))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("trinary", "Trinary"),
        ("trinary", "TRINARY"),
        ("mode: trinary\n", ""),
        ("negate: 0", 'negate: "0"'),
        ("negate: 0", "negate: false"),
        ("negate: 0", "negate: 'No'"),
        ("negate: 0\n", ""),
        ("0.25", "25e-2"),
        ("0.25", "2.5E-1"),
        ("0.25", '"0.25"'),
        ("0.25", "+.25"),
        ("-1.5, 2.0, 0.5", "-15e-1, 2, .5"),
        ("[-1.5, 2.0, 0.5]", "\n- -1.5\n- 2.0\n- 0.5"),
        ("resolution: 0", "resolution:\t0"),
        ("0.196\n", "0.196\t# tight\n"),
        ("image: map.pgm", "image: 'map.pgm'"),
        ("image: map.pgm", "image: ./sub/../map.pgm"),
        ("image:", "---\nimage:"),
        ("0.196\n", "0.196\n---\n"),
        ("0.196\n", "0.196\n---\nimage: other.pgm\nresolution: 7\n"),
        ("0.196\n", "0.196\n...\n"),
        ("\n", "\r\n"),
        ("0.196\n", "0.196\nsomething: {else: [1, 2]}\n"),
    ],
)
def test_every_way_to_write_the_same_keys_is_read(tmp_path, old, new):
    assert old in PLAIN
    (tmp_path / "sub").mkdir()
    same_as_plain(tmp_path, PLAIN.replace(old, new).encode())


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1", "utf-8-sig", "utf-16"])
def test_comments_may_be_in_any_encoding(tmp_path, encoding):
    same_as_plain(tmp_path, f"# Gr\u00f6\u00dfe in m\u00b2\n{PLAIN}".encode(encoding))
    same_as_plain(tmp_path, b"# \x81\x8d\xff\xfe \xb5\n" + PLAIN.encode())


def test_negate_in_words_is_understood(tmp_path):
    for word in ("1", "true", "True", '"1"', "yes"):
        path = write_pgm(tmp_path, [[254, 0]])
        path.write_text(PLAIN.replace("negate: 0", f"negate: {word}"))
        np.testing.assert_array_equal(read_map(path).values, [[100, 0]])


def test_the_image_may_be_named_by_its_whole_path(tmp_path):
    path = write_pgm(tmp_path, PIXELS_TOP_DOWN)
    (tmp_path / "far").mkdir()
    far = tmp_path / "far" / "map.yaml"
    far.write_text(path.read_text().replace("map.pgm", str(tmp_path / "map.pgm")))
    np.testing.assert_array_equal(read_map(far).values, VALUES)


def test_a_whole_path_of_another_computer_is_told_with_what_lies_near(tmp_path):
    path = write_pgm(tmp_path, PIXELS_TOP_DOWN)
    path.write_text(path.read_text().replace("map.pgm", "/home/robot/maps/map.pgm"))
    with pytest.raises(DataError, match=r"image is '/home/robot/maps/map.pgm'.*lies beside"):
        read_map(path)


def pgm(magic: str, pixels, white: int, comment: str = "") -> bytes:
    pixels = np.array(pixels)
    head = f"{magic}{comment}\n{pixels.shape[1]} {pixels.shape[0]}\n{comment}\n{white}\n".encode()
    if magic == "P2":
        return head + "\n".join(" ".join(map(str, row)) for row in pixels.tolist()).encode()
    return head + pixels.astype(">u2" if white > 255 else np.uint8).tobytes()


@pytest.mark.parametrize("magic", ["P2", "P5"])
@pytest.mark.parametrize("white", [255, 65535, 51, 1020])
@pytest.mark.parametrize("comment", ["", " # by hand 12 34", "\n# a\r\n#\n # b 7 7 7"])
def test_every_pgm_is_read_by_its_own_white(tmp_path, magic, white, comment):
    """205 of 255 is 41 of 51; a comment holds numbers and stands wherever it may."""
    path = write_pgm(tmp_path, PIXELS_TOP_DOWN)
    scaled = np.array(PIXELS_TOP_DOWN) * white // 255
    (tmp_path / "map.pgm").write_bytes(pgm(magic, scaled, white, comment))
    np.testing.assert_array_equal(read_map(path).values, VALUES)


def test_raw_pixels_of_sixteen_bits_are_hundreds_of_parts_of_255(tmp_path):
    path = write_pgm(tmp_path, [[0]], mode="RAW")
    (tmp_path / "map.pgm").write_bytes(pgm("P5", [[7 * 257, 100 * 257, 101 * 257]], 65535))
    np.testing.assert_array_equal(read_map(path).values, [[7, 100, -1]])


@pytest.mark.parametrize(
    ("ending", "is_colour"),
    [("png", False), ("bmp", False), ("pgm", False), ("png", True), ("bmp", True), ("ppm", True)],
)
def test_every_image_format_gives_the_same_map(tmp_path, ending, is_colour):
    path = write_pgm(tmp_path, PIXELS_TOP_DOWN, image=f"other.{ending}")
    image = np.array(PIXELS_TOP_DOWN, dtype=np.uint8)
    if is_colour:
        # Map servers average colours: 200, 205 and 210 are 205.
        image = np.stack([image, image, image], axis=2)
        image[image == 205] = np.tile([200, 205, 210], 3)
    assert cv2.imwrite(str(tmp_path / f"other.{ending}"), image)
    np.testing.assert_array_equal(read_map(path).values, VALUES)
    content = (tmp_path / f"other.{ending}").read_bytes()
    (tmp_path / f"other.{ending}").write_bytes(content[:-5])
    with pytest.raises(DataError, match=rf"other\.{ending}"):
        read_map(path)


def test_trinary_averages_alpha_with_the_colours_as_map_server_does(tmp_path):
    path = write_pgm(tmp_path, [[0]], image="map.png")
    # Black: (0 + 0 + 0 + 255) / 4 is unknown to thresholds of 0.8; and without opacity a wall.
    bgra = np.array([[[0, 0, 0, 255], [0, 0, 0, 0], [254, 254, 254, 255]]], dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "map.png"), bgra)
    path.write_text(path.read_text().replace("0.65", "0.8"))
    np.testing.assert_array_equal(read_map(path).values, [[-1, 100, 0]])


def too_large(kind: str) -> bytes:
    if kind == "png":
        body = b"IHDR" + struct.pack(">IIBBBBB", 20001, 30000, 8, 0, 0, 0, 0)
        return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + body + b"\0" * 40
    if kind == "bmp":
        return b"BM" + b"\0" * 12 + struct.pack("<Iii", 40, 20001, -30000) + b"\0" * 40
    return f"{kind} 20001 30000 {'' if kind == 'P4' else 255}\n".encode() + b"\0" * 40


@pytest.mark.parametrize("kind", ["png", "bmp", "P2", "P4", "P5", "P6"])
def test_too_large_an_image_is_refused_by_its_header_alone(tmp_path, kind, monkeypatch):
    def decode(*_args):
        raise AssertionError("decoded")

    path = write_pgm(tmp_path, PIXELS_TOP_DOWN)
    (tmp_path / "map.pgm").write_bytes(too_large(kind))
    monkeypatch.setattr(cv2, "imdecode", decode)
    with pytest.raises(DataError, match=r"map\.pgm: the image has 20001 x 30000 pixels, expected"):
        read_map(path)


# --- grey 205 -----------------------------------------------------------------------------------


@pytest.mark.parametrize("free_thresh", [0.196, 0.25])
@pytest.mark.parametrize("keys", [{}, {"mode": "scale"}, {"mode": "raw"}, {"negate": 1}])
def test_a_grey_for_unknown_that_is_free_by_rule_is_told(tmp_path, free_thresh, keys):
    """nav2's map saver wrote such files; where white is free, their grey is not."""
    said: list[str] = []
    path = write_pgm(tmp_path, PIXELS_TOP_DOWN, free_thresh=free_thresh, **keys)
    occupancy = read_map(path, said.append)
    if free_thresh == 0.196 or keys not in ({}, {"mode": "scale"}):
        assert not said
        return
    (sentence,) = said
    assert "free_thresh is 0.25, which makes the 3 pixels of grey 205 free" in sentence
    is_scale = "mode" in keys
    assert f"read as {'free' if is_scale else 'unknown'}" in sentence
    expected = np.where(VALUES < 0, 0, VALUES) if is_scale else VALUES
    np.testing.assert_array_equal(occupancy.values, expected)


def test_a_grey_that_may_be_free_is_free_where_nothing_else_is(tmp_path):
    said: list[str] = []
    occupancy = read_map(write_pgm(tmp_path, [[205, 0]], free_thresh=0.25), said.append)
    np.testing.assert_array_equal(occupancy.values, [[0, 100]])
    assert "read as free" in said[0]


def test_a_map_without_grey_205_is_not_warned_of(tmp_path):
    said: list[str] = []
    read_map(write_pgm(tmp_path, [[254, 0]], free_thresh=0.25), said.append)
    assert not said


# --- properties ---------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(20))
def test_any_map_comes_back_as_it_was(tmp_path, seed):
    """Raw keeps everything; trinary keeps decided cells; both keep the place bit by bit."""
    rng = np.random.default_rng(seed)
    shape = tuple(int(n) for n in rng.integers(1, 40, size=2))
    origin = SE2(*rng.normal(0.0, 1e6 if seed % 3 == 0 else 10.0, size=2), rng.uniform(-3, 3))
    spec = GridSpec(float(rng.choice([0.0125, 0.05, 1 / 3, 1e-5, 7.0])), *shape, origin)
    percent = OccupancyMap(spec, rng.integers(-1, 101, size=shape).astype(np.int8))
    decided = OccupancyMap(spec, rng.choice(np.array([-1, 0, 100], np.int8), size=shape))
    for mode, occupancy in (("raw", percent), ("raw", decided), ("trinary", decided)):
        first = write_map(tmp_path / f"m{mode}", occupancy, mode=mode)
        back = read_map(first[-1])
        assert back.spec == spec
        np.testing.assert_array_equal(back.values, occupancy.values)
        content = [path.read_bytes() for path in first]
        assert [
            p.read_bytes() for p in write_map(tmp_path / f"m{mode}", back, mode=mode)
        ] == content


def nav2_cell(shade: float, is_opaque: bool, mode: str, negate: bool, low: float, high: float):
    """One cell as nav2's map_server describes it."""
    occupied = shade if negate else 1.0 - shade
    if mode == "raw":
        percent = math.floor(shade * 255.0 + 0.5)
        return percent if percent <= 100 else -1
    if mode == "scale" and not is_opaque:
        return -1
    if occupied > high:
        return 100
    if occupied < low:
        return 0
    return round((occupied - low) / (high - low) * 100.0) if mode == "scale" else -1


@pytest.mark.parametrize("mode", ["trinary", "scale", "raw"])
@pytest.mark.parametrize("negate", [0, 1])
@pytest.mark.parametrize("num_channels", [1, 3, 4])
def test_cells_are_decided_as_map_server_does(tmp_path, mode, negate, num_channels):
    rng = np.random.default_rng(7)
    shape = (12, 15) if num_channels == 1 else (12, 15, num_channels)
    image = rng.integers(0, 256, size=shape).astype(np.uint8)
    low, high = 0.21, 0.6
    path = write_pgm(
        tmp_path, [[0]], image="m.png", mode=mode, negate=negate,
        free_thresh=low, occupied_thresh=high,
    )  # fmt: skip
    if num_channels == 4:
        image[rng.random((12, 15)) < 0.5, 3] = 255
    cv2.imwrite(str(tmp_path / "m.png"), image)
    grid = read_map(path).values
    for row in range(12):
        for col in range(15):
            pixel = np.atleast_1d(image[row, col]).astype(float)
            counted = pixel if mode == "trinary" else pixel[:3]
            is_opaque = num_channels < 4 or pixel[3] == 255
            shade = counted.sum() / len(counted) / 255.0
            expected = nav2_cell(shade, is_opaque, mode, bool(negate), low, high)
            assert grid[11 - row, col] == expected
