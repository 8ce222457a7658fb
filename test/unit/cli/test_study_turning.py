"""The study of turning sonars: recorded, examined and mapped, as a user would."""

import csv
import math

import pytest

from uw_dslam_ros2.cli.study import main


@pytest.mark.slow
def test_what_is_off_is_found_and_the_map_comes_right(tmp_path):
    arguments = ["--seeds", "1", "--first-seed", "4", "--duration", "300", "--width", "70"]
    assert main(["turning", "--out", str(tmp_path), *arguments, "--messages", "points"]) == 0
    with (tmp_path / "turning.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert row["clockwise"] == "True"
    off_deg = math.remainder(float(row["zero_deg"]) - 94.0, 360.0)
    assert abs(off_deg) < 4.0
    assert row["merged"] == "1 of 1"
    assert float(row["error_m"]) < 0.6
