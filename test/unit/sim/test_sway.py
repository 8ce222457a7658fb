"""Vehicles that roll and pitch, sonars that look down, and pings of others."""

import math
from dataclasses import replace

import numpy as np
import pytest
from rosbags.rosbag2 import Reader
from scipy.spatial.transform import Rotation

from uw_dslam_ros2.core.mounting import fan_mount
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.interfaces import make_typestore
from uw_dslam_ros2.sim.missions.mission import PingMaker, plan_mission, tiny_mission_config
from uw_dslam_ros2.sim.missions.recording import simulate_mission
from uw_dslam_ros2.sim.sonars.imaging import Intruder, SonarConfig, SonarSimulator
from uw_dslam_ros2.sim.vehicles.sway import (
    SwayConfig,
    body_rates,
    fan_in_space,
    rotation_level_base,
)
from uw_dslam_ros2.sim.waters.world import Surface, WorldBuilder

pytestmark = pytest.mark.kernels

QUIET = SonarConfig(
    seabed_db=-80.0, reverberation_db=-90.0, ring_db=-90.0, noise_db=-80.0, ghost_db=-90.0,
    double_bounce_db=-90.0, vertical_width_rad=math.radians(4.0),
)  # fmt: skip


def wall_ahead(x_m, config=QUIET):
    builder = WorldBuilder()
    builder.add(Surface("wall", 0.0, 4.0), [[x_m, -60.0], [x_m, 60.0]])
    builder.add(Surface("wall", 0.0, 4.0), [[-60.0, -60.0], [-60.0, 60.0]])
    return SonarSimulator(builder.build("test", 0, (0.0, 0.0), 30.0), config)


def test_rates_are_those_of_the_attitude():
    sway = SwayConfig(roll_rad=0.3, pitch_rad=0.2)
    yaw_rate, stamp_ns, step_ns = 0.25, 1_700_000_003_100_000_000, 1_000_000

    def attitude(t):
        roll, pitch, *_ = sway.at(t)
        yaw = yaw_rate * (t - stamp_ns) * 1e-9
        return Rotation.from_matrix(rotation_level_base(roll, pitch)), Rotation.from_euler(
            "z", yaw
        )

    (before, yaw_before), (after, yaw_after) = (attitude(stamp_ns + s * step_ns) for s in (-1, 1))
    turned = ((yaw_before * before).inv() * (yaw_after * after)).as_rotvec() / (2e-9 * step_ns)
    np.testing.assert_allclose(body_rates(sway.at(stamp_ns), yaw_rate), turned, atol=1e-5)


@pytest.mark.parametrize(
    ("roll_deg", "pitch_deg", "tilt_deg"), [(0, 0, 20), (15, 0, 0), (8, -6, 10)]
)
def test_walls_of_a_leaning_sonar_lie_where_they_are_once_projected(
    rng, roll_deg, pitch_deg, tilt_deg
):
    """Projected by the mapper's own geometry, which knows nothing of the simulator's."""
    leaning = rotation_level_base(math.radians(roll_deg), math.radians(pitch_deg))
    tilt = math.radians(tilt_deg)
    T_level_fan, rotation = fan_in_space(leaning, SE2(0.3, 0.0, 0.0), -0.1, tilt)
    image = wall_ahead(12.0).ping(0, T_level_fan, 15.0, rng, None, rotation)
    mounting = np.eye(4)
    mounting[:3, :3], mounting[:3, 3] = rotation_level_base(0.0, tilt), (0.3, 0.0, -0.1)
    mount = fan_mount(mounting, "x", leaning)
    projection = np.eye(2) if mount.projection is None else mount.projection
    for beam in range(60, 200, 20):
        row = int(np.argmax(image.intensity[:, beam - 3 : beam + 4].astype(float).mean(axis=1)))
        bearing, range_m = image.bearing_rad[beam], image.range_m[row]
        echo = projection @ [range_m * math.cos(bearing), range_m * math.sin(bearing)]
        assert mount.T_base_fan.apply(echo[None])[0, 0] == pytest.approx(12.0, abs=0.3)


def test_looking_down_the_bottom_comes_before_a_far_wall(rng):
    config = replace(QUIET, seabed_db=-5.0)
    _, rotation = fan_in_space(np.eye(3), SE2(), 0.0, math.radians(30.0))
    image = wall_ahead(25.0, config).ping(0, SE2(), 24.0, rng, None, rotation)
    middle = image.intensity[:, 120:136].astype(float).mean(axis=1)
    # 6 m above the bottom, which the middle of the beam meets at 12 m.
    assert image.range_m[int(np.argmax(middle))] == pytest.approx(12.0, abs=2.0)
    assert middle[image.range_m > 25.0].max() < 0.3 * middle.max()


def test_the_ping_of_another_is_a_flash_towards_it():
    images = [
        wall_ahead(30.0).ping(0, SE2(), 15.0, np.random.default_rng(1), None, None, intruder)
        for intruder in (None, Intruder(0.5, 8.0, 10.0))
    ]
    added = images[1].intensity.astype(float) - images[0].intensity
    row, beam = np.unravel_index(int(np.argmax(added)), added.shape)
    assert images[0].range_m[row] == pytest.approx(8.0, abs=0.3)
    assert images[0].bearing_rad[beam] == pytest.approx(0.5, abs=0.05)


def test_crosstalk_comes_as_often_as_told():
    config = replace(tiny_mission_config(), crosstalk_share=0.3)
    quiet, loud = (PingMaker(plan_mission(c)) for c in (tiny_mission_config(), config))
    heard = [(quiet.ping(0, i).intensity != loud.ping(0, i).intensity).any() for i in range(60)]
    assert 8 <= sum(heard) <= 30  # 18; a vehicle behind is not always heard


def test_a_bag_says_how_its_vehicle_leans(tmp_path):
    sway = SwayConfig(roll_rad=0.2, pitch_rad=0.1, sonar_tilt_rad=0.3)
    config = replace(tiny_mission_config(), duration_s=8.0, sway=sway, depth_step_m=2.0)
    made = simulate_mission(tmp_path / "a", config)
    store, found = make_typestore(), {}
    with Reader(made.bags[1]) as reader:
        for connection, _, data in reader.messages():
            found.setdefault(connection.topic.rpartition("/")[2], []).append(
                store.deserialize_cdr(data, connection.msgtype)
            )
    rolls = []
    for msg in found["imu"]:
        q = msg.orientation
        yaw, pitch, roll = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_euler("ZYX")
        stamp_ns = msg.header.stamp.sec * 10**9 + msg.header.stamp.nanosec
        np.testing.assert_allclose([roll, pitch], sway.at(stamp_ns)[:2], atol=1e-9)
        assert math.isfinite(yaw)
        rolls.append(roll)
    assert np.ptp(rolls) > 0.3
    mount = next(
        t.transform.rotation for t in found["tf_static"][0].transforms
        if t.child_frame_id == "auv_2/sonar"
    )  # fmt: skip
    ahead = Rotation.from_quat([mount.x, mount.y, mount.z, mount.w]).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(ahead, [math.cos(0.3), 0.0, -math.sin(0.3)], atol=1e-12)
    assert any(abs(msg.velocity.z) > 0.01 for msg in found["dvl"])
    depths = [msg.pose.pose.position.z for msg in found["odom"]]
    assert abs(np.mean(depths)) == pytest.approx(config.drive.depth_m + 2.0, abs=0.2)
