"""Commands as people call them: help, exit codes, and what is said about wrong input."""

from __future__ import annotations

import importlib
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from unit.cli import missions

from uw_dslam_ros2.cli import common, evaluate, offline, register
from uw_dslam_ros2.cli.reporting.outcome import write_outcome
from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.registration import Verdict
from uw_dslam_ros2.io.maps.files import write_map
from uw_dslam_ros2.io.trajectories import write_tum

COMMANDS = (
    "demo",
    "doctor",
    "offline",
    "merge",
    "evaluate",
    "register",
    "simulate",
    "convert",
    "study",
)


@pytest.mark.parametrize("name", COMMANDS)
def test_help_is_given(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    module = importlib.import_module(f"uw_dslam_ros2.cli.{name}")
    with pytest.raises(SystemExit) as caught:
        module.main(["--help"])
    assert caught.value.code == 0
    text = capsys.readouterr().out
    assert text.startswith("usage: ")
    has_example = name not in ("simulate", "study")
    assert ("Example:" in text) == has_example


@pytest.mark.parametrize("name", [n for n in COMMANDS if n != "demo"])
def test_wrong_usage_is_exit_code_2(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    module = importlib.import_module(f"uw_dslam_ros2.cli.{name}")
    with pytest.raises(SystemExit) as caught:
        module.main([])
    assert caught.value.code == 2
    assert "usage: " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("main", "arguments", "said"),
    [
        (offline.main, ["nothing.mcap", "--out", "out"], "nothing.mcap"),
        (offline.main, ["bag", "--out", "out", "--config", "no.yaml"], "bag"),
        (evaluate.main, ["nothing", "--truth", "nothing"], "nothing is no result"),
        (register.main, ["a.yaml", "b.yaml"], "cannot read a.yaml"),
        (register.main, ["a.yaml", "b.yaml", "--config", "no.yaml"], "cannot read no.yaml"),
    ],
)
def test_a_missing_file_is_one_line_and_exit_code_2(
    main, arguments, said, tmp_path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == common.EXIT_BAD_INPUT
    error = capsys.readouterr().err
    assert re.fullmatch(r"\w+: error: [^\n]*\n", error)
    assert said in error
    assert not (tmp_path / "out").exists()


def test_an_unexpected_error_is_not_hidden() -> None:
    def fail() -> int:
        raise RuntimeError("a bug")

    with pytest.raises(RuntimeError, match="a bug"):
        common.run_command("name", fail)


def test_errors_and_interrupts_have_exit_codes(capsys: pytest.CaptureFixture[str]) -> None:
    def refuse() -> int:
        raise DataError("file x is broken")

    def interrupt() -> int:
        raise KeyboardInterrupt

    assert common.run_command("name", refuse) == 2
    assert common.run_command("name", interrupt) == 130
    assert capsys.readouterr().err == "name: error: file x is broken\nname: interrupted\n"


def test_output_that_nobody_reads_to_its_end_is_no_error() -> None:
    program = (
        "import sys; from uw_dslam_ros2.cli.common import run_command\n"
        "def talk():\n"
        "    for k in range(200_000): print(k)\n"
        "    return 0\n"
        "sys.exit(run_command('name', talk))"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline() == b"0\n"
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait() == 141


# --- evaluate --------------------------------------------------------------------------------


@pytest.fixture
def result_folder(tmp_path: Path) -> Path:
    """A result and its truth."""
    write_outcome(tmp_path / "result", missions.outcome())
    for name, trajectory in missions.truth().trajectories.items():
        write_tum(tmp_path / "truth" / f"{name}.tum", *trajectory)
    return tmp_path


def test_evaluate_scores_a_result_folder(result_folder, capsys) -> None:
    arguments = [str(result_folder / "result"), "--truth", str(result_folder / "truth")]
    assert evaluate.main([*arguments, "--json"]) == 0
    scores = json.loads(capsys.readouterr().out)
    assert scores["trajectory"]["rmse_m"] < 1e-3
    assert set(scores["trajectory"]["rmse_m_by_vehicle"]) == {"auv_1", "auv_2"}
    assert evaluate.main(arguments) == 0
    assert "auv_3: not merged" in capsys.readouterr().out


def test_evaluate_compares_two_files(result_folder, capsys) -> None:
    file = result_folder / "result" / "trajectories" / "auv_1.tum"
    truth = result_folder / "truth" / "auv_2.tum"
    assert evaluate.main([str(file), "--truth", str(truth), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["trajectory"]["rmse_m"] < 1e-3


def test_evaluate_puts_others_beside_it(result_folder, capsys) -> None:
    file = result_folder / "result" / "trajectories" / "auv_1.tum"
    true = result_folder / "truth" / "auv_1.tum"
    write_tum(result_folder / "others" / "same.tum", missions.STAMPS, missions.WAY)
    beside = ["--beside", str(result_folder / "others")]
    assert evaluate.main([str(file), "--truth", str(true), *beside, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rmse_m_of_others"]["same"] < 1e-3
    assert evaluate.main([str(file), "--truth", str(true), *beside]) == 0
    assert "same: 0.000 m" in capsys.readouterr().out
    result = str(result_folder / "result")
    assert evaluate.main([result, "--truth", str(true.parent), *beside]) == 2
    assert "--beside needs a truth of one vehicle, this one has 3" in capsys.readouterr().err
    beside[1] = str(result_folder / "nothing")
    assert evaluate.main([str(file), "--truth", str(true), *beside]) == 2
    assert "holds no .tum file" in capsys.readouterr().err


def test_evaluate_says_when_there_is_nothing_to_compare(result_folder, capsys) -> None:
    other = result_folder / "other"
    write_tum(other / "ship.tum", missions.STAMPS, missions.WAY)
    assert evaluate.main([str(result_folder / "result"), "--truth", str(other)]) == 2
    assert "has no trajectory of auv_1, auv_2; it has ship" in capsys.readouterr().err


# --- register --------------------------------------------------------------------------------


def test_every_verdict_has_an_exit_code_of_its_own() -> None:
    codes = list(register.EXIT_CODES.values())
    assert set(register.EXIT_CODES) == set(Verdict)
    assert len(set(codes)) == len(codes)
    assert register.EXIT_CODES[Verdict.ACCEPTED] == 0
    assert not {1, 2} & set(codes)


def test_register_tells_the_verdict_by_its_exit_code(tmp_path, monkeypatch, capsys) -> None:
    write_map(tmp_path / "a", missions.room())
    maps = [str(tmp_path / "a.yaml"), str(tmp_path / "a.yaml")]
    answers = {}

    def planted(*_args, prior=None, **_kwargs):
        request = type("Request", (), {})()
        request.source_reference = answers["vehicle"], 0
        request.target_reference = "auv_1", 0
        answers["prior"] = prior
        return missions.answer(request)

    monkeypatch.setattr(register, "register_grids", planted)
    for vehicle, code in (("auv_2", 0), ("auv_3", 4)):
        answers["vehicle"] = vehicle
        assert register.main(maps) == code
        text = capsys.readouterr().out
        assert ("refused" in text) is (code != 0)
    window = ["--prior", "1", "2", "0.5", "--window", "3", "0.2"]
    picture = tmp_path / "overlay.png"
    assert register.main([*maps, *window, "--out", str(picture), "--json"]) == 4
    plain = json.loads(capsys.readouterr().out)
    assert plain["verdict"] == "NOT_ENOUGH_OVERLAP"
    assert plain["seconds"] is None
    assert answers["prior"].half_width_m == 3.0
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_register_makes_up_no_pose_where_none_was_judged(tmp_path, capsys) -> None:
    unknown = OccupancyMap(GridSpec(0.05, 40, 50), np.full((40, 50), -1, np.int8))
    write_map(tmp_path / "a", unknown)
    maps, picture = [str(tmp_path / "a.yaml")] * 2, tmp_path / "overlay.png"
    code = register.EXIT_CODES[Verdict.TOO_FEW_FEATURES]
    assert register.main([*maps, "--out", str(picture)]) == code
    said = capsys.readouterr()
    assert "TOO_FEW_FEATURES, refused before any pose was judged" in said.out
    assert "no picture" in said.err
    assert not picture.exists()
    assert register.main([*maps, "--json"]) == code
    plain = json.loads(capsys.readouterr().out)
    assert plain["T_target_source"] is None
    assert plain["covariance"] == [[None] * 3] * 3
    assert (plain["score"], plain["lower_bound"], plain["upper_bound"]) == (None, 0.0, 1.0)


@pytest.mark.parametrize(
    "extra", [["--prior", "1", "2", "3"], ["--window", "1", "1"], ["--prior", "0", "0", "0",
    "--window", "-1", "1"]],
)  # fmt: skip
def test_register_refuses_half_a_window(extra, capsys) -> None:
    with pytest.raises(SystemExit) as caught:
        register.main(["a.yaml", "b.yaml", *extra])
    assert caught.value.code == 2
    assert "--window" in capsys.readouterr().err
