"""The CARMEN log reader: literal values, geometry, and errors that say where."""

import gzip
import math
import os
from pathlib import Path

import numpy as np
import pytest

from uw_dslam_ros2.core.errors import DataError, InvalidInputError
from uw_dslam_ros2.io.datasets.freiburg import read_carmen_log

LINES = """# a comment
PARAM robot_length 0.47 1071078718.4 merci 1071078718.4
FLASER 4 1.0 2.0 81.91 3.0 0.5 -0.25 0.1 5 6 0.2 10.25 host 10.5
ODOM 1 2 3 0 0 0 1071.0 host 1071.0
FLASER 4 1.5 2.5 3.5 4.5 1.5 -1.25 -3.1 5 6 0.2 10.75 host 11.0
"""


def written(tmp_path, text, name="log.gz"):
    path = tmp_path / name
    path.write_bytes(gzip.compress(text.encode()) if name.endswith("gz") else text.encode())
    return path


@pytest.mark.parametrize("name", ["log.gz", "log.txt"])
def test_literal_lines(tmp_path, name):
    log = read_carmen_log(written(tmp_path, LINES, name))
    assert len(log) == 2
    np.testing.assert_array_equal(log.ranges_m, [[1.0, 2.0, 81.91, 3.0], [1.5, 2.5, 3.5, 4.5]])
    np.testing.assert_allclose(np.degrees(log.angles_rad), [-90, -45, 0, 45])
    np.testing.assert_array_equal(log.poses, [[0.5, -0.25, 0.1], [1.5, -1.25, -3.1]])
    np.testing.assert_array_equal(log.odometry, [[5, 6, 0.2], [5, 6, 0.2]])
    np.testing.assert_array_equal(log.stamps_s, [10.25, 10.75])
    # The beam without an echo is left out; the first beam lies to the right, at -y.
    half = math.sqrt(0.5)
    np.testing.assert_allclose(
        log.points(0), [[0, -1], [2 * half, -2 * half], [3 * half, 3 * half]], atol=1e-12
    )
    with pytest.raises(InvalidInputError, match="2"):
        log.points(2)


def test_damaged_files_are_named(tmp_path):
    with pytest.raises(DataError, match="missing"):
        read_carmen_log(tmp_path / "missing.gz")
    with pytest.raises(DataError, match="no FLASER"):
        read_carmen_log(written(tmp_path, "PARAM a b\n"))
    with pytest.raises(DataError, match="line 3"):
        read_carmen_log(written(tmp_path, LINES.replace("FLASER 4 1.0", "FLASER 5 1.0")))
    with pytest.raises(DataError, match="line 5"):
        read_carmen_log(written(tmp_path, LINES.replace("4.5", "four")))
    with pytest.raises(DataError, match="line 3"):
        read_carmen_log(written(tmp_path, LINES.replace("81.91", "nan")))
    whole = written(tmp_path, LINES).read_bytes()
    (tmp_path / "cut.gz").write_bytes(whole[:-12])
    with pytest.raises(DataError, match="cut off"):
        read_carmen_log(tmp_path / "cut.gz")


@pytest.mark.data
@pytest.mark.skipif("UW_DATA_DIR" not in os.environ, reason="UW_DATA_DIR names no recordings")
def test_walls_of_the_real_log_agree_between_neighbouring_scans():
    """Corrected poses bring scans half a metre apart onto each other: signs and axes are right."""
    log = read_carmen_log(Path(os.environ["UW_DATA_DIR"]) / "freiburg079")
    assert log.ranges_m.shape == (4791, 360)
    steps = np.linalg.norm(np.diff(log.poses[:, :2], axis=0), axis=1)
    turns = np.abs(np.diff(np.unwrap(log.poses[:, 2])))
    moving = np.flatnonzero((steps > 0.05) & (turns > 0.02))[::40]
    gaps = {"log": [], "mirrored": []}
    for i in moving:
        T = log.T_map_laser(i + 1).inverse() @ log.T_map_laser(i)
        for name, sign in (("log", 1), ("mirrored", -1)):
            source = log.points(i, 8.0) * [1, sign]
            target = log.points(i + 1, 8.0) * [1, sign]
            moved = T.apply(source)
            distance = np.linalg.norm(moved[:, None] - target[None], axis=2).min(axis=1)
            gaps[name].append(np.median(distance))
    assert np.median(gaps["log"]) < 0.03
    assert np.median(gaps["log"]) < 0.7 * np.median(gaps["mirrored"])
