"""The study command: every study is offered, and what it writes can be read."""

import csv
import math
import os
from itertools import pairwise

import numpy as np
import pytest

from uw_dslam_ros2.cli.studies import _verdict_trials, field, sigma
from uw_dslam_ros2.cli.studies._ceiling import best_with_known_noise
from uw_dslam_ros2.cli.studies._common import is_success
from uw_dslam_ros2.cli.studies._pair_list import PAIR_COLUMNS, read_pairs
from uw_dslam_ros2.cli.studies._trials import Cell
from uw_dslam_ros2.cli.study import build_parser, main, study_names
from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.maps.files import write_map
from uw_dslam_ros2.sim.maps.floor_plans import make_place
from uw_dslam_ros2.sim.maps.pairs import make_pair, observe


def test_every_study_has_help(capsys):
    assert "convergence" in study_names()
    for name in study_names():
        with pytest.raises(SystemExit) as stopped:
            build_parser().parse_args([name.replace("_", "-"), "--help"])
        assert stopped.value.code == 0
        assert "--out" in capsys.readouterr().out


def test_unknown_study_is_refused(capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["nothing"])
    assert stopped.value.code == 2
    assert "convergence" in capsys.readouterr().err


def test_convergence_traces_close_in(tmp_path, capsys):
    arguments = ["--points", "8", "--sigma", "0.2", "--gap", "0.05"]
    assert main(["convergence", "--out", str(tmp_path / "new"), *arguments]) == 0
    assert (tmp_path / "new" / "convergence.png").read_bytes()[:4] == b"\x89PNG"
    with (tmp_path / "new" / "convergence.csv").open() as file:
        rows = list(csv.DictReader(file))
    searches = {row["search"] for row in rows}
    assert len(searches) == 3
    optimum = {}
    for search in searches:
        lower = [float(row["lower"]) for row in rows if row["search"] == search]
        upper = [float(row["upper"]) for row in rows if row["search"] == search]
        assert all(a <= b for a, b in pairwise(lower))
        assert all(a >= b for a, b in pairwise(upper))
        optimum[search] = (lower[-1], upper[-1])
    # The engine and the reference enclose the same optimum.
    reference, engine = optimum["reference, N = 1"], optimum["engine"]
    assert max(reference[0], engine[0]) <= min(reference[1], engine[1])
    assert "| engine" in capsys.readouterr().out


def test_output_that_cannot_be_written_is_an_error(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main(["convergence", "--out", str(tmp_path / "file" / "below")]) == 1
    assert "cannot write" in capsys.readouterr().err


def test_outliers_writes_trials_that_agree_with_its_summary(tmp_path, capsys):
    methods = ["--methods", "engine", "true pairs", "ICP"]
    arguments = ["--only", "paper", "--points", "15", "--trials", "2", *methods]
    assert main(["outliers", "--out", str(tmp_path), *arguments]) == 0
    with (tmp_path / "outliers.csv").open() as file:
        trials = list(csv.DictReader(file))
    with (tmp_path / "summary.csv").open() as file:
        summary = list(csv.DictReader(file))
    assert len(trials) == 4 * 2 * 3
    for row in summary:
        own = [t for t in trials if all(t[k] == row[k] for k in ("outliers", "noise_m", "method"))]
        assert len(own) == 2
        assert float(row["success"]) == sum(int(t["success"]) for t in own) / 2
    # Without noise the limit is exact.
    exact = [t for t in trials if t["method"] == "true pairs" and t["noise_m"] == "0.0"]
    assert len(exact) == 3 * 2
    assert all(float(trial["error_deg"]) < 1e-9 for trial in exact)
    assert (tmp_path / "figure4.png").exists()
    assert "the paper" in capsys.readouterr().out


def test_outliers_refuses_an_unknown_method(tmp_path, capsys):
    assert main(["outliers", "--out", str(tmp_path), "--methods", "magic"]) == 1
    assert "magic" in capsys.readouterr().err


def test_nnde_says_which_recording_is_missing(tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("UW_DATA_DIR", raising=False)
    assert main(["nnde", "--out", str(tmp_path)]) == 1
    assert "freiburg079" in capsys.readouterr().err
    assert main(["nnde", "--out", str(tmp_path), "--data", str(tmp_path / "nowhere")]) == 1
    assert "nowhere" in capsys.readouterr().err


@pytest.mark.data
@pytest.mark.skipif("UW_DATA_DIR" not in os.environ, reason="UW_DATA_DIR names no recordings")
def test_nnde_registers_scans_of_the_recording(tmp_path, capsys):
    assert main(["nnde", "--out", str(tmp_path), "--pairs", "3", "--voxel", "0.3"]) == 0
    assert (tmp_path / "figure5.png").exists()
    with (tmp_path / "nnde.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3 * 4
    engine = [float(row["error_deg"]) for row in rows if row["stage"] == "engine"]
    assert sorted(engine)[1] < 0.5  # the median pair; 0.1 degrees were seen
    assert "second registration" in capsys.readouterr().out


def test_sigma_compares_fixed_kernels_with_the_engine(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sigma, "_CELLS", (Cell(15, 0.3), Cell(15, 0.0, 0.02)))
    monkeypatch.setattr(sigma, "_MULTIPLES", (0.3, 1.0))
    assert main(["sigma", "--out", str(tmp_path), "--trials", "2"]) == 0
    with (tmp_path / "sigma.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * (2 + 1 + 1)  # fixed kernels, the paper's, the engine
    assert [float(row["sigma_m"]) for row in rows if row["is_paper"] == "1"] == [0.1, 0.1]
    assert "engine as it is" in capsys.readouterr().out


def _rows(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_verdict_reads_real_pairs_from_a_list(tmp_path):
    pair = make_pair("harbour", 0.7, "clean", 1, size_cells=60)
    for name, occupancy in (("one", pair.source), ("other", pair.target)):
        write_map(tmp_path / name, occupancy)
    T, path = pair.T_target_source, tmp_path / "pairs.csv"
    lines = [
        ",".join(PAIR_COLUMNS),
        f"one.yaml,other.yaml,here,{T.x},{T.y},{math.degrees(T.yaw)},1",
        "one.yaml,one.yaml,here there,,,,",
    ]
    path.write_text("\n".join(lines) + "\n")
    own, different = read_pairs(path)
    assert own.pair.T_target_source.as_array() == pytest.approx(T.as_array())
    assert own.is_like_its_mirror
    assert not different.is_like_its_mirror
    assert different.pair.T_target_source is None
    assert [task.has_mirror for task in _verdict_trials.listed_tasks(path)] == [False, True]
    for wrong, said in (
        (lines[0].replace("yaw_deg", "yaw"), "no column yaw_deg"),
        (f"{lines[0]}\n{lines[2].replace(',,,', ',1,,')}", "line 2: the motion is"),
    ):
        path.write_text(wrong + "\n")
        with pytest.raises(DataError, match=said):
            list(read_pairs(path))


def test_overlap_counts_what_it_accepts(tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("UW_DATA_DIR", raising=False)
    arguments = ["--kinds", "harbour", "--overlaps", "0.7", "--noises", "clean", "--seeds", "2"]
    assert main(["overlap", "--out", str(tmp_path), *arguments]) == 0
    rows = _rows(tmp_path / "pairs.csv")
    assert sum(row["matching"] == "True" for row in rows) == 2
    # Clean windows of one map that share 70 % of their walls: the easiest there is.
    matching = [row for row in rows if row["matching"] == "True"]
    assert [(row["accepted"], row["right"]) for row in matching] == 2 * [("True", "True")]
    for row in matching:
        assert float(row["error_cells"]) < 0.3  # 0.08 cells were seen
        assert 0.0 < float(row["nees"]) < 16.0  # one in a thousand is above
    others = [row for row in rows if row["matching"] == "False"]
    assert all(row["accepted"] == "False" for row in others)
    assert all(float(row["probability"]) < 0.5 for row in others)
    assert "clean | 70%" in capsys.readouterr().out
    assert (tmp_path / "overlap.png").exists()


def test_field_scores_all_methods_on_the_same_pairs(tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("UW_DATA_DIR", raising=False)
    arguments = ["--kinds", "harbour", "--overlaps", "0.7", "--noises", "noisy", "--seeds", "1"]
    methods = field._methods()
    slow = ("paper (ORB, GMRBnB, NNDE)", "NDT, 36 starts")
    quick = {name: method for name, method in methods.items() if name not in slow}
    assert len(quick) == len(methods) - 2
    monkeypatch.setattr(field, "_methods", lambda: quick)
    assert main(["field", "--out", str(tmp_path), *arguments]) == 0
    rows = _rows(tmp_path / "field.csv")
    assert {row["method"] for row in rows} == set(quick)
    assert len(rows) == len(quick)
    # Nothing is nearer to the map merged by the truth than a map merged within two cells.
    near = [float(r["mse"]) for r in rows if r["right"] == "True" and float(r["error_m"]) < 0.1]
    wrong = [float(r["mse"]) for r in rows if (r["answered"], r["right"]) == ("True", "False")]
    assert len(near) >= 2
    assert len(wrong) >= 1
    assert max(near) < min(wrong)
    assert (tmp_path / "harbour_70.png").exists()
    assert "ORB + RANSAC" in capsys.readouterr().out


def _written_place(folder, name, seed):
    rng = np.random.default_rng(seed)
    values = observe(make_place("office", 700, rng), rng)
    write_map(folder / name, OccupancyMap(GridSpec(0.05, *values.shape, SE2()), values))
    return folder / f"{name}.yaml"


def test_windows_of_given_maps_are_registered(tmp_path, capsys):
    maps = [str(_written_place(tmp_path, f"floor_{k}", k)) for k in range(2)]
    arguments = ["--maps", *maps, "--overlaps", "0.7", "--noises", "clean", "--size", "10"]
    assert main(["windows", "--out", str(tmp_path), *arguments]) == 0
    rows = _rows(tmp_path / "windows.csv")
    matching = [row for row in rows if row["matching"] == "True"]
    assert [row["map"] for row in matching] == ["floor_0", "floor_1"]
    assert all(row["right"] == "True" for row in matching)
    others = [row for row in rows if row["matching"] == "False"]
    assert len(others) == 4  # elsewhere on the same map, and on the other one
    assert not any(row["accepted"] == "True" for row in others)
    assert "maps of different places: 0 of 4 accepted" in capsys.readouterr().out


def test_windows_says_which_map_is_too_small(tmp_path, capsys):
    path = _written_place(tmp_path, "floor", 0)
    arguments = ["--maps", str(path), "--size", "60"]
    assert main(["windows", "--out", str(tmp_path), *arguments]) == 1
    assert "map floor: no two windows of 1200 cells" in capsys.readouterr().err


def test_windows_refuses_two_maps_of_one_name(tmp_path, capsys):
    (tmp_path / "other").mkdir()
    paths = [_written_place(folder, "floor", 0) for folder in (tmp_path, tmp_path / "other")]
    assert main(["windows", "--out", str(tmp_path), "--maps", *map(str, paths)]) == 1
    assert "two files floor.yaml" in capsys.readouterr().err
    assert not (tmp_path / "windows.csv").exists()


def test_outliers_refuses_a_cell_that_is_not_there(tmp_path, capsys):
    arguments = ["--only", "paper", "--cells", "outliers 41%"]
    assert main(["outliers", "--out", str(tmp_path), *arguments]) == 1
    assert "outliers 41%" in capsys.readouterr().err


def test_knowing_noise_and_overlap_finds_what_is_there():
    for seed in range(3):
        problem = Cell(25, 0.0, 0.02, 0.6).problem(seed)
        assert is_success(best_with_known_noise(problem), problem.T_target_source)
