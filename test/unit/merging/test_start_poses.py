"""Known start poses: the window that follows from them holds what their errors allow."""

import math

import numpy as np
import pytest

from uw_dslam_ros2.core.errors import ConfigError
from uw_dslam_ros2.core.merging.steering.start_poses import StartPoses
from uw_dslam_ros2.core.se2 import SE2

TEXTS = ["robot1 2.5 -1.0 1.57", "fleet/robot2 0 40 -0.5"]


def test_the_window_holds_the_truth_however_the_poses_err(rng):
    half_m, half_rad = 1.5, 0.2
    known = StartPoses.of_texts(TEXTS, half_m, half_rad)
    T_1, T_2 = known.T_shared_vehicle.values()
    assert (T_1.x, T_1.y, T_1.yaw) == pytest.approx((2.5, -1.0, 1.57))
    widest = 0.0
    for _ in range(300):
        T_source_point, T_target_point = (
            SE2.from_array(rng.uniform(-1.0, 1.0, 3) * (50.0, 50.0, 3.0)) for _ in range(2)
        )
        window = known.window("robot1", T_source_point, "fleet/robot2", T_target_point)
        true = []
        for pose in (T_1, T_2):
            angle, radius = rng.uniform(-math.pi, math.pi), half_m * math.sqrt(rng.random())
            x, y = pose.x + radius * math.cos(angle), pose.y + radius * math.sin(angle)
            true.append(SE2(x, y, pose.yaw + rng.uniform(-half_rad, half_rad)))
        T_true = (true[1] @ T_target_point).inverse() @ true[0] @ T_source_point
        distance_m, angle_rad = T_true.distance_to(window.T_target_source)
        assert distance_m <= window.half_width_m
        assert angle_rad <= window.half_width_rad
        widest = max(widest, distance_m / window.half_width_m)
    assert widest > 0.3, "not so wide that it says nothing"


def test_without_both_poses_there_is_no_window():
    known = StartPoses.of_texts(TEXTS, 1.0, 0.1)
    assert known.window("robot1", SE2(), "robot3", SE2()) is None
    assert known.window("robot3", SE2(), "robot1", SE2()) is None
    assert known.window("robot1", SE2(), "robot1", SE2()) is None
    wide = StartPoses.of_texts(TEXTS, 1.0, 3.0).window("robot1", SE2(), "fleet/robot2", SE2())
    assert wide.half_width_rad == pytest.approx(math.pi)
    assert np.isfinite(wide.half_width_m)


@pytest.mark.parametrize(
    "text", ["", "robot1", "robot1 1 2", "robot1 1 2 3 4", "robot1 1 2 x", "robot1 1 nan 0"]
)
def test_what_is_no_pose_is_refused(text):
    with pytest.raises(ConfigError, match="expected a vehicle, x"):
        StartPoses.of_texts(["robot2 0 0 0", text], 1.0, 0.1)


def test_one_vehicle_has_one_pose():
    with pytest.raises(ConfigError, match="'robot1' twice"):
        StartPoses.of_texts(["robot1 0 0 0", "robot1 1 0 0"], 1.0, 0.1)
