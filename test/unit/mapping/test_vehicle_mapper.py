"""The whole mapper on a small simulated place: messages in, submaps out."""

import math
from dataclasses import replace

import numpy as np
import pytest

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.mapping import (
    OccupancyConfig,
    SubmapConfig,
    VehicleMapper,
    VehicleMapperConfig,
)
from uw_dslam_ros2.core.mapping.vehicle_navigation import VehicleNavigation
from uw_dslam_ros2.core.merging.graph.submap_groups import StoredSubmap
from uw_dslam_ros2.core.navigation import NavigationConfig
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar import SonarConfig

S = 1_000_000_000
SONAR = SE2(0.3, 0.0, 0.0)
CONFIG = VehicleMapperConfig(
    sonar=SonarConfig(neighbor_distance_m=0.0),
    navigation=NavigationConfig(velocity_scale_sigma=0.1),
    occupancy=OccupancyConfig(resolution_m=0.2),
    submap=SubmapConfig(max_length_m=10.0),
)
# A basin with two jetties, as segments.
SEGMENTS = np.array(
    [
        [0, 0, 40, 0], [40, 0, 40, 30], [40, 30, 0, 30], [0, 30, 0, 0],
        [12, 0, 12, 9], [27, 30, 27, 20], [20, 13, 23, 15],
    ],
    float,
)  # fmt: skip


def scan(pose, bearings):
    """Ranges to the first segment along each bearing; infinity where there is none."""
    origin = np.array([pose.x, pose.y])
    ranges = np.full(len(bearings), np.inf)
    for i, b in enumerate(bearings):
        d = np.array([math.cos(pose.yaw + b), math.sin(pose.yaw + b)])
        for x1, y1, x2, y2 in SEGMENTS:
            a, e = np.array([x1, y1]), np.array([x2 - x1, y2 - y1])
            cross = d[0] * e[1] - d[1] * e[0]
            if abs(cross) < 1e-12:
                continue
            r = a - origin
            t, u = (r[0] * e[1] - r[1] * e[0]) / cross, (r[0] * d[1] - r[1] * d[0]) / cross
            if t > 0 and 0 <= u <= 1:
                ranges[i] = min(ranges[i], t)
    return ranges


def mission(duration_s=120, scale=1.08, seed=0):
    """Events of a vehicle that circles twice; its velocity sensor reads 8 % too much."""
    rng = np.random.default_rng(seed)
    bearings = np.linspace(-1.1, 1.1, 90)
    events, truth = [], []
    for i in range(duration_s * 10 + 1):
        t, angle = i * S // 10, 2 * math.pi * i / (duration_s * 5)
        pose = SE2(19.5 + 6.5 * math.cos(angle), 15 + 6.5 * math.sin(angle), angle + math.pi / 2)
        speed = 6.5 * 2 * math.pi / (duration_s / 2)
        events.append(("yaw", t, pose.yaw + rng.normal(0, 0.01)))
        events.append(("velocity", t, (scale * speed + rng.normal(0, 0.02), rng.normal(0, 0.02))))
        if i % 10 == 5:
            ranges = scan(pose @ SONAR, bearings)
            events.append(("scan", t, (bearings, ranges + rng.normal(0, 0.03, len(ranges)))))
            truth.append(pose.as_array())
    return events, np.array(truth)


def run(config, events, watch=None):
    mapper, submaps = VehicleMapper(config, "auv_1", watch=watch), []
    for kind, t, value in events:
        if kind == "yaw":
            mapper.add_imu(t, value, None)
        elif kind == "velocity":
            mapper.add_velocity(t, value)
        else:
            submaps += mapper.add_scan(t, *value, 30.0, SONAR)
    return mapper, submaps + mapper.finish()


def error_m(mapper, truth):
    """Position error (K,) after the best rigid alignment."""
    a, b = mapper.trajectory()[1][:, :2], truth[:, :2]
    a0, b0 = a - a.mean(axis=0), b - b.mean(axis=0)
    cross = a0[:, 0] @ b0[:, 1] - a0[:, 1] @ b0[:, 0]
    turn = SE2(0.0, 0.0, math.atan2(cross, (a0 * b0).sum()))
    return np.linalg.norm(turn.apply(a0) - b0, axis=1)


@pytest.fixture(scope="module")
def recording():
    return mission()


@pytest.fixture(scope="module")
def mapped(recording):
    return run(CONFIG, recording[0])


def test_dead_reckoning_is_kept_as_if_no_ping_had_been_matched(recording):
    def heard(estimator):
        kept = []
        config = replace(CONFIG, estimator=estimator)
        mapper, _ = run(config, recording[0][:600], lambda *what: kept.append(what))
        placed = {s.submap_id: s.T_odom_submap for s in mapper.submaps()}
        path = [placed[submap_id] @ T_submap_sonar for submap_id, _, T_submap_sonar, _ in kept]
        return np.array([T.as_array() for T in path]), np.array([k[3].as_array() for k in kept])

    (matched, dead), (_, of_blind) = heard("scan_matching"), heard("dead_reckoning")
    np.testing.assert_allclose(dead, of_blind, atol=1e-9)
    assert np.abs(matched - dead)[:, :2].max() > 0.1


def test_poses_of_the_vehicles_own_filter_are_no_dead_reckoning_to_hold_on_to():
    navigation = VehicleNavigation(CONFIG.navigation)
    navigation.add_imu(0, 0.0, 0.0)
    navigation.add_velocity(0, (1.0, 0.0))
    assert navigation.dead_reckoning_at(0) is not None
    navigation.add_pose(100_000_000, SE2())
    assert navigation.dead_reckoning_at(100_000_000) is None


def test_matching_and_loops_beat_dead_reckoning(recording, mapped):
    events, truth = recording
    blind, _ = run(replace(CONFIG, estimator="dead_reckoning"), events)
    # The circle of 6.5 m comes out 8 % too large.
    assert np.mean(error_m(blind, truth)) > 0.4
    assert np.mean(error_m(mapped[0], truth)) < 0.3 * np.mean(error_m(blind, truth))


def test_particles_beat_dead_reckoning_and_repeat_themselves(recording):
    events, truth = recording
    config = replace(CONFIG, estimator="particle_filter")
    blind, _ = run(replace(CONFIG, estimator="dead_reckoning"), events)
    first, _ = run(config, events)
    again, _ = run(config, events)
    assert np.mean(error_m(first, truth)) < 0.4 * np.mean(error_m(blind, truth))
    assert first.trajectory()[1].tobytes() == again.trajectory()[1].tobytes()
    assert first.diagnostics()["num_loops"] > 0


def test_submaps_count_up_and_revise_only_themselves(mapped):
    mapper, submaps = mapped
    sequences = [s.sequence for s in submaps]
    assert sorted(set(sequences)) == list(range(max(sequences) + 1))
    for sequence in set(sequences):
        revisions = [s.revision for s in submaps if s.sequence == sequence]
        assert revisions == sorted(set(revisions))
        grids = [s.grid.values.tobytes() for s in submaps if s.sequence == sequence]
        assert len(set(grids)) == 1  # rigid: only the pose is revised
    assert mapper.diagnostics()["num_submaps"] == max(sequences) + 1


def test_a_submap_is_given_again_as_it_was_given_last(mapped):
    mapper, submaps = mapped
    newest = {s.sequence: s for s in submaps}
    assert any(submap.revision > 1 for submap in newest.values())
    for sequence, submap in newest.items():
        again = StoredSubmap.of(mapper.issued(sequence), 10**9)
        assert again.fingerprint == StoredSubmap.of(submap, 10**9).fingerprint
        assert (again.submap.run_id, again.submap.revision) == (submap.run_id, submap.revision)
    assert mapper.issued(max(newest) + 1) is None


def test_every_ping_is_in_exactly_one_submap(recording, mapped):
    mapper, submaps = mapped
    newest = {s.sequence: s for s in submaps}
    stamps = np.concatenate([newest[k].trajectory_stamp_ns for k in sorted(newest)])
    pings = [t for kind, t, _ in recording[0] if kind == "scan"]
    assert stamps.tolist() == pings
    assert mapper.trajectory()[0].tolist() == pings


def test_submaps_hold_the_trajectory(mapped):
    mapper, submaps = mapped
    newest = {s.sequence: s for s in submaps}
    placed = np.vstack([
        newest[k].T_odom_submap.apply(newest[k].trajectory[:, :2]) for k in sorted(newest)
    ])  # fmt: skip
    # A pose that moves by less than 2 cm is not worth a revision.
    np.testing.assert_allclose(placed, mapper.trajectory()[1][:, :2], atol=0.03)
    first = newest[0].trajectory[0]
    np.testing.assert_allclose(first, 0.0, atol=1e-9)


def test_same_messages_same_bytes(recording, mapped):
    again, submaps = run(CONFIG, recording[0])
    assert again.trajectory()[1].tobytes() == mapped[0].trajectory()[1].tobytes()
    assert [s.grid.values.tobytes() for s in submaps] == [
        s.grid.values.tobytes() for s in mapped[1]
    ]


def test_late_navigation_and_late_pings_do_no_harm(recording, mapped):
    """Later than what holds the messages back waits for: used where it still can be, counted."""
    events = list(recording[0])
    late = [i for i, (kind, t, _) in enumerate(events) if kind == "velocity" and t == 40 * S]
    early = [i for i, (kind, t, _) in enumerate(events) if kind == "scan" and t < 60 * S]
    events.insert(late[0] + 20, events.pop(late[0]))
    events.insert(early[-1] + 40, events.pop(early[-2]))
    mapper, _ = run(CONFIG, events)
    assert mapper.diagnostics()["num_pings_dropped"] == 1
    found, expected = mapper.trajectory()[1], mapped[0].trajectory()[1]
    assert len(found) == len(expected) - 1
    np.testing.assert_allclose(found[-1, :2], expected[-1, :2], atol=0.2)


def test_a_sonar_whose_pings_come_late_maps_the_same(recording, mapped):
    """Poses are remembered for as long as it takes, and no ping gets one that is forgotten."""
    order = [
        (t + (9 * S if kind == "scan" else 0), i) for i, (kind, t, _) in enumerate(recording[0])
    ]
    mapper, _ = run(CONFIG, [recording[0][i] for _, i in sorted(order)])
    assert mapper.diagnostics()["num_pings_dropped"] == 0
    found, expected = mapper.trajectory()[1], mapped[0].trajectory()[1]
    np.testing.assert_allclose(found[:, :2], expected[:, :2], atol=0.2)


def test_a_ping_sent_twice_counts_once(recording, mapped):
    events, _ = recording
    doubled = [e for event in events for e in ([event] * (2 if event[0] == "scan" else 1))]
    mapper, submaps = run(CONFIG, doubled)
    assert submaps[-1].grid.values.tobytes() == mapped[1][-1].grid.values.tobytes()
    assert mapper.diagnostics()["num_pings_dropped"] == sum(e[0] == "scan" for e in events)


@pytest.mark.parametrize(
    ("rule", "expected"),
    [
        (SubmapConfig(max_length_m=20.0, max_duration_s=1e5, max_sigma_m=1e3), 4),
        (SubmapConfig(max_length_m=1e4, max_duration_s=30.0, max_sigma_m=1e3), 4),
        (SubmapConfig(max_length_m=1e4, max_duration_s=1e5, max_sigma_m=1e3), 1),
    ],
    ids=["length", "time", "never"],
)
def test_closing_rules(recording, rule, expected):
    # 120 s and 82 m of way, on paper; 8 % more by the sensor.
    blind = replace(CONFIG, estimator="dead_reckoning", submap=rule)
    _, submaps = run(blind, recording[0])
    assert abs(len({s.sequence for s in submaps}) - expected) <= 1


@pytest.mark.parametrize("last_s", [0.0, 20.0])
def test_a_velocity_that_is_gone_for_good_leaves_no_submaps_of_a_few_pings(recording, last_s):
    """Many such join nothing, and cost hours; while it may still come back they are small."""
    events = [e for e in recording[0] if e[0] != "velocity" or e[1] <= last_s * S]
    end_s = events[-1][1] / S
    mapper, _ = run(replace(CONFIG, estimator="dead_reckoning"), events)
    begins_s = np.array([m.trajectory_stamp_ns[0] / S for m in mapper.submaps()])
    for_good_s = last_s + 70.0
    assert (begins_s > for_good_s).sum() <= 1 + (end_s - for_good_s) / 8.0
    if last_s > 0.0:
        hoped_s = 60.0
        is_hoped = (begins_s > last_s) & (begins_s < last_s + hoped_s)
        assert is_hoped.sum() > 2 * hoped_s / 8.0


def test_uncertainty_closes_a_submap_too(recording):
    loose, tight = (
        len({
            s.sequence
            for s in run(
                replace(
                    CONFIG,
                    estimator="dead_reckoning",
                    submap=SubmapConfig(max_length_m=1e4, max_duration_s=1e5, max_sigma_m=sigma),
                ),
                recording[0],
            )[1]
        })
        for sigma in (1e3, 0.5)
    )  # fmt: skip
    assert loose == 1
    assert tight > 3


def test_only_without_any_velocity_submaps_of_a_few_pings_are_not_made(recording):
    stamps_ns = [event[1] for event in recording[0]]
    seconds = (stamps_ns[-1] - stamps_ns[0]) * 1e-9
    config = replace(CONFIG, estimator="dead_reckoning", submap=SubmapConfig(max_sigma_m=0.01))
    nums = []
    for until_ns in (stamps_ns[0], (stamps_ns[0] + stamps_ns[-1]) // 2):  # never; lost half-way
        events = [e for e in recording[0] if e[0] != "velocity" or e[1] < until_ns]
        _, submaps = run(config, events)
        nums.append(len({s.sequence for s in submaps}))
    assert nums[0] <= 1 + seconds / 8.0
    assert nums[1] > 2 * nums[0]


def test_walls_are_where_they_are(recording, mapped):
    mapper, _ = mapped
    _, truth = recording
    found = mapper.vehicle_map()
    _, poses = mapper.trajectory()
    T_truth_odom = SE2.from_array(truth[0]) @ SE2.from_array(poses[0]).inverse()
    walls = T_truth_odom.apply(found.spec.centers_of(np.argwhere(found.values > 70)))
    a, b = SEGMENTS[:, :2], SEGMENTS[:, 2:]
    along = b - a
    t = np.einsum("nsk,sk->ns", walls[:, None] - a, along) / (along**2).sum(axis=1)
    nearest = a + np.clip(t, 0, 1)[..., None] * along
    distance = np.linalg.norm(walls[:, None] - nearest, axis=2).min(axis=1)
    assert len(walls) > 300
    assert np.quantile(distance, 0.9) < 0.5


def test_before_anything_there_is_no_pose_and_no_map():
    mapper = VehicleMapper(CONFIG, "auv_1")
    with pytest.raises(InvalidInputError, match="no pose"):
        _ = mapper.T_odom_base
    with pytest.raises(InvalidInputError, match="no map"):
        mapper.vehicle_map()
    assert mapper.finish() == []


def test_pings_without_navigation_are_counted_not_placed():
    mapper = VehicleMapper(CONFIG, "auv_1")
    for i in range(10):
        mapper.add_points(i * S, [[5.0, 0.0]], SONAR)
    assert mapper.finish() == []
    assert mapper.diagnostics()["num_pings_dropped"] == 10


def test_empty_pings_make_an_empty_but_valid_submap():
    mapper = VehicleMapper(CONFIG, "auv_1")
    submaps = []
    for i in range(20):
        mapper.add_imu(i * S, 0.0, 0.0)
        mapper.add_velocity(i * S, (0.1, 0.0))
        submaps += mapper.add_points(i * S, np.empty((0, 2)), SONAR)
    submaps += mapper.finish()
    assert len(submaps) == 1
    assert (submaps[0].grid.values == -1).all()
    assert len(submaps[0].trajectory) == 20


def test_a_vehicle_needs_a_name():
    with pytest.raises(InvalidInputError, match="vehicle_id"):
        VehicleMapper(CONFIG, "")
