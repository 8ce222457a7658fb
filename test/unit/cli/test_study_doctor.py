"""The doctor's study: simulated recordings made wrong in memory, and what is said of them."""

import csv

import pytest

from uw_dslam_ros2.cli.studies._corruptions import CORRUPTIONS
from uw_dslam_ros2.cli.studies.doctor import examined
from uw_dslam_ros2.cli.study import main
from uw_dslam_ros2.sim.missions.mission import MissionConfig, plan_mission
from uw_dslam_ros2.sim.missions.readings import MissionReadings

FEW = [
    "none", "imu speaks NED", "dvl turned by 45 degrees", "sonar mirrored",
    "sonar turned by 30 degrees", "bytes swapped", "sonar 0.4 s late",
]  # fmt: skip


@pytest.fixture(scope="module", params=["harbour", "lake"])
def recording(request):
    config = MissionConfig(seed=3, place=request.param, num_vehicles=1, duration_s=120.0)
    return MissionReadings(plan_mission(config))


@pytest.mark.parametrize("name", FEW)
def test_the_cause_is_named_first_and_nothing_right_is_changed(recording, name):
    case = examined(recording, CORRUPTIONS[name])
    assert case.is_named(CORRUPTIONS[name]), case.details
    assert case.is_mended(CORRUPTIONS[name]), case.conventions.changes()


def test_the_study_counts_what_was_named(tmp_path, capsys):
    arguments = ["--seeds", "1", "--clean", "1", "--places", "harbour", "--duration", "60"]
    wanted = ["none", "dvl's sign"]
    assert main(["doctor", "--out", str(tmp_path), *arguments, "--only", *wanted]) == 0
    with (tmp_path / "doctor.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["corruption"] for row in rows] == ["none", "dvl's sign", "none"]
    assert [row["kinds"] for row in rows] == ["", "dvl_sign", ""]
    assert "right cause first: 1 of 1; false alarms: 0 of 2" in capsys.readouterr().out
