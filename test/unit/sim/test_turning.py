"""A mission whose sonar turns: beams in the recording, one a message or a turn."""

import math
from dataclasses import replace

import numpy as np
import pytest

from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.recordings import open_bag
from uw_dslam_ros2.sim.missions.mission import T_BASE_SONAR, plan_mission, tiny_mission_config
from uw_dslam_ros2.sim.missions.recording import simulate_mission
from uw_dslam_ros2.sim.sonars.turning import TurningSonarConfig, beam_bearing_rad, counted_rad

TURNING = TurningSonarConfig(turn_s=4.0, num_beams=50, num_ranges=300)
CONFIG = replace(
    tiny_mission_config(),
    num_vehicles=1,
    duration_s=13.0,
    sonar_kind="turning",
    turning=TURNING,
    truth_resolution_m=0.5,
)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Scans by what a message holds."""
    scans = {}
    for message in ("beam", "turn"):
        config = replace(CONFIG, turning=replace(TURNING, message=message))
        folder = tmp_path_factory.mktemp("turning") / message
        mission = simulate_mission(folder, config)
        with open_bag(mission.bags[0]) as reader:
            scans[message] = [
                reader.deserialize(raw) for raw in reader.raw() if raw.topic == "/auv_1/scan"
            ]
    return scans


def stamp_ns(scan):
    return scan.header.stamp.sec * 1_000_000_000 + scan.header.stamp.nanosec


def test_a_message_holds_a_beam_or_a_turn(recorded):
    beams, turns = recorded["beam"], recorded["turn"]
    assert {len(scan.ranges) for scan in beams} == {1}
    assert {len(scan.ranges) for scan in turns} == {TURNING.num_beams}
    assert len(turns) == len(beams) // TURNING.num_beams
    together = np.concatenate([scan.ranges for scan in turns])
    np.testing.assert_array_equal(
        together, np.concatenate([scan.ranges for scan in beams])[: len(together)]
    )
    for i, turn in enumerate(turns):
        first = beams[i * TURNING.num_beams]
        assert stamp_ns(turn) == stamp_ns(first)
        assert turn.time_increment == pytest.approx(TURNING.interval_s)
        last = beams[(i + 1) * TURNING.num_beams - 1]
        late_s = turn.time_increment * (TURNING.num_beams - 1)
        assert stamp_ns(last) - stamp_ns(turn) == pytest.approx(late_s * 1e9, abs=1e6)
        assert math.cos(turn.angle_max - last.angle_min) == pytest.approx(1.0)


def test_ranges_are_those_of_the_place_at_each_beams_time(recorded):
    mission = plan_mission(CONFIG)
    (run,) = mission.runs
    off_m = []
    for i, scan in enumerate(recorded["beam"]):
        assert stamp_ns(scan) == run.ping_motion.stamp_ns[i]
        bearing = beam_bearing_rad(TURNING, i)
        assert scan.angle_min == pytest.approx(bearing, abs=1e-6)
        sonar = run.ping_motion.pose(i) @ T_BASE_SONAR @ SE2(yaw=bearing)
        fan = sonar.yaw + np.linspace(-0.5, 0.5, 9) * TURNING.beam_width_rad
        true_m = mission.world.cast((sonar.x, sonar.y), fan, TURNING.max_range_m).range_m
        if np.isfinite(scan.ranges[0]) and np.isfinite(true_m).all():
            off_m.append(np.abs(true_m - scan.ranges[0]).min())
    assert len(off_m) > 0.3 * len(recorded["beam"])
    # Fish and ghosts answer too, and before a wall.
    assert np.median(off_m) < 0.15


def test_a_sonar_whose_zero_is_elsewhere_counts_from_there():
    config = replace(TURNING, zero_rad=math.radians(94.0), is_clockwise=True)
    assert counted_rad(config, math.radians(94.0)) == 0.0
    assert counted_rad(config, math.radians(104.0)) == pytest.approx(math.radians(-10.0))
    assert counted_rad(TURNING, 0.3) == pytest.approx(0.3)


def test_points_of_a_turn_are_those_of_its_middle(tmp_path):
    turning = replace(TURNING, message="points", zero_rad=0.4, is_clockwise=True)
    config = replace(CONFIG, turning=turning)
    bag = simulate_mission(tmp_path / "points", config).bags[0]
    mission = plan_mission(config)
    (run,) = mission.runs
    with open_bag(bag) as reader:
        clouds = [reader.deserialize(raw) for raw in reader.raw() if raw.topic == "/auv_1/scan"]
    assert len(clouds) == run.num_pings // TURNING.num_beams
    for k, cloud in enumerate(clouds):
        middle = k * TURNING.num_beams + TURNING.num_beams // 2
        assert stamp_ns(cloud) == run.ping_motion.stamp_ns[middle]
        x, y = cloud.data.view("<f4").reshape(-1, 3)[:, :2].T.astype(float)
        sonar = run.ping_motion.pose(middle) @ T_BASE_SONAR
        bearing = sonar.yaw + turning.zero_rad + np.arctan2(-y, x)
        true_m = mission.world.cast((sonar.x, sonar.y), bearing, TURNING.max_range_m).range_m
        known = np.isfinite(true_m)
        # Seen from elsewhere a wall may hide behind another, and fish are no walls.
        assert np.median(np.abs(true_m - np.hypot(x, y))[known]) < 0.3
