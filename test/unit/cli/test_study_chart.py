"""The study of the chart on a short mission."""

import csv

import pytest

from uw_dslam_ros2.cli.study import main


@pytest.mark.slow
def test_every_stage_is_drawn_and_scored(tmp_path, capsys):
    arguments = ["--vehicles", "1", "--duration", "12"]
    assert main(["chart", "--out", str(tmp_path), *arguments]) == 0
    with (tmp_path / "chart.csv").open() as file:
        rows = {row["stage"]: row for row in csv.DictReader(file)}
    assert len(rows) == 11
    ideal = float(rows["all true: poses, mounting, sound, echoes"]["IoU cell"])
    found = float(rows["last pass, poses refined: offline's chart"]["IoU cell"])
    assert ideal > found > 0.0
    printed = capsys.readouterr().out
    assert "| drawn with" in printed
    assert "| harbour, seed 0 | 1 of 1 | chart" in printed
