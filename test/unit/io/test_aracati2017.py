"""The tables of Aracati 2017: literal values, and errors that say where."""

import gzip

import numpy as np
import pytest

from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.io.datasets.aracati2017 import read_aracati2017, read_published_runs

TABLES = {
    "keyframes": "keyframe_id,time_s\n0,10.5\n1,14.25\n",
    "detections": "keyframe_id,x_m,y_m\n1,5,-2\n0,3,1\n1,6,2\n",
    "cmd_vel": "time_s,vx_m_s,wz_rad_s\n10,0.4,0\n",
    "compass": "time_s,compass_rad\n10,0\n20,0\n",
    "dgps": "time_s,x_m,y_m\n10,0,0\n20,10,0\n",
}
RUNS = 'run,kind,time_s,x_m,y_m,yaw_rad\na,no USBL,1.5,1,2,0.5\nb,"USBL, context",2,3,4,0\n'


@pytest.fixture
def folder(tmp_path):
    for name, text in TABLES.items():
        (tmp_path / f"{name}.csv.gz").write_bytes(gzip.compress(text.encode()))
    return tmp_path


def test_literal_tables(folder) -> None:
    recording = read_aracati2017(folder)
    assert recording.keyframe_stamp_ns.tolist() == [10_500_000_000, 14_250_000_000]
    assert [points.tolist() for points in recording.points] == [[[3, 1]], [[5, -2], [6, 2]]]
    # North by compass is a yaw of 90 degrees from east.
    np.testing.assert_allclose(recording.yaw_rad, np.pi / 2)
    np.testing.assert_allclose(
        recording.truth_at(np.array([15_000_000_000])), [[5, 0, np.pi / 2]], atol=1e-12
    )
    assert read_published_runs(folder) == {}


def test_others_runs(folder) -> None:
    (folder / "bruce_runs.csv").write_text(RUNS)
    runs = read_published_runs(folder)
    assert list(runs) == ["USBL, context, b", "no USBL, a"]
    stamps_ns, poses = runs["no USBL, a"]
    assert stamps_ns.tolist() == [1_500_000_000]
    assert poses.tolist() == [[1, 2, 0.5]]


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("dgps", None, "dgps.csv.gz is missing"),
        ("dgps", "time,x,y\n", "line 1 must be time_s,x_m,y_m"),
        ("dgps", "time_s,x_m,y_m\n", "no rows"),
        ("dgps", "time_s,x_m,y_m\n1,2\n", "expected 3 numbers"),
        ("dgps", "time_s,x_m,y_m\n1,2,3\n4,five,6\n", "line 3"),
        ("dgps", "time_s,x_m,y_m\n1,nan,3\n", "line 2: 1,nan,3 is not finite"),
        ("detections", "keyframe_id,x_m,y_m\n7,1,1\n", "keyframe 7, there are 2"),
        ("keyframes", "keyframe_id,time_s\n3,1\n", "must count 0, 1, 2"),
    ],
)
def test_damaged_tables_are_named(folder, name, text, expected) -> None:
    file = folder / f"{name}.csv.gz"
    file.unlink()
    if text is not None:
        file.write_bytes(gzip.compress(text.encode()))
    with pytest.raises(DataError, match=expected):
        read_aracati2017(folder)


def test_damaged_runs_are_named(folder) -> None:
    (folder / "bruce_runs.csv").write_text(RUNS + "c,no USBL,1,2,3\n")
    with pytest.raises(DataError, match="line 4: 5 columns, expected 6"):
        read_published_runs(folder)
