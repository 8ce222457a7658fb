"""Dead reckoning: exact motions, honest covariance, and messages as the sea delivers them."""

import itertools
import math

import numpy as np
import pytest
from closeness import are_near

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.navigation import NavigationConfig, NavigationFilter
from uw_dslam_ros2.core.se2 import SE2, wrap_angle

pytestmark = pytest.mark.kernels

S = 1_000_000_000


def drive(config, seed, duration_s=30.0, dt_s=0.1, T_base_sensor=SE2()):
    """A random motion by the filter's own model: measurements and the true poses (K, 3)."""
    rng = np.random.default_rng(seed)
    x, y, yaw, u, rate = 0.0, 0.0, rng.uniform(-3, 3), np.array([1.0, 0.0]), 0.0
    bias = rng.normal(0, config.gyro_bias_sigma_rad_s)
    scale = rng.normal(0, config.velocity_scale_sigma)
    offset = rng.normal(0, config.heading_offset_sigma_rad)
    current = rng.normal(0, config.current_sigma_m_s, 2)
    keep = math.exp(-dt_s / config.heading_offset_time_s)
    keep_current = math.exp(-dt_s / config.current_time_s)
    mount, lever = T_base_sensor.rotation().T, np.array([-T_base_sensor.y, T_base_sensor.x])
    events, poses = [], []
    for i in range(int(duration_s / dt_s) + 1):
        t = round(i * dt_s * S)
        noisy_yaw = yaw + offset + rng.normal(0, config.yaw_sigma_rad)
        events.append(("yaw", t, float(noisy_yaw)))
        events.append(("rate", t, rate + bias + rng.normal(0, config.yaw_rate_sigma_rad_s)))
        if i % 2 == 0:
            noise = rng.normal(0, config.velocity_sigma_m_s, 2)
            events.append(("velocity", t, mount @ (u + rate * lever) + noise))
        poses.append((x, y, yaw))
        new_rate = rate + config.turn_walk_rad_s * math.sqrt(dt_s) * rng.normal()
        new_u = u + config.velocity_walk_m_s * math.sqrt(dt_s) * rng.normal(size=2)
        mean_yaw = yaw + 0.25 * (rate + new_rate) * dt_s
        step = SE2(0, 0, mean_yaw).rotation() @ (0.5 * (u + new_u)) * (1 + scale) + current
        x, y, yaw = x + step[0] * dt_s, y + step[1] * dt_s, yaw + 0.5 * (rate + new_rate) * dt_s
        rate, u = new_rate, new_u
        offset = keep * offset + math.sqrt(1 - keep**2) * rng.normal(
            0, config.heading_offset_sigma_rad
        )
        current = keep_current * current + math.sqrt(1 - keep_current**2) * rng.normal(
            0, config.current_sigma_m_s, 2
        )
    return events, np.array(poses)


def feed(navigation, events, T_base_sensor=SE2()):
    for kind, stamp_ns, value in events:
        if kind == "yaw":
            navigation.add_yaw(stamp_ns, value)
        elif kind == "rate":
            navigation.add_yaw_rate(stamp_ns, value)
        else:
            navigation.add_velocity(stamp_ns, value, None, T_base_sensor)


def test_a_straight_line_and_a_turn_in_literal_numbers():
    navigation = NavigationFilter()
    for i in range(101):
        navigation.add_yaw(i * S // 10, math.pi / 2)
        navigation.add_velocity(i * S // 10, (1.0, 0.5))
    pose, _ = navigation.pose_at(10 * S)
    # North at 1 m/s, and half as fast to port, which is west.
    np.testing.assert_allclose(pose.as_array(), [-5.0, 10.0, math.pi / 2], atol=1e-3)


def test_mounting_offset_and_lever_arm_cancel():
    # The vehicle turns on the spot; the sensor, ahead and turned to port, sees itself move.
    mount = SE2(2.0, 0.0, math.pi / 2)
    navigation = NavigationFilter()
    for i in range(201):
        t, yaw = i * S // 20, 0.1 * i / 20
        navigation.add_yaw(t, yaw)
        navigation.add_yaw_rate(t, 0.1)
        # v = rate x lever = 0.2 m/s to port, which is ahead for the sensor.
        navigation.add_velocity(t, (0.2, 0.0), None, mount)
    pose, _ = navigation.pose_at(10 * S)
    np.testing.assert_allclose(pose.as_array(), [0.0, 0.0, 1.0], atol=0.02)


@pytest.mark.parametrize(
    "config",
    [
        NavigationConfig(),
        NavigationConfig(velocity_scale_sigma=0.1, current_sigma_m_s=0.1, current_time_s=40.0),
    ],
    ids=["dvl", "commands"],
)
def test_covariance_is_honest(config):
    mount = SE2(0.5, -0.2, 0.3)
    squares = []
    for seed in range(40):
        events, poses = drive(config, seed, T_base_sensor=mount)
        navigation = NavigationFilter(config)
        feed(navigation, events, mount)
        pose, covariance = navigation.pose_at(30 * S)
        error = pose.as_array() - poses[-1]
        error[2] = wrap_angle(float(error[2]))
        squares.append(error @ np.linalg.solve(covariance, error))
    # Mean of 40 chi-squares of 3 degrees of freedom: 3 +- 0.39; four deviations.
    assert 1.4 < np.mean(squares) < 4.6


def test_relative_covariance_is_honest_too():
    config = NavigationConfig(heading_offset_sigma_rad=0.1)
    squares = []
    for seed in range(40):
        events, poses = drive(config, seed, duration_s=40.0)
        navigation = NavigationFilter(config)
        feed(navigation, [e for e in events if e[1] <= 20 * S])
        navigation.clone(20 * S)
        feed(navigation, [e for e in events if e[1] > 20 * S])
        relative, covariance = navigation.relative_at(40 * S)
        truth = SE2.from_array(poses[200]).inverse() @ SE2.from_array(poses[400])
        error = relative.as_array() - truth.as_array()
        error[2] = wrap_angle(float(error[2]))
        squares.append(error @ np.linalg.solve(covariance, error))
    assert 1.4 < np.mean(squares) < 4.6


def test_order_of_arrival_does_not_matter(rng):
    events, _ = drive(NavigationConfig(), 3, duration_s=6.0)
    tidy, untidy = NavigationFilter(), NavigationFilter()
    feed(tidy, events)
    # Up to a second late, which is within the horizon.
    delay = np.array([t for _, t, _ in events]) + rng.integers(0, S, len(events))
    feed(untidy, [events[i] for i in np.argsort(delay, kind="stable")])
    for (a, cov_a), (b, cov_b) in [(tidy.pose_at(6 * S), untidy.pose_at(6 * S))]:
        np.testing.assert_array_equal(a.as_array(), b.as_array())
        np.testing.assert_array_equal(cov_a, cov_b)
    assert untidy.num_late == 0


def test_too_late_is_counted_and_changes_nothing():
    navigation = NavigationFilter(NavigationConfig(horizon_s=0.5))
    for i in range(200):
        navigation.add_yaw(i * S // 10, 0.0)
        navigation.add_velocity(i * S // 10, (1.0, 0.0))
    before = navigation.pose_at(20 * S)[0]
    navigation.add_velocity(1 * S, (-1.0, 0.0))
    assert navigation.num_late == 1
    assert navigation.pose_at(20 * S)[0] == before


def test_too_late_by_its_kind_alone_is_counted_too():
    navigation = NavigationFilter(NavigationConfig(horizon_s=0.5))
    for i in range(200):
        navigation.add_velocity(i * S // 10, (1.0, 0.0))
    before = navigation.pose_at(20 * S)[0]
    # A yaw comes before a velocity of its stamp, so at the oldest stamp that is kept it is late.
    for i in range(200):
        navigation.add_yaw(i * S // 10, 0.0)
    assert navigation.num_late > 190  # all but those of the last half second
    assert are_near(navigation.pose_at(20 * S)[0], before, 1e-9, 1e-9)


def test_the_same_message_twice_is_still_a_valid_filter():
    navigation = NavigationFilter()
    for i in range(50):
        for _ in range(2):
            navigation.add_yaw(i * S // 10, 0.0)
            navigation.add_velocity(i * S // 10, (1.0, 0.0))
    pose, covariance = navigation.pose_at(5 * S)
    assert are_near(pose, SE2(5.0, 0.0, 0.0), 1e-4, 1e-9)
    assert np.linalg.eigvalsh(covariance)[0] >= 0.0


def test_dropout_is_bridged_and_admitted():
    events, poses = drive(NavigationConfig(), 5, duration_s=40.0)
    navigation = NavigationFilter()
    sigma = {}
    for event in events:
        if event[0] == "velocity" and 20 * S < event[1] < 30 * S:
            event = ("velocity", event[1], (math.nan, math.nan))
        feed(navigation, [event])
        if event[0] == "velocity" and event[1] % (10 * S) == 0:
            sigma[event[1] // S] = math.sqrt(navigation.pose_at(event[1])[1][0, 0])
    assert navigation.num_invalid == 49
    assert sigma[30] > 3.0 * sigma[20]
    pose, covariance = navigation.pose_at(40 * S)
    error = pose.as_array()[:2] - poses[-1, :2]
    assert error @ np.linalg.solve(covariance[:2, :2], error) < 13.8  # one in a thousand


def test_outliers_do_not_move_it():
    events, poses = drive(NavigationConfig(), 6, duration_s=30.0)
    with_outliers = []
    for i, event in enumerate(events):
        with_outliers.append(event)
        if event[0] == "velocity" and i % 7 == 0:
            with_outliers.append(("velocity", event[1] + S // 100, np.array([5.0, -3.0])))
        if event[0] == "yaw" and i % 11 == 0:
            with_outliers.append(("yaw", event[1] + S // 100, event[2] + 1.5))
    clean, dirty = NavigationFilter(), NavigationFilter()
    feed(clean, events)
    feed(dirty, with_outliers)
    assert dirty.num_outliers >= len(with_outliers) - len(events)
    (a, _), (b, _) = clean.pose_at(30 * S), dirty.pose_at(30 * S)
    assert a.distance_to(b)[0] < 0.001  # 0.1 mm was seen
    assert np.hypot(*(b.as_array()[:2] - poses[-1, :2])) < 1.0


def test_a_sensor_that_insists_is_believed_again():
    config = NavigationConfig(gate_reset_s=5.0)
    navigation = NavigationFilter(config)
    for i in range(400):
        navigation.add_yaw(i * S // 10, 0.0)
        navigation.add_velocity(i * S // 10, (0.0 if i < 200 else 3.0, 0.0))
    velocity, _ = navigation.velocity_at(40 * S)
    assert velocity[0] == pytest.approx(3.0, abs=0.1)


@pytest.mark.parametrize("lost_s", [(0, 0), (10, 16), (10, 40)])
def test_a_wild_velocity_is_not_believed_because_nothing_is_known(lost_s):
    """The first velocity, and the first after a silence, may be the one that is wrong."""
    clean, dirty = NavigationFilter(), NavigationFilter()
    end_s = 60
    for i in range(end_s * 5 + 1):
        t = i * S // 5
        for navigation in (clean, dirty):
            navigation.add_yaw(t, 0.02 * i)
        if lost_s[0] <= t / S < lost_s[1]:
            continue
        is_first = t == lost_s[1] * S
        clean.add_velocity(t, (0.8, 0.1))
        dirty.add_velocity(t, (3.0, -3.0) if is_first else (0.8, 0.1))
    (a, _), (b, _) = clean.pose_at(end_s * S), dirty.pose_at(end_s * S)
    assert a.distance_to(b)[0] < 0.1  # 1 s at that velocity is 4 m


def test_a_filter_that_was_wrong_makes_up_for_the_way_it_missed():
    """And says that it does not know how much of the time it was."""
    navigation = NavigationFilter()
    for i in range(400):
        navigation.add_yaw(i * S // 10, 0.0)
        navigation.add_velocity(i * S // 10, (0.0 if i < 100 else 5.0, 0.0))
    pose, covariance = navigation.pose_at(399 * S // 10)
    assert navigation.velocity_at(399 * S // 10)[0][0] == pytest.approx(5.0, abs=0.1)
    wrong_m = abs(5.0 * 29.9 - pose.x)
    assert wrong_m < 5.0  # of 100 m in the 20 s before it believed that
    assert wrong_m < 3.0 * math.sqrt(covariance[0, 0])


def test_without_any_yaw_the_first_direction_is_zero():
    navigation = NavigationFilter()
    for i in range(50):
        navigation.add_velocity(i * S // 10, (1.0, 0.0))
        navigation.add_yaw_rate(i * S // 10, 0.0)
    pose, _ = navigation.pose_at(4 * S)
    np.testing.assert_allclose(pose.as_array(), [4.0, 0.0, 0.0], atol=1e-3)


def test_yaw_through_the_seam():
    navigation = NavigationFilter()
    for i in range(401):
        navigation.add_yaw(i * S // 10, wrap_angle(0.2 * i / 10))
        navigation.add_velocity(i * S // 10, (1.0, 0.0))
    assert navigation.num_outliers == 0
    assert navigation.pose_at(40 * S)[0].yaw == pytest.approx(wrap_angle(8.0), abs=0.02)


def test_a_fix_moves_only_along_what_it_knows():
    navigation = NavigationFilter(NavigationConfig(velocity_scale_sigma=0.02))
    for i in range(101):
        navigation.add_yaw(i * S // 10, 0.0)
        navigation.add_velocity(i * S // 10, (1.0, 0.0))
        if i == 0:
            navigation.clone(0)
    before, covariance = navigation.relative_at(10 * S)
    along = np.zeros((3, 3))
    along[1, 1] = 1e6  # a quay along x: it knows y only
    navigation.add_fix(10 * S, SE2(before.x + 1.0, before.y + 0.05, before.yaw), along)
    after, new_covariance = navigation.relative_at(10 * S)
    assert after.y == pytest.approx(before.y + 0.05, abs=0.002)
    assert after.x == pytest.approx(before.x, abs=0.01)
    assert new_covariance[0, 0] > 0.9 * covariance[0, 0]
    assert new_covariance[1, 1] < 1e-5


def test_fixes_teach_the_velocity_scale():
    navigation = NavigationFilter(NavigationConfig(velocity_scale_sigma=0.2))
    for i in range(301):
        navigation.add_yaw(i * S // 10, 0.0)
        navigation.add_velocity(i * S // 10, (1.0, 0.0))
        if i == 0:
            navigation.clone(0)
        elif i % 20 == 0:
            navigation.add_fix(i * S // 10, SE2(0.9 * i / 10, 0.0, 0.0), np.eye(3) * 1e4)
    assert navigation.sensor_errors()["velocity_scale"] == pytest.approx(-0.1, abs=0.01)


def test_a_reference_at_a_forgotten_moment_is_refused():
    """Else relative poses would go on to count from the one before, without a word."""
    navigation = NavigationFilter()
    for i in range(1001):
        navigation.add_yaw(i * S // 10, 0.0)
    with pytest.raises(InvalidInputError, match="forgotten"):
        navigation.clone(10 * S)


def test_nothing_measured_is_an_error_not_a_zero():
    with pytest.raises(InvalidInputError, match="no measurement"):
        NavigationFilter().pose_at(0)


@pytest.mark.parametrize(
    ("velocity", "covariance", "what"),
    [((1.0,), None, "velocity has shape"), ((1.0, 0.0), np.eye(3), "covariance has shape")],
)
def test_malformed_velocity_is_named(velocity, covariance, what):
    with pytest.raises(InvalidInputError, match=what):
        NavigationFilter().add_velocity(0, velocity, covariance)


def test_not_finite_is_dropped_and_counted():
    navigation = NavigationFilter()
    navigation.add_yaw(0, math.nan)
    navigation.add_yaw_rate(0, math.inf)
    navigation.add_velocity(0, (1.0, 0.0), np.full((2, 2), np.nan))
    assert navigation.num_invalid == 3
    assert not navigation.is_started


def test_same_input_same_bytes():
    results = []
    for _ in range(2):
        navigation = NavigationFilter()
        feed(navigation, drive(NavigationConfig(), 1, duration_s=5.0)[0])
        results.append(navigation.pose_at(5 * S)[1].tobytes())
    for a, b in itertools.pairwise(results):
        assert a == b


@pytest.mark.parametrize(
    ("blind_s", "first_yaw_rad"), [(1.5, -2.5), (2.0, 0.3), (5.0, 2.0), (20.0, -2.5)]
)
def test_a_compass_that_wakes_late_turns_nothing(blind_s, first_yaw_rad):
    """Its zero is another than that of the frame, which was begun without it."""
    rng = np.random.default_rng(0)
    seeing, waking = NavigationFilter(), NavigationFilter()
    for i in range(3000):
        t, yaw = i * S // 10, 0.2 * math.sin(0.02 * i)
        noisy = yaw + rng.normal(0.0, 0.01)
        velocity = np.array([1.0, 0.0]) + rng.normal(0.0, 0.01, 2)
        rate = 0.04 * math.cos(0.02 * i) + rng.normal(0.0, 0.003)
        for navigation in (seeing, waking):
            navigation.add_yaw_rate(t, rate)
            navigation.add_velocity(t, velocity)
        seeing.add_yaw(t, noisy)
        if t >= blind_s * S:
            waking.add_yaw(t, wrap_angle(noisy + first_yaw_rad))
    ends = [navigation.pose_at(3000 * S // 10)[0] for navigation in (seeing, waking)]
    distance, turn = ends[0].distance_to(ends[1])
    assert distance < 5.0  # of 296 m: the frames' directions differ by half a degree
    assert turn < 0.03
