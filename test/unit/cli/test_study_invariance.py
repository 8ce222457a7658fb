"""The study of what an answer must not depend on."""

from uw_dslam_ros2.cli.study import main
from uw_dslam_ros2.sim.maps.variants import VARIANTS


def test_the_study_tells_every_pair_in_every_way(tmp_path, capsys):
    arguments = ["--seeds", "1", "--kinds", "office", "--overlaps", "0.7", "--noises", "clean"]
    assert main(["invariance", "--out", str(tmp_path), *arguments, "--size", "90"]) == 0
    table = capsys.readouterr().out
    assert all(name in table for name in (*VARIANTS, "cells 3 times as large", "mirrored"))
    assert len((tmp_path / "invariance.csv").read_text().splitlines()) > len(VARIANTS)
