"""The study of maps built apart, on a few of them."""

import csv

import numpy as np
import pytest

from uw_dslam_ros2.cli.studies import _map_methods
from uw_dslam_ros2.cli.studies._map_methods import at_one_resolution
from uw_dslam_ros2.cli.study import main
from uw_dslam_ros2.core.errors import ConfigError
from uw_dslam_ros2.core.grid import FREE, OCCUPIED, UNKNOWN, GridSpec, OccupancyMap
from uw_dslam_ros2.core.se2 import SE2


def test_apart_registers_a_few_pairs_and_keeps_the_maps(tmp_path, capsys):
    cache = tmp_path / "maps"
    arguments = ["--places", "2", "--vehicles", "2", "--different", "2", "--cache", str(cache)]
    assert main(["apart", "--out", str(tmp_path / "a"), *arguments]) == 0
    with (tmp_path / "a" / "apart.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert sum(row["group"] == "different" for row in rows) == 2
    assert all(row["matching"] == "False" for row in rows if row["group"] == "different")
    assert (tmp_path / "a" / "apart.png").read_bytes()[:4] == b"\x89PNG"
    text = capsys.readouterr().out
    assert "| different" in text
    assert "4 maps of 2 places" in text
    kept = {path: path.stat().st_mtime_ns for path in cache.rglob("*.npz")}
    assert len(kept) == 4
    methods = ["--methods", "ours", "without-proof", "orb", "akaze", "hough", "fourier-mellin"]
    assert main(["apart", "--out", str(tmp_path / "b"), *arguments, *methods]) == 0
    assert {path: path.stat().st_mtime_ns for path in cache.rglob("*.npz")} == kept
    with (tmp_path / "b" / "apart.csv").open() as file:
        again = list(csv.DictReader(file))
    assert [{**r, "seconds": ""} for r in rows] == [{**r, "seconds": ""} for r in again]
    with (tmp_path / "b" / "methods.csv").open() as file:
        compared = list(csv.DictReader(file))
    assert [row["method"] for row in compared[:6]] == methods[1:]
    ours = [row for row in compared if row["method"] == "ours"]
    plain = [row for row in again if row["group"] in ("one place", "different")]
    assert [(r["given"], r["matching"]) for r in ours] == [
        (r["accepted"], r["matching"]) for r in plain
    ]


def test_walls_outlast_a_coarser_cell():
    values = np.full((40, 60), FREE, np.int8)
    values[10, 5:50] = OCCUPIED
    values[:, 52:] = UNKNOWN
    fine = OccupancyMap(GridSpec(0.05, 40, 60, SE2(1.0, 2.0, 0.3)), values)
    coarse = OccupancyMap(GridSpec(0.25, 8, 12), np.full((8, 12), FREE, np.int8))
    made, same = at_one_resolution(fine, coarse)
    assert same is coarse
    assert made.spec == GridSpec(0.25, 8, 12, SE2(1.0, 2.0, 0.3))
    assert (made.values[2, 1:10] == OCCUPIED).all()
    assert (np.delete(made.values, 2, axis=0)[:, :11] == FREE).all()
    assert (made.values[:, 11] == UNKNOWN).all()


def test_a_method_that_is_not_installed_is_told(monkeypatch):
    monkeypatch.setattr(_map_methods, "is_installed", lambda _: False)
    with pytest.raises(ConfigError, match="kiss-matcher is not installed"):
        _map_methods.compare([], ["kiss-matcher"])
