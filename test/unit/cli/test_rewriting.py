"""After a decision a result folder says what the session says."""

import dataclasses
import json

import pytest
from unit.cli import missions

from uw_dslam_ros2.cli.reporting.outcome import outcome_of
from uw_dslam_ros2.cli.reporting.report import RunFacts, write_report
from uw_dslam_ros2.cli.reporting.rewriting import has_report, write_anew
from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.merging import Decision, DecisionKind
from uw_dslam_ros2.core.submap import SubmapId

FACTS = RunFacts(
    "A <title>", ["bag_1"], "offline", {"queue": {"mode": "graph"}}, {"mission": 3}, {"x": "1"},
    diagnostics={"auv_1": {"pings": 3}}, notes=["a note"], findings=[{"kind": "no_dvl"}],
)  # fmt: skip
TWO = SubmapId("auv_2", 0, 0)


def content(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """A scored result with pictures, and one written anew after a withdrawal and its undoing."""
    folder = tmp_path_factory.mktemp("result")
    queue = missions.settled_queue()
    outcome = dataclasses.replace(outcome_of(queue), unmapped=("auv_4",))
    write_report(folder, outcome, FACTS, missions.truth())
    (folder / "mine.png").write_bytes(b"somebody's own")
    stages = [content(folder)]
    for decision in (
        Decision(DecisionKind.WITHDRAW, "Ann", source=TWO),
        Decision(DecisionKind.UNDO, "Ann", undone=1),
    ):
        queue.decide(decision)
        write_anew(folder, queue)
        stages.append(content(folder))
    return stages


def test_the_files_follow_the_decisions(result):
    before, withdrawn, undone = result
    assert "trajectories/auv_2.tum" in before
    assert "trajectories/auv_2.tum" not in withdrawn
    assert withdrawn["global_map.pgm"] != before["global_map.pgm"]
    for name in ("global_map.pgm", "pose_graph.g2o", "trajectories/auv_2.tum"):
        assert undone[name] == before[name]
    report = json.loads(withdrawn["report.json"])
    assert [row["kind"] for row in report["decisions"]] == ["WITHDRAW"]
    assert b"Decided by people" in withdrawn["report.html"]
    assert len(json.loads(undone["report.json"])["decisions"]) == 2


def test_what_the_recordings_told_is_kept_and_scores_are_not(result):
    before, withdrawn, undone = (json.loads(stage["report.json"]) for stage in result)
    for name in ("title", "settings", "seeds", "diagnostics", "findings", "vehicles_not_mapped"):
        assert withdrawn[name] == before[name]
    assert before["scores"]["trajectory"] is not None
    assert withdrawn["scores"]["trajectory"] is None
    assert withdrawn["notes"] == undone["notes"], "said once"
    assert withdrawn["notes"][0] == "a note"
    assert "after people decided" in withdrawn["notes"][1]
    assert "trajectory_error.png" in result[0]
    assert "trajectory_error.png" not in result[1]
    assert result[1]["mine.png"] == b"somebody's own"
    assert not [name for name in result[1] if "anew" in name], "nothing is left lying about"


def test_what_was_left_by_one_that_was_killed_goes(result, tmp_path):
    (tmp_path / "report.json").write_bytes(result[0]["report.json"])
    (tmp_path / ".anew-killed").mkdir()
    (tmp_path / ".anew-killed" / "report.json").write_text("half")
    write_anew(tmp_path, missions.settled_queue())
    assert not list(tmp_path.glob(".anew-*"))
    assert not (tmp_path / "report.html").exists(), "it had no pictures"


def test_a_folder_without_a_report_is_left_alone(tmp_path):
    assert not has_report(tmp_path)
    with pytest.raises(DataError, match=r"report.json is no report"):
        write_anew(tmp_path, missions.settled_queue())
    assert content(tmp_path) == {}
