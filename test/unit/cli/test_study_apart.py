"""The studies that need maps built apart, on a few of them."""

import csv

import numpy as np
import pytest

from uw_dslam_ros2.cli.studies import _map_methods, _verdict_trials, verdict
from uw_dslam_ros2.cli.studies._apart_maps import apart_maps
from uw_dslam_ros2.cli.studies._map_methods import at_one_resolution
from uw_dslam_ros2.cli.study import main
from uw_dslam_ros2.core.errors import ConfigError
from uw_dslam_ros2.core.grid import FREE, OCCUPIED, UNKNOWN, GridSpec, OccupancyMap
from uw_dslam_ros2.core.se2 import SE2

# Two places whose surveys are short.
FIRST_PLACE, LAST_PLACE = 2, 3


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """Where maps are kept, which are made by the test that comes first."""
    return tmp_path_factory.mktemp("apart") / "maps"


def rows_of(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_apart_registers_a_few_pairs_and_keeps_the_maps(cache, tmp_path, capsys):
    arguments = ["--first-seed", str(FIRST_PLACE), "--places", "2", "--vehicles", "2"]
    arguments += ["--different", "2", "--cache", str(cache)]
    assert main(["apart", "--out", str(tmp_path / "a"), *arguments]) == 0
    rows = rows_of(tmp_path / "a" / "apart.csv")
    assert {row["group"] for row in rows} == {"one place", "different"}
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
    again = rows_of(tmp_path / "b" / "apart.csv")
    assert [{**r, "seconds": ""} for r in rows] == [{**r, "seconds": ""} for r in again]
    compared = rows_of(tmp_path / "b" / "methods.csv")
    assert [row["method"] for row in compared[:6]] == methods[1:]
    ours = [row for row in compared if row["method"] == "ours"]
    plain = [row for row in again if row["group"] in ("one place", "different")]
    assert [(r["given"], r["matching"]) for r in ours] == [
        (r["accepted"], r["matching"]) for r in plain
    ]


def test_verdict_prints_models_that_can_be_pasted(cache, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(_verdict_trials, "SIZES", (120,))
    monkeypatch.setattr(verdict, "_NUM_VEHICLES", 2)
    monkeypatch.setattr(
        verdict,
        "apart_maps",
        lambda places, *rest: apart_maps([LAST_PLACE + place for place in places], *rest),
    )
    kinds = ["--fit-kinds", "harbour", "--check-kinds", "harbour", "--overlaps", "0.7"]
    few = ["--seeds", "1", "--checks", "1", "--places", "1", "--check-places", "0"]
    kept = ["--cache", str(cache)]
    assert main(["verdict", "--out", str(tmp_path), *few, *kinds, *kept]) == 0
    printed = capsys.readouterr().out
    assert "pose=(" in printed
    assert "match=(" in printed
    assert (tmp_path / "reliability.png").read_bytes()[:4] == b"\x89PNG"
    apart = rows_of(tmp_path / "fit_apart.csv")
    assert {row["is_matching"] for row in apart} == {"True", "False"}
    for name in ("fit.csv", "check.csv"):
        rows = rows_of(tmp_path / name)
        assert {row["noise"] for row in rows} == {"clean", "noisy", "hard"}
        clean = [r for r in rows if r["noise"] == "clean" and r["is_matching"] == "True"]
        assert {row["is_right"] for row in clean} == {"True"}
        assert {r["is_right"] for r in rows if r["is_matching"] == "False"} == {"False"}


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
