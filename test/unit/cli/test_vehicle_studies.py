"""Studies of one vehicle: real pings, and a mission before and after SLAM."""

import csv
import os

import pytest

from uw_dslam_ros2.cli.study import main


@pytest.mark.data
@pytest.mark.skipif(
    not os.environ.get("UW_DATA_DIR"), reason="UW_DATA_DIR is not set: no real Oculus pings"
)
def test_sonar_draws_the_pings_and_compares_the_speckle(tmp_path, capsys):
    assert main(["sonar", "--out", str(tmp_path)]) == 0
    for name in ("oculus.png", "speckle.png"):
        assert (tmp_path / name).read_bytes()[:4] == b"\x89PNG"
    with (tmp_path / "speckle.csv").open() as file:
        real, simulated = csv.DictReader(file)
    assert float(simulated["variation"]) == pytest.approx(float(real["variation"]), abs=0.03)
    assert "| Oculus" in capsys.readouterr().out


def test_sonar_without_pings_says_what_is_missing(tmp_path, capsys):
    (tmp_path / "data").mkdir()
    arguments = ["--data", str(tmp_path / "data"), "--out", str(tmp_path / "out")]
    assert main(["sonar", *arguments]) == 1
    assert "pings.npz" in capsys.readouterr().err


@pytest.mark.slow
def test_slam_scores_every_estimator(tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("UW_DATA_DIR", raising=False)
    arguments = ["--seeds", "1", "--lake-seeds", "0", "--duration", "30", "--ping-rate", "1"]
    assert main(["slam", "--out", str(tmp_path), *arguments]) == 0
    assert (tmp_path / "harbour_0.png").read_bytes()[:4] == b"\x89PNG"
    with (tmp_path / "slam.csv").open() as file:
        (row,) = csv.DictReader(file)
    for name in ("dead_reckoning", "scan_matching", "particle_filter"):
        assert 0.0 <= float(row[name]) < 1.0
    assert 0.0 < float(row["iou_after"]) <= 1.0
    shown = capsys.readouterr().out
    assert "aracati2017 is left out" in shown
    assert "harbour, scan_matching over dead reckoning in 1 missions" in shown
