"""Recorded messages in the order of their stamps: the same map, however late they were written."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uw_dslam_ros2.core.mapping import OccupancyConfig, VehicleMapper, VehicleMapperConfig
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar import SonarConfig, SonarImage
from uw_dslam_ros2.io.feeding import feed, in_stamp_order
from uw_dslam_ros2.io.mountings import Mountings
from uw_dslam_ros2.io.readings import (
    ImageEvent,
    ImuEvent,
    PointsEvent,
    PoseEvent,
    ScanEvent,
    TransformEvent,
    VelocityEvent,
)

S = 1_000_000_000
CONFIG = VehicleMapperConfig(
    sonar=SonarConfig(neighbor_distance_m=0.0), occupancy=OccupancyConfig(resolution_m=0.2)
)
BEARINGS = np.linspace(-1.1, 1.1, 60)


def imu(yaw, rate):
    """Orientation, its variance, and rates of a level IMU."""
    return (
        np.array([0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw)]),
        None,
        np.array([0.0, 0.0, rate]),
    )


def recording():
    """A vehicle that weaves along a quay, in order; a scan at the stamps of navigation."""
    rng = np.random.default_rng(0)
    events = []
    for i in range(200):
        key = "auv_1", i * S // 5, "auv_1/sensor"
        yaw = 0.3 * math.sin(0.1 * i)
        events.append(ImuEvent(*key, *imu(yaw + rng.normal(0.0, 0.01), 0.03 * math.cos(0.1 * i))))
        events.append(VelocityEvent(*key, rng.normal((1.0, 0.0, 0.0), 0.02), None))
        if i % 5 == 0:
            ranges = 8.0 / np.maximum(np.abs(np.sin(BEARINGS + yaw)), 0.2)
            events.append(ScanEvent(*key, BEARINGS, ranges + rng.normal(0, 0.03, 60), 60.0))
    return events


def bytes_of(events):
    mapper = VehicleMapper(CONFIG, "auv_1")
    submaps = [submap for event in events for submap in feed(mapper, event, np.eye(4))]
    submaps += mapper.finish()
    assert mapper.diagnostics()["num_pings"] == 40
    stamps, poses = mapper.trajectory()
    return stamps.tobytes(), poses.tobytes(), [s.grid.values.tobytes() for s in submaps]


def late(events, max_delay_s, seed):
    """In the order in which they come if each is late by another time."""
    delay = np.random.default_rng(seed).uniform(0.0, max_delay_s, len(events))
    return [events[i] for i in np.argsort([e.stamp_ns + d * S for e, d in zip(events, delay)])]  # noqa: B905


@pytest.fixture(scope="module")
def in_time():
    """A recording in order, and what becomes of it."""
    events = recording()
    return events, bytes_of(events)


@pytest.mark.parametrize("max_delay_s", [0.05, 0.5, 1.9])
@pytest.mark.parametrize("seed", range(2))
def test_late_messages_change_no_byte(in_time, max_delay_s, seed):
    events, expected = in_time
    disordered = late(events, max_delay_s, seed)
    assert list(map(id, disordered)) != list(map(id, events))
    assert bytes_of(in_stamp_order(disordered)) == expected


def test_of_equal_stamps_the_ping_comes_last():
    events = recording()[:3]
    assert isinstance(events[2], ScanEvent)
    for order in ([2, 0, 1], [0, 2, 1], [1, 0, 2]):
        assert isinstance(list(in_stamp_order([events[i] for i in order]))[-1], ScanEvent)


def test_what_is_no_sensors_message_is_passed_on_at_once():
    fixed = TransformEvent("auv_1", 0, "auv_1/base_link", "auv_1/sensor", np.eye(4))
    events = recording()[:4]
    assert next(iter(in_stamp_order([*events, fixed]))) is fixed


def test_no_more_is_held_back_than_two_seconds():
    held = 0
    events = recording()

    def counted():
        nonlocal held
        for event in events:
            held += 1
            yield event

    for event in in_stamp_order(counted()):
        held -= 1
        assert held <= 1 + sum(0 <= e.stamp_ns - event.stamp_ns <= 2 * S + S // 5 for e in events)


# --- mountings -------------------------------------------------------------------------------


UNTURNED = np.eye(3)


def quaternion(rotation):
    """[x, y, z, w] of a rotation matrix."""
    return Rotation.from_matrix(rotation).as_quat()


def weaving(R_base_imu=UNTURNED, R_base_dvl=UNTURNED, lean=0.0):
    """What IMU and DVL say on a vehicle that weaves, and leans, in frames mounted so."""
    for i in range(100):
        key = "auv_1", i * S // 10
        yaw = 0.4 * math.sin(0.1 * i)
        R_level_base = Rotation.from_euler("xy", [-0.5 * lean, lean]).as_matrix()
        R_world_base = Rotation.from_euler("z", yaw).as_matrix() @ R_level_base
        rate = R_base_imu.T @ R_level_base.T @ (0.0, 0.0, 0.4 * math.cos(0.1 * i))
        velocity = R_base_dvl.T @ R_level_base.T @ (1.0, 0.2, 0.0)
        attitude = quaternion(R_world_base @ R_base_imu)
        yield ImuEvent(*key, "auv_1/imu", attitude, 1e-4, rate)
        noise = R_base_dvl.T @ R_level_base.T @ np.diag([1e-4, 4e-4, 1e-4])
        covariance = noise @ R_level_base @ R_base_dvl
        yield VelocityEvent(*key, "auv_1/dvl", velocity, covariance)


def pose_after(events, R_base_imu=UNTURNED, R_base_dvl=UNTURNED):
    """Where a mapper believes to be, and how sure it is."""
    mapper = VehicleMapper(CONFIG, "auv_1")
    mountings = Mountings("auv_1/base_link")
    for name, rotation in (("imu", R_base_imu), ("dvl", R_base_dvl)):
        matrix = np.eye(4)
        matrix[:3, :3] = rotation
        mountings.add(TransformEvent("auv_1", 0, "auv_1/base_link", f"auv_1/{name}", matrix))
    for event in events:
        feed(mapper, event, mountings.of(event))
    assert not mountings.unknown
    return mapper.T_odom_base.as_array(), mapper.pose_covariance


@pytest.mark.parametrize("lean", [0.0, 0.2])
@pytest.mark.parametrize("seed", range(6))
def test_how_instruments_are_mounted_and_how_the_vehicle_leans_changes_nothing(seed, lean):
    mounts = Rotation.random(2, random_state=seed).as_matrix()
    pose, covariance = pose_after(weaving(*mounts, lean=lean), *mounts)
    expected, expected_covariance = pose_after(weaving())
    np.testing.assert_allclose(pose, expected, atol=1e-9)
    np.testing.assert_allclose(covariance, expected_covariance, atol=1e-9)


def test_points_of_space_need_no_level_sonar():
    rotation = Rotation.random(random_state=3).as_matrix()
    points = np.random.default_rng(4).uniform(-8.0, 8.0, (40, 3))
    submaps = []
    for R_base_sonar in (np.eye(3), rotation):
        mapper = VehicleMapper(CONFIG, "auv_1")
        for event in weaving():
            feed(mapper, event, np.eye(4))
        mounted = np.eye(4)
        mounted[:3, :3] = R_base_sonar
        turned = points @ R_base_sonar  # each the transpose times the point
        feed(mapper, PointsEvent("auv_1", 10 * S, "auv_1/sonar", turned), mounted)
        submaps.append(mapper.finish()[-1])
    np.testing.assert_allclose(submaps[0].points, submaps[1].points, atol=1e-9)


def test_the_sea_bed_is_no_wall():
    # A sonar whose z looks ahead (columns: where x, y, z of its frame point to).
    mounted = np.eye(4)
    mounted[:3, :3] = [[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]
    wall, bed = [0.2, -3.0, 6.0], [-2.5, 1.0, 4.0]
    mapper = VehicleMapper(CONFIG, "auv_1")
    for event in weaving():
        feed(mapper, event, np.eye(4))
    cloud = PointsEvent("auv_1", 10 * S, "auv_1/sonar", np.array([wall, bed]), 1.0)
    feed(mapper, cloud, mounted)
    assert len(mapper.finish()[-1].points) == 1


def test_frames_that_no_transform_mentions_are_told():
    mountings = Mountings("auv_1/base_link")
    dvl = VelocityEvent("auv_1", 0, "dvl_a50", np.array([1.0, 0.2, 0.0]), None, is_z_down=True)
    np.testing.assert_array_equal(mountings.of(dvl)[:3, :3], np.diag([1.0, -1.0, -1.0]))
    assert mountings.unknown == {"dvl_a50": "dvl"}


@pytest.mark.parametrize(
    ("pitch_deg", "is_told"), [(0, False), (5, False), (20, True), (-20, True)]
)
def test_a_sonar_that_points_down_is_told(pitch_deg, is_told):
    mountings = Mountings("auv_1/base_link")
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("y", pitch_deg, degrees=True).as_matrix()
    mountings.add(TransformEvent("auv_1", 0, "auv_1/base_link", "auv_1/sonar", matrix))
    mountings.of(ScanEvent("auv_1", 0, "auv_1/sonar", BEARINGS, BEARINGS + 3.0, 9.0))
    assert bool(mountings.tilted) is is_told


def test_what_names_no_frame_is_taken_to_look_ahead():
    mountings = Mountings("auv_1/base_link")
    image = SonarImage(
        0, np.zeros((3, 2), np.uint8), np.array([1.0, 2.0, 3.0]), np.array([0.1, 0.0])
    )
    for frame_id in ("", "/", "auv_1/base_link"):
        np.testing.assert_array_equal(
            mountings.of(ImageEvent("auv_1", 0, frame_id, image))[:3, 2], [1.0, 0.0, 0.0]
        )
    down = VelocityEvent("auv_1", 0, "", np.zeros(3), None, is_z_down=True)
    np.testing.assert_array_equal(np.diag(mountings.of(down)), [1.0, -1.0, -1.0, 1.0])
    assert not mountings.tilted
    (finding, _) = mountings.findings("auv_1")
    assert (finding.kind, finding.role) == ("no_mounting", "sonar")
    assert "name no frame" in finding.detail


def test_the_vehicles_own_odometry_moves_it_whatever_its_frame():
    ends = []
    for T_any_odom in (SE2(), SE2(100.0, -30.0, 2.0)):
        mapper = VehicleMapper(CONFIG, "auv_1")
        for i in range(200):
            yaw = 0.4 * math.sin(0.05 * i)
            T_odom_base = SE2(0.05 * i, 0.1 * math.sin(0.05 * i), yaw)
            event = PoseEvent(
                "auv_1", i * S // 10, "odom", "base_link", T_any_odom @ T_odom_base, None
            )
            feed(mapper, event, np.eye(4))
        # The frame of the map begins with the first yaw.
        T_start = SE2(0.0, 0.0, -T_any_odom.yaw)
        ends.append((T_start @ mapper.T_odom_base).as_array())
        truth = SE2(0.05 * 199, 0.1 * math.sin(0.05 * 199), 0.0)
        assert math.hypot(ends[-1][0] - truth.x, ends[-1][1] - truth.y) < 0.05
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-6)
