"""Vehicles on ROS domains of their own, which nothing but a lossy channel joins."""

import pytest

pytest.importorskip("rclpy")

from uw_dslam_ros2.cli.reporting.link_report import add_maps
from uw_dslam_ros2.cli.reporting.scoring import read_truth
from uw_dslam_ros2.cli.running.demo_link import LinkedMission, run_linked
from uw_dslam_ros2.core.merging import MapQueueConfig
from uw_dslam_ros2.sim.missions.mission import tiny_mission_config
from uw_dslam_ros2.sim.missions.recording import simulate_mission

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(600)]


def test_each_vehicle_ends_with_the_same_map_of_all(tmp_path):
    recorded = simulate_mission(tmp_path / "recordings", tiny_mission_config())
    mission = LinkedMission(
        recorded.vehicle_ids, recorded.bags, "sonar", None, preset="shared", loss=0.2, rate=4.0
    )
    notes, link = run_linked(tmp_path, mission, lambda *_: None)
    truth = read_truth(recorded.truth_map.parent)
    notes += add_maps(link, mission, tmp_path, MapQueueConfig(), truth)
    assert notes == []
    assert link["is_same_map"]
    assert link["packets"]["sent"] > 0
    assert link["packets"]["lost"] > 0
    for name, vehicle in link["vehicles"].items():
        assert vehicle["num_vehicles_merged"] == 2
        assert vehicle["rmse_m"] < 0.3
        assert set(vehicle["joined_s"]) == set(recorded.vehicle_ids) - {name}
        assert {"outline", "coarse"} & set(vehicle["sent"])
        assert not vehicle["refused"]
