"""What is taken out of a queue, and the files that it becomes."""

from __future__ import annotations

import csv
import filecmp
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from unit.cli import missions

from uw_dslam_ros2.cli.reporting.outcome import (
    RegistrationRow,
    names_of,
    outcome_of,
    write_outcome,
)
from uw_dslam_ros2.cli.reporting.report import RunFacts, render_html
from uw_dslam_ros2.cli.reporting.scoring import score
from uw_dslam_ros2.core.merging import MapQueue
from uw_dslam_ros2.core.merging.graph.answers import Answer
from uw_dslam_ros2.core.registration.result import RegistrationResult, Verdict
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId
from uw_dslam_ros2.io.maps.files import read_map
from uw_dslam_ros2.io.sessions.session import load_session, save_session
from uw_dslam_ros2.io.trajectories import read_g2o, read_tum


def test_refused_vehicles_are_not_merged() -> None:
    outcome = missions.outcome()
    assert {v.vehicle_id: v.is_merged for v in outcome.vehicles} == {
        "auv_1": True,
        "auv_2": True,
        "auv_3": False,
    }
    assert outcome.num_merged_vehicles == 2
    assert "2%" in outcome.vehicles[2].reason
    assert set(outcome.trajectories()) == {"auv_1", "auv_2"}
    assert outcome.verdict_counts()["ACCEPTED"] >= 1
    used = [row for row in outcome.registrations if row.is_used]
    assert used
    assert all("auv_3" not in row.source + row.target for row in used)


def test_merged_trajectories_lie_as_in_the_world() -> None:
    trajectories = missions.outcome().trajectories()
    T_map_world = missions.T_WORLD_ODOM["auv_1"].inverse()
    for name in ("auv_1", "auv_2"):
        T_map_odom = T_map_world @ missions.T_WORLD_ODOM[name]
        expected = [(T_map_odom @ SE2.from_array(p)).as_array() for p in missions.WAY]
        np.testing.assert_allclose(trajectories[name][1], expected, atol=1e-3)


def test_the_numbers_of_an_answer_are_listed_and_survive_a_session(tmp_path: Path) -> None:
    queue = missions.settled_queue()
    save_session(tmp_path, queue)
    for rows in (
        outcome_of(queue).registrations,
        outcome_of(load_session(tmp_path)).registrations,
    ):
        assert rows
        for row in rows:
            assert (row.score, row.lower_bound, row.upper_bound) == (0.5, 0.5, 0.52)
            assert row.gap == pytest.approx(0.02 / 0.52)
            assert (row.num_boxes, row.is_certified, row.num_target_points) == (1234, True, 120)


def test_a_refusal_without_a_pose_is_listed_without_numbers(tmp_path: Path) -> None:
    queue = missions.settled_queue()
    few = RegistrationResult.refused(Verdict.TOO_FEW_FEATURES, "few")
    answers = [Answer.of(answer.query, few) for answer, _ in queue.answers()]
    outcome = replace(
        outcome_of(queue),
        registrations=tuple(RegistrationRow.of(k, a, False) for k, a in enumerate(answers)),
    )
    write_outcome(tmp_path, outcome)
    rows = json.loads((tmp_path / "registrations.json").read_text())
    assert len(rows) == len(answers) > 0
    for row in rows:
        assert (row["verdict"], row["reason"]) == ("TOO_FEW_FEATURES", "few")
        assert {row[name] for name in ("x", "y", "yaw", "sigma_x", "score", "overlap")} == {None}
    with (tmp_path / "registrations.csv").open() as file:
        assert {row["x"] for row in csv.DictReader(file)} == {""}
    facts = RunFacts("title", [], "", {}, {}, {})
    assert "few" in render_html(outcome, facts, score(None, {}, {}, None), {"before_after": b""})


def test_files_hold_the_outcome(tmp_path: Path) -> None:
    outcome = missions.outcome()
    write_outcome(tmp_path, outcome)
    assert outcome.global_map is not None
    assert read_map(tmp_path / "global_map.yaml").spec == outcome.global_map.spec
    assert len(list((tmp_path / "submaps").glob("*.yaml"))) == 3
    stamps_ns, poses = read_tum(tmp_path / "trajectories" / "auv_2.tum")
    np.testing.assert_array_equal(stamps_ns, missions.STAMPS)
    np.testing.assert_allclose(poses, outcome.trajectories()["auv_2"][1], atol=1e-8)
    assert not (tmp_path / "trajectories" / "auv_3.tum").exists()
    assert (tmp_path / "trajectories" / "auv_3_alone.tum").exists()
    vertices, edges = read_g2o(tmp_path / "pose_graph.g2o")
    assert sorted(vertices) == [0, 1]
    assert len(edges) >= 1
    rows = json.loads((tmp_path / "registrations.json").read_text())
    assert len(rows) == len(outcome.registrations)
    with (tmp_path / "registrations.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [row["verdict"] for row in table] == [row["verdict"] for row in rows]
    states = json.loads((tmp_path / "submaps" / "submaps.json").read_text())
    assert [state["state"] for state in states] == ["MERGED", "MERGED", "WAITING"]


def test_the_same_outcome_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_outcome(tmp_path / name, missions.outcome())
    files = [f.relative_to(tmp_path / "a") for f in (tmp_path / "a").rglob("*") if f.is_file()]
    assert files
    same, different, missing = filecmp.cmpfiles(
        tmp_path / "a", tmp_path / "b", [str(f) for f in files], shallow=False
    )
    assert (len(same), different, missing) == (len(files), [], [])


def test_an_empty_queue_has_an_empty_outcome(tmp_path: Path) -> None:
    outcome = outcome_of(MapQueue())
    assert (outcome.vehicles, outcome.global_map, outcome.registrations) == ((), None, ())
    write_outcome(tmp_path, outcome)
    assert json.loads((tmp_path / "registrations.json").read_text()) == []


def test_names_of_submaps_are_short() -> None:
    numbers = [("b", 1, 3), ("a", 1, 0), ("a", 1, 1), ("a", 1, 2), ("a", 1, 5), ("a", 2, 0)]
    ids = [SubmapId(*number) for number in numbers]
    assert names_of(ids) == "a/0-2,5 + a#2/0 + b/3"
