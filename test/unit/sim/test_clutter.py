import numpy as np

from uw_dslam_ros2.sim.waters.clutter import ClutterConfig, MovingClutter
from uw_dslam_ros2.sim.waters.places import make_place

WORLD = make_place("harbour", 0)


def test_schools_swim_no_faster_than_told():
    config = ClutterConfig(num_schools=5, num_bubble_clouds=0, fish_speed_m_s=0.4)
    clutter = MovingClutter(WORLD, config)
    centers = np.array(
        [clutter.at(float(t)).points.reshape(5, -1, 2).mean(axis=1) for t in range(120)]
    )
    speed = np.hypot(*np.diff(centers, axis=0).transpose(2, 0, 1))
    # Both axes swing at up to 0.4 m/s; the fish's own swimming hardly moves the mean.
    assert speed.max() < 0.4 * np.sqrt(2.0) + 0.15
    assert np.hypot(*(centers[60] - centers[0]).T).max() > 3.0


def test_schools_keep_together():
    clutter = MovingClutter(WORLD, ClutterConfig(num_schools=4, num_bubble_clouds=0))
    for time_s in (0.0, 50.0, 1000.0):
        points = clutter.at(time_s).points.reshape(4, -1, 2)
        spread = np.hypot(*(points - points.mean(axis=1, keepdims=True)).transpose(2, 0, 1))
        assert spread.max() < 6.0


def test_bubbles_fade_and_come_again():
    config = ClutterConfig(num_schools=0, num_bubble_clouds=1, bubble_life_s=10.0)
    clutter = MovingClutter(WORLD, config)
    power = np.array([clutter.at(float(t)).power[0] for t in range(100)])
    drops, jumps = power[1:] < power[:-1], power[1:] > power[:-1]
    assert drops.sum() > 90
    assert 1 <= jumps.sum() <= 5
    np.testing.assert_allclose((power[1:] / power[:-1])[drops], np.exp(-0.1))


def test_every_vehicle_meets_the_same_fish():
    config = ClutterConfig()
    first, second = MovingClutter(WORLD, config).at(33.0), MovingClutter(WORLD, config).at(33.0)
    np.testing.assert_array_equal(first.points, second.points)


def test_nothing_moves_in_empty_water():
    config = ClutterConfig(num_schools=0, num_bubble_clouds=0)
    assert MovingClutter(WORLD, config).at(1.0).points.shape == (0, 2)
