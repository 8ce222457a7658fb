"""The offline command on a tiny simulated mission."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
from unit.cli import missions

from uw_dslam_ros2.cli import offline
from uw_dslam_ros2.io.bags import BagWriter, open_bag
from uw_dslam_ros2.io.vehicles import find_recordings
from uw_dslam_ros2.sim.missions.mission import tiny_mission_config
from uw_dslam_ros2.sim.missions.recording import RecordedMission, simulate_mission

# Coarser than the default: what is tested here is the way of the data, not the quality.
SETTINGS = """
/**:
  ros__parameters:
    mapper.occupancy.resolution_m: 0.2
"""


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory) -> RecordedMission:
    """Two vehicles that see nearly the same place, for long enough to recognise it."""
    config = replace(tiny_mission_config(1), duration_s=100.0)
    return simulate_mission(tmp_path_factory.mktemp("missions") / "tiny", config)


def _files(folder: Path) -> dict[str, bytes]:
    return {
        str(file.relative_to(folder)): file.read_bytes()
        for file in sorted(folder.rglob("*"))
        if file.is_file()
    }


@pytest.mark.slow
def test_offline_merges_and_gives_the_same_bytes_again(mission, tmp_path, capsys) -> None:
    settings = tmp_path / "settings.yaml"
    settings.write_text(SETTINGS)
    bags = [str(bag) for bag in mission.bags]
    common = ["--config", str(settings), "--no-report"]
    # The order in which the bags are named must not matter either.
    assert offline.main([*bags, "--out", str(tmp_path / "a"), *common]) == 0
    assert "2 of 2 vehicles merged" in capsys.readouterr().out
    assert offline.main([*bags, "--out", str(tmp_path / "b"), *common]) == 0
    first, second = _files(tmp_path / "a"), _files(tmp_path / "b")
    assert first == second
    assert {"global_map.pgm", "pose_graph.g2o", "report.json"} <= set(first)
    report = json.loads(first["report.json"])
    assert report["num_vehicles"] == 2
    assert report["settings"]["mapper"]["auv_1"]["occupancy"]["resolution_m"] == 0.2
    # The truth beside the bags was found. Seeds 1, 2 and 5 gave 0.06, 0.08 and 0.28 m, and 0.62,
    # 0.53 and 0.50 of the walls.
    scores = report["scores"]
    assert set(scores["trajectory"]["rmse_m_by_vehicle"]) == {"auv_1", "auv_2"}
    assert scores["trajectory"]["rmse_m"] < 0.2
    assert max(scores["rmse_m_of_each_vehicle_alone"].values()) < 0.2
    assert scores["map"]["wall_iou_tolerant"] > 0.5


def test_a_bag_that_is_named_twice_is_refused(mission, tmp_path, capsys) -> None:
    bag = str(mission.bags[0])
    assert offline.main([bag, bag, "--out", str(tmp_path / "out")]) == 2
    assert "is named twice" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_truncated_bag_is_named(mission, tmp_path, capsys) -> None:
    copy = tmp_path / "cut"
    copy.mkdir()
    for file in mission.bags[0].iterdir():
        content = file.read_bytes()
        (copy / file.name).write_bytes(content[:1000] if file.suffix == ".mcap" else content)
    assert offline.main([str(copy), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("offline: error: ")
    assert "cut" in error


def test_settings_are_checked_before_anything_is_mapped(mission, tmp_path, capsys) -> None:
    settings = tmp_path / "settings.yaml"
    settings.write_text("mapper: {submap: {max_lenght_m: 10.0}}")
    arguments = [str(mission.bags[0]), "--out", str(tmp_path / "out"), "--config", str(settings)]
    assert offline.main(arguments) == 2
    assert "did you mean max_length_m?" in capsys.readouterr().err


def test_vehicles_are_found_and_can_be_named(mission) -> None:
    found, findings = find_recordings(mission.bags)
    assert [recording.vehicle_id for recording in found] == list(mission.vehicle_ids)
    assert [recording.bags for recording in found] == [(bag,) for bag in mission.bags]
    assert findings == []
    (named,), _ = find_recordings([], named={"mine": [mission.bags[0]]})
    assert (named.vehicle_id, named.namespace) == ("mine", mission.vehicle_ids[0])


def test_a_vehicle_without_a_place_in_the_common_map_is_told() -> None:
    (finding,) = offline.left_out(missions.outcome())
    assert (finding.kind, finding.vehicle_id) == ("not_merged", "auv_3")
    assert finding.severity == "warning"
    assert "2%" in finding.sentence  # the verdict's own reason
    assert "deeper" not in finding.sentence


@pytest.mark.parametrize(
    ("depths_m", "expected"),
    [
        ((2.0, 2.4, 4.9), "2.5 m deeper"),
        ((4.0, 3.0, 1.0), "2.0 m higher"),
        ((2.0, 2.4, 3.0), ""),
        ((2.0, 5.0, 3.5), ""),  # between the others
        ((2.0, 2.4, math.nan), ""),
        ((math.nan, math.nan, 9.0), ""),
    ],
)
def test_of_a_vehicle_at_another_depth_it_is_told(depths_m, expected) -> None:
    depths = {f"auv_{i}": depth_m for i, depth_m in enumerate(depths_m, start=1)}
    (finding,) = offline.left_out(missions.outcome(), depths)
    assert ("may meet other walls" in finding.sentence) == bool(expected)
    assert expected in finding.sentence


def test_no_sonar_is_no_map(mission, tmp_path, capsys) -> None:
    with open_bag(mission.bags[0]) as reader, BagWriter(tmp_path / "blind") as writer:
        for topic in ("/auv_1/imu", "/auv_1/dvl", "/tf_static"):
            writer.add_topic(topic, reader.topics[topic])
        for raw in reader.raw(["/auv_1/imu", "/auv_1/dvl", "/tf_static"]):
            writer.write_raw(raw.topic, raw.stamp_ns, raw.data)
    assert offline.main([str(tmp_path / "blind"), "--out", str(tmp_path / "out")]) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert "auv_1: nothing was mapped" in error
    assert "sonar: there is no topic" in error
    assert not (tmp_path / "out").exists()
