import math

import numpy as np
import pytest

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.mounting import StaticFrames, planar_mount, rotation_of_quaternion


def frame(columns, translation=(0.0, 0.0, 0.0)):
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(columns).T
    matrix[:3, 3] = translation
    return matrix


def test_sonar_frame_with_z_forward_x_up_y_starboard():
    # Columns: where the sonar's x, y, z point, in base_link (x forward, y left, z up).
    ahead = frame([(0, 0, 1), (0, -1, 0), (1, 0, 0)], (0.4, 0.1, -0.2))
    assert planar_mount(ahead, "z").as_array() == pytest.approx([0.4, 0.1, 0.0])
    to_port = frame([(0, 0, 1), (1, 0, 0), (0, 1, 0)])
    assert planar_mount(to_port, "z").yaw == pytest.approx(math.pi / 2)


def test_dvl_frame_with_x_forward_z_down():
    assert planar_mount(frame([(1, 0, 0), (0, -1, 0), (0, 0, -1)])).yaw == 0.0


def test_an_axis_that_points_down_has_no_bearing():
    with pytest.raises(InvalidInputError, match="z axis points 90 degrees out"):
        planar_mount(np.eye(4), "z")


def test_quaternion_of_a_quarter_turn_about_z():
    s = math.sqrt(0.5)
    np.testing.assert_allclose(
        rotation_of_quaternion([0, 0, s, s]), [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15
    )
    with pytest.raises(InvalidInputError, match="norm 1"):
        rotation_of_quaternion([0, 0, 0, 0])


def test_frames_are_chained():
    frames = StaticFrames()
    frames.add("base", "mast", frame([(0, 1, 0), (-1, 0, 0), (0, 0, 1)], (1.0, 0.0, 0.0)))
    frames.add("mast", "sonar", frame([(1, 0, 0), (0, 1, 0), (0, 0, 1)], (2.0, 0.0, 0.0)))
    mount = planar_mount(frames.lookup("base", "sonar"))
    assert mount.as_array() == pytest.approx([1.0, 2.0, math.pi / 2])
    np.testing.assert_array_equal(frames.lookup("base", "base"), np.eye(4))
    with pytest.raises(InvalidInputError, match="no static transform leads from 'dvl'"):
        frames.lookup("base", "dvl")


def test_a_loop_of_frames_is_refused():
    frames = StaticFrames()
    frames.add("a", "b", np.eye(4))
    frames.add("b", "a", np.eye(4))
    with pytest.raises(InvalidInputError, match="no static transform"):
        frames.lookup("base", "a")
