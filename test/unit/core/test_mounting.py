import math

import numpy as np
import pytest

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.mounting import (
    StaticFrames,
    fan_mount,
    level_rotation,
    rotation_of_quaternion,
)


def frame(columns, translation=(0.0, 0.0, 0.0)):
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(columns).T
    matrix[:3, 3] = translation
    return matrix


# Where the sonar's x, y, z point, in base_link (x forward, y left, z up).
AHEAD = [(0, 0, 1), (0, -1, 0), (1, 0, 0)]


def seen(T_base_sensor, points, forward="x", R_level_base=None):
    """Points of the fan in the plane of base_link."""
    mount = fan_mount(T_base_sensor, forward, R_level_base)
    points = np.asarray(points, dtype=float)
    if mount.projection is not None:
        points = points @ mount.projection.T
    return mount.T_base_fan.apply(points)


def seen_in_space(T_base_sensor, points, forward, R_level_base):
    """The same by way of space: each point's direction in the sonar's frame, turned, dropped."""
    found = []
    for x, y in points:
        in_frame = (x, y, 0.0) if forward == "x" else (0.0, -y, x)
        place = T_base_sensor[:3, :3] @ in_frame + T_base_sensor[:3, 3]
        found.append((R_level_base @ place)[:2])
    return np.array(found)


def turn(axis, angle_rad):
    """Rotation matrix about an axis."""
    half = 0.5 * angle_rad
    return rotation_of_quaternion([*(np.sin(half) * np.asarray(axis, float)), np.cos(half)])


def test_sonar_frame_with_z_forward_x_up_y_starboard():
    mount = fan_mount(frame(AHEAD, (0.4, 0.1, -0.2)), "z")
    assert mount.T_base_fan.as_array() == pytest.approx([0.4, 0.1, 0.0])
    assert mount.projection is None
    to_port = frame([(0, 0, 1), (1, 0, 0), (0, 1, 0)])
    assert fan_mount(to_port, "z").T_base_fan.yaw == pytest.approx(math.pi / 2)


def test_a_sonar_upside_down_is_not_mirrored():
    upside_down = frame([(0, 0, -1), (0, 1, 0), (1, 0, 0)])
    np.testing.assert_allclose(seen(upside_down, [(3, 1)], "z"), [(3, -1)], atol=1e-12)
    rolled = frame([(1, 0, 0), (0, -1, 0), (0, 0, -1)])
    np.testing.assert_allclose(seen(rolled, [(3, 1)], "x"), [(3, -1)], atol=1e-12)


def test_a_pitched_fan_is_shortened_ahead_but_not_abeam():
    pitched = np.eye(4)
    pitched[:3, :3] = turn((0, 1, 0), math.radians(20.0))
    expected = [(math.cos(math.radians(20.0)), 0.0), (0.0, 1.0)]
    np.testing.assert_allclose(seen(pitched, [(1, 0), (0, 1)]), expected, atol=1e-12)


@pytest.mark.parametrize("forward", ["x", "z"])
@pytest.mark.parametrize("seed", range(20))
def test_a_fan_is_seen_as_its_points_in_space_are(forward, seed):
    rng = np.random.default_rng(seed)
    matrix = frame(AHEAD) if forward == "z" else np.eye(4)
    for axis in ((0, 0, 1), (0, 1, 0), (1, 0, 0)):
        angle = rng.uniform(-math.pi, math.pi) if axis[1] == 0 else rng.uniform(-0.8, 0.8)
        matrix[:3, :3] = turn(axis, angle) @ matrix[:3, :3]
    matrix[:3, 3] = rng.normal(size=3)
    level = turn((0, 1, 0), rng.uniform(-0.2, 0.2)) @ turn((1, 0, 0), rng.uniform(-0.2, 0.2))
    points = rng.normal(size=(5, 2))
    try:
        found = seen(matrix, points, forward, level)
    except InvalidInputError:
        ahead = (level @ matrix[:3, :3])[2, 0 if forward == "x" else 2]
        assert abs(ahead) > math.sin(math.radians(60.0))
        return
    expected = seen_in_space(matrix, points, forward, level)
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_the_more_level_axis_is_taken_where_the_driver_does_not_say():
    assert fan_mount(frame(AHEAD), None).T_base_fan.yaw == 0.0
    assert fan_mount(np.eye(4), None).T_base_fan.yaw == 0.0


def test_an_axis_that_points_down_has_no_bearing():
    with pytest.raises(InvalidInputError, match="fan points 90 degrees out"):
        fan_mount(np.eye(4), "z")


def test_level_rotation_keeps_roll_and_pitch_alone():
    roll_and_pitch = turn((0, 1, 0), 0.1) @ turn((1, 0, 0), -0.3)
    found = level_rotation(turn((0, 0, 1), 2.0) @ roll_and_pitch)
    np.testing.assert_allclose(found, roll_and_pitch, atol=1e-12)
    assert level_rotation(turn((1, 0, 0), math.pi)) is None


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
    mount = fan_mount(frames.lookup("base", "sonar"))
    assert mount.T_base_fan.as_array() == pytest.approx([1.0, 2.0, math.pi / 2])
    np.testing.assert_array_equal(frames.lookup("base", "base"), np.eye(4))
    with pytest.raises(InvalidInputError, match="no static transform leads from 'dvl'"):
        frames.lookup("base", "dvl")


def test_a_loop_of_frames_is_refused():
    frames = StaticFrames()
    frames.add("a", "b", np.eye(4))
    frames.add("b", "a", np.eye(4))
    with pytest.raises(InvalidInputError, match="no static transform"):
        frames.lookup("base", "a")


@pytest.mark.parametrize("base", ["auv_1/base_link", "/auv_1/base_link"])
@pytest.mark.parametrize("parent", ["auv_1/base_link", "/auv_1/base_link", "base_link"])
@pytest.mark.parametrize("child", ["auv_1/dvl", "/auv_1/dvl", "dvl"])
@pytest.mark.parametrize("asked", ["auv_1/dvl", "/auv_1/dvl", "dvl"])
def test_slashes_and_the_vehicles_name_may_be_missing(base, parent, child, asked):
    mount = frame([(1, 0, 0), (0, -1, 0), (0, 0, -1)], (1.0, 2.0, 3.0))
    frames = StaticFrames()
    frames.add(parent, child, mount)
    np.testing.assert_array_equal(frames.lookup(base, asked), mount)
