"""The mapper with a sonar that turns while the vehicle moves and turns."""

import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

from uw_dslam_ros2.core.grid import OCCUPIED
from uw_dslam_ros2.core.mapping import (
    MatchConfig,
    OccupancyConfig,
    VehicleMapper,
    VehicleMapperConfig,
)
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar import Beams, SonarConfig, detections_from_points

S = 1_000_000_000
SONAR = SE2(0.3, 0.0, 0.0)
CONFIG = VehicleMapperConfig(occupancy=OccupancyConfig(resolution_m=0.2))
BEAMS_PER_TURN, STEP_NS = 180, 75_000_000
WIDTH_M, HEIGHT_M = 24.0, 16.0
SPEED_M_S = 0.4


def pose_at(stamp_ns):
    """On a circle of 3 m radius round the middle of a rectangular basin."""
    angle = SPEED_M_S / 3.0 * stamp_ns * 1e-9
    center = (0.5 * WIDTH_M, 0.5 * HEIGHT_M)
    return SE2(
        center[0] + 3.0 * math.cos(angle), center[1] + 3.0 * math.sin(angle), angle + math.pi / 2
    )


def range_to_wall(sonar, bearing):
    """From inside a rectangle to its outline."""
    cos, sin = math.cos(sonar.yaw + bearing), math.sin(sonar.yaw + bearing)
    along_x = ((WIDTH_M if cos > 0 else 0.0) - sonar.x) / cos if cos else math.inf
    along_y = ((HEIGHT_M if sin > 0 else 0.0) - sonar.y) / sin if sin else math.inf
    return min(along_x, along_y)


@pytest.fixture(scope="module")
def recording():
    """Navigation (stamp, yaw, speed) and the beams of eight turns."""
    end_ns = 8 * BEAMS_PER_TURN * STEP_NS
    rng = np.random.default_rng(3)
    navigation = [
        (t, pose_at(t).yaw + rng.normal(0, 0.005), SPEED_M_S + rng.normal(0, 0.01))
        for t in range(0, end_ns + S, S // 10)
    ]
    # Between the stamps of navigation, as real ones are.
    stamps = S // 2 + 1 + np.arange(8 * BEAMS_PER_TURN) * STEP_NS
    bearing = np.remainder(np.arange(len(stamps)) * 2 * math.pi / BEAMS_PER_TURN, 2 * math.pi)
    ranges = np.array(
        [
            range_to_wall(pose_at(int(t)) @ SONAR, b) + rng.normal(0, 0.03)
            for t, b in zip(stamps, bearing, strict=True)
        ]
    )
    return navigation, stamps, bearing, ranges


def mapped(recording, beams_per_message, delay_ns=0):
    """Feed in the order of stamps; a message of beams may come later than that."""
    navigation, stamps, bearing, ranges = recording
    events = [(t, 0, (t, yaw, speed)) for t, yaw, speed in navigation]
    for start in range(0, len(stamps), beams_per_message):
        part = slice(start, start + beams_per_message)
        beams = Beams(stamps[part], bearing[part], ranges[part], 30.0)
        events.append((int(stamps[part][0]) + delay_ns, 1, beams))
    mapper, submaps = VehicleMapper(CONFIG, "auv_1"), []
    for _, kind, value in sorted(events, key=lambda event: event[:2]):
        if kind == 0:
            t, yaw, speed = value
            mapper.add_imu(t, yaw, None)
            mapper.add_velocity(t, (speed, 0.0))
        else:
            submaps += mapper.add_beams(value, SONAR)
    return mapper, submaps + mapper.finish()


@pytest.fixture(scope="module")
def by_beams(recording):
    return mapped(recording, 1)


def test_walls_are_where_they_are_and_all_there(by_beams):
    occupancy = by_beams[0].vehicle_map()
    start = pose_at(0)
    T_world_odom = start @ SE2(0.0, 0.0, start.yaw).inverse()
    cells = np.argwhere(occupancy.values == OCCUPIED)
    cells = np.argwhere(occupancy.values > 60) if len(cells) == 0 else cells
    x, y = T_world_odom.apply(occupancy.spec.centers_of(cells)).T
    off_m = np.minimum(np.minimum(abs(x), abs(x - WIDTH_M)), np.minimum(abs(y), abs(y - HEIGHT_M)))
    assert np.quantile(off_m, 0.95) < 0.35
    outline = [(u, v) for u in np.arange(0.5, WIDTH_M, 0.5) for v in (0.0, HEIGHT_M)]
    outline += [(u, v) for v in np.arange(0.5, HEIGHT_M, 0.5) for u in (0.0, WIDTH_M)]
    found = [np.hypot(x - u, y - v).min() < 0.4 for u, v in outline]
    assert np.mean(found) > 0.95


def test_the_trajectory_is_known_at_every_beam(recording, by_beams):
    stamps, poses = by_beams[0].trajectory()
    assert stamps.tolist() == recording[1].tolist()
    start = pose_at(0)
    T_odom_world = SE2(0.0, 0.0, start.yaw) @ start.inverse()
    truth = np.array([(T_odom_world @ pose_at(int(t))).as_array() for t in stamps])
    assert np.hypot(*(poses - truth)[:, :2].T).max() < 0.4
    counts = by_beams[0].diagnostics()
    assert counts["num_pings"] == 8
    # The first has nothing to match; a basin is seen whole by every other.
    assert counts["num_key_pings"] == counts["num_matches"] == 7


@pytest.mark.parametrize(
    ("beams_per_message", "delay_ns"),
    [(BEAMS_PER_TURN, 0), (70, 0), (1, 2 * S), (BEAMS_PER_TURN, 14 * S)],
    ids=["turns", "sectors", "late beams", "turns when they are over"],
)
def test_messages_of_any_size_and_age_give_the_same_map(
    recording, by_beams, beams_per_message, delay_ns
):
    mapper, submaps = mapped(recording, beams_per_message, delay_ns)
    expected_mapper, expected = by_beams
    for one, other in zip(mapper.trajectory(), expected_mapper.trajectory(), strict=True):
        np.testing.assert_array_equal(one, other)
    assert len(submaps) == len(expected)
    for submap, same in zip(submaps, expected, strict=True):
        np.testing.assert_array_equal(submap.grid.values, same.grid.values)
        np.testing.assert_array_equal(submap.points, same.points)


def test_a_ten_times_larger_range_takes_no_more_memory_than_its_water():
    """Cells of 0.05 m and beams of 50 m that meet nothing."""
    config = VehicleMapperConfig()
    mapper = VehicleMapper(config, "auv_1")
    mapper.add_imu(0, 0.0, None)
    mapper.add_velocity(0, (0.0, 0.0))
    stamps = np.arange(1, 201) * STEP_NS
    mapper.add_imu(int(stamps[-1]), 0.0, None)
    beams = Beams(stamps, np.arange(200) * 2 * math.pi / 200, np.full(200, np.inf), 50.0)
    mapper.add_beams(beams, SONAR)
    mapper.finish()
    assert max(mapper.vehicle_map().spec.shape) <= 2 * 25.0 / 0.05 + 2


def test_what_is_left_to_the_sonar_goes_by_its_beams():
    fan, turning = (MatchConfig().suited(width_rad) for width_rad in (0.009, 0.0314))
    assert (fan.sigma_m, fan.information_share) == (0.12, 0.1)
    assert turning.sigma_m == pytest.approx(0.25, abs=0.01)
    assert turning.information_share == pytest.approx(0.36, abs=0.01)
    own = MatchConfig(sigma_m=0.4, information_share=0.2)
    assert own.suited(0.0314) == own


@pytest.mark.parametrize(("half_rad", "is_turn"), [(1.09, False), (math.pi, True)])
def test_a_fan_of_wide_beams_is_no_turn(half_rad, is_turn):
    """So its echoes, which come at once and err together, are kept and weighed as they are."""
    bearing = np.arange(-half_rad, half_rad, 0.03)
    wall = 10.0 * np.column_stack([np.cos(bearing), np.sin(bearing)])
    config = SonarConfig(beamwidth_rad=0.03, neighbor_distance_m=0.0)
    detections = detections_from_points(2 * S, wall, config)
    assert detections.is_turn == is_turn


def test_loops_see_the_walls_between_wide_beams(by_beams):
    """Echoes of a turn lie metres apart, and those of another turn somewhere between them."""
    points = by_beams[1][0].points
    spacing_m, _ = cKDTree(points).query(points, k=2)
    assert spacing_m[:, 1].max() < 0.6


@pytest.mark.parametrize(
    ("late_ns", "is_first_sparse"), [(0, False), (7 * S, False), (7 * S, True)]
)
def test_points_of_a_turn_may_come_when_it_is_over(recording, late_ns, is_first_sparse):
    """Deskewed by somebody else to its middle; the vehicle has turned by a radian since.

    Nor need the first turns have echoes all round.
    """
    navigation, stamps, bearing, ranges = recording
    events = [(t, 0, (t, yaw, speed)) for t, yaw, speed in navigation]
    for start in range(0, len(stamps), BEAMS_PER_TURN):
        middle = int(stamps[start + BEAMS_PER_TURN // 2])
        T_middle_world = (pose_at(middle) @ SONAR).inverse()
        points = []
        for i in range(start, start + BEAMS_PER_TURN):
            echo = (ranges[i] * math.cos(bearing[i]), ranges[i] * math.sin(bearing[i]))
            points.append((T_middle_world @ pose_at(int(stamps[i])) @ SONAR).apply([echo])[0])
        if is_first_sparse and start < 2 * BEAMS_PER_TURN:
            points = points[:10]
        events.append((middle + late_ns, 1, (middle, np.array(points))))
    mapper = VehicleMapper(CONFIG, "auv_1")
    for t, kind, value in sorted(events, key=lambda event: event[:2]):
        if kind == 0:
            mapper.add_imu(t, value[1], None)
            mapper.add_velocity(t, (value[2], 0.0))
        else:
            mapper.add_points(*value, SONAR)
    mapper.finish()
    stamped, poses = mapper.trajectory()
    start = pose_at(int(stamped[0]))
    T_odom_world = SE2.from_array(poses[0]) @ start.inverse()
    truth = np.array([(T_odom_world @ pose_at(int(t))).as_array() for t in stamped])
    assert len(poses) >= 7
    assert mapper.diagnostics()["num_pings_dropped"] == 0
    assert np.hypot(*(poses - truth)[:, :2].T).max() < 0.4
