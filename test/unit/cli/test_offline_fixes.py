"""Fixes in a recording, and decisions about an earlier result, in what offline makes."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from uw_dslam_ros2.cli import offline
from uw_dslam_ros2.core.merging import Decision, DecisionKind
from uw_dslam_ros2.core.metrics import interpolate_poses
from uw_dslam_ros2.io.bags import BagWriter, open_bag
from uw_dslam_ros2.io.earth import utm_position
from uw_dslam_ros2.io.sessions.session import Session, load_session
from uw_dslam_ros2.io.trajectories import read_tum
from uw_dslam_ros2.sim.missions.mission import tiny_mission_config
from uw_dslam_ros2.sim.missions.recording import simulate_mission

SETTINGS = "/**:\n  ros__parameters:\n    mapper.occupancy.resolution_m: 0.2\n"
ORIGIN = (54.32, 10.14)
M_PER_DEGREE = np.array([111_300.0, 65_080.0])  # there, north and east
NUM_WRONG = 2


def geodetic(position):
    """Latitude and longitude of [x, y] in the world."""
    return np.array(ORIGIN) + np.array(position)[::-1] / M_PER_DEGREE


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """One vehicle with a satellite's fixes, of which two are far off; and its truth."""
    folder = tmp_path_factory.mktemp("fixes")
    config = replace(tiny_mission_config(1), duration_s=100.0)
    mission = simulate_mission(folder / "mission", config)
    truth = read_tum(mission.truth_trajectories[0])
    rng = np.random.default_rng(3)
    with open_bag(mission.bags[0]) as reader, BagWriter(folder / "auv_1") as writer:
        for topic, msgtype in reader.topics.items():
            writer.add_topic(topic, msgtype, is_latched="static" in topic)
        for raw in reader.raw(list(reader.topics)):
            writer.write_raw(raw.topic, raw.stamp_ns, raw.data)
        writer.add_topic("/auv_1/gps/fix", "sensor_msgs/msg/NavSatFix")
        types = writer.typestore.types
        stamps = truth[0][0] + np.arange(2, 98, 2) * 10**9
        for number, stamp_ns in enumerate(stamps.tolist()):
            position = interpolate_poses(truth, np.array([stamp_ns]))[0][0, :2]
            position = position + rng.normal(scale=0.3, size=2)
            if number // 5 in (3, 7):
                position = position + np.array([60.0, -20.0])
            latitude, longitude = geodetic(position).tolist()
            time = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
            writer.write(
                "/auv_1/gps/fix",
                stamp_ns,
                types["sensor_msgs/msg/NavSatFix"](
                    types["std_msgs/msg/Header"](time, "gps"),
                    types["sensor_msgs/msg/NavSatStatus"](0, 1),
                    latitude, longitude, 0.0, np.zeros(9), 0,
                ),
            )  # fmt: skip
    (folder / "settings.yaml").write_text(SETTINGS)
    bag, common = str(folder / "auv_1"), ["--config", str(folder / "settings.yaml"), "--no-report"]
    assert offline.main([bag, *common, "--out", str(folder / "out"), "--fixes", "0.5"]) == 0
    return folder, bag, common, truth


@pytest.mark.slow
def test_the_map_lies_where_the_fixes_say_and_wrong_ones_do_not_count(result):
    folder, _, _, truth = result
    report = json.loads((folder / "out" / "report.json").read_text())
    found = report["georeference"]
    assert found["earth_frame"] == "EPSG:32632"
    assert found["num_fixes"] == 10
    assert found["num_used"] == 10 - NUM_WRONG
    assert found["rms_m"] < 0.8
    assert any("2 of 10 positions contradict" in note for note in report["notes"])
    x, y, yaw = found["T_earth_map"]
    stamps_ns, poses = read_tum(folder / "out" / "trajectories" / "auv_1.tum")
    expected, is_inside = interpolate_poses(truth, stamps_ns)
    on_earth = np.array(
        [utm_position(*geodetic(p[:2]), "EPSG:32632") for p in expected[is_inside]]
    )
    c, s = math.cos(yaw), math.sin(yaw)
    placed = poses[is_inside, :2] @ np.array([[c, s], [-s, c]]) + (x, y)
    assert np.hypot(*(placed - on_earth).T).mean() < 0.5
    assert (folder / "out" / "global_map.tif").is_file()
    # A session knows them, too.
    again = load_session(folder / "out" / "session").georeference()
    assert again.T_earth_map.as_array() == pytest.approx([x, y, yaw])


@pytest.mark.slow
def test_decisions_about_a_result_hold_when_it_is_made_again(result):
    folder, bag, common, _ = result
    with Session(folder / "out" / "session") as session:
        queue = session.load()
        first = queue.submaps()[0].submap.submap_id
        queue.decide(Decision(DecisionKind.WITHDRAW, "Ann", 7, source=first))
        session.save(queue)
    again = [bag, *common, "--out", str(folder / "again")]
    assert offline.main([*again, "--decisions", str(folder / "out")]) == 0
    report = json.loads((folder / "again" / "report.json").read_text())
    assert [(row["kind"], row["who"]) for row in report["decisions"]] == [("WITHDRAW", "Ann")]
    assert report["georeference"] is None, "fixes are asked for each time"
    assert report["vehicles"][0]["num_submaps_merged"] == report["vehicles"][0]["num_submaps"] - 1


def test_a_standard_deviation_is_a_length(tmp_path, capsys):
    for text in ("0", "-1", "nan", "inf"):
        assert offline.main(["bag", "--out", str(tmp_path / "out"), f"--fixes={text}"]) == 2
        assert "--fixes is" in capsys.readouterr().err
