"""A 3-D sonar's points lie on walls, bed and objects; only what is as high as it is a wall."""

import math
from dataclasses import replace

import numpy as np
import pytest

from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.feeding import feed
from uw_dslam_ros2.io.readings import PointsEvent
from uw_dslam_ros2.sim.missions.mission import tiny_mission_config
from uw_dslam_ros2.sim.missions.recording import simulate_mission
from uw_dslam_ros2.sim.sonars.space_sonar import SpaceSonarConfig, SpaceSonarSimulator
from uw_dslam_ros2.sim.vehicles.sway import fan_in_space, rotation_level_base
from uw_dslam_ros2.sim.waters.world import Surface, WorldBuilder

pytestmark = pytest.mark.kernels

DEPTH_M, WATER_M, WALL_M = 3.0, 6.0, 12.0


def simulator(**changes):
    builder = WorldBuilder()
    builder.add(Surface("wall", 0.0, 4.0), [[WALL_M, -60.0], [WALL_M, 60.0]])
    builder.add(Surface("wall", 0.0, 4.0), [[-60.0, -60.0], [-60.0, 60.0]])
    world = builder.build("test", 0, (0.0, 0.0), WATER_M)
    return SpaceSonarSimulator(world, SpaceSonarConfig(noise_m=0.0, **changes))


def test_every_point_lies_on_the_wall_or_on_the_bed(rng):
    x, _, z = simulator(num_objects=0).ping(0, SE2(), DEPTH_M, rng).points.T
    on_wall, on_bed = np.isclose(x, WALL_M), np.isclose(z, DEPTH_M - WATER_M)
    assert (on_wall | on_bed).all()
    assert on_wall.sum() > 100
    assert on_bed.sum() > 100
    assert z.max() <= DEPTH_M


def test_objects_stand_on_the_bed_no_higher_than_told(rng):
    sonar = simulator(num_objects=3000, object_height_m=2.0)
    x, _, z = sonar.ping(0, SE2(), DEPTH_M, rng).points.T
    height = z - (DEPTH_M - WATER_M)
    is_object = (height > 1e-6) & ~np.isclose(x, WALL_M)
    assert is_object.sum() > 50
    assert height[is_object].max() <= 2.0 + 1e-9


class Mapper:
    """What `feed` gives a mapper, of a vehicle that leans."""

    def __init__(self, R_level_base):
        self._rotation = R_level_base

    def attitude_at(self, _):
        return self._rotation

    def add_points(self, _, points, T_base_sonar):
        self.points = T_base_sonar.apply(points)
        return []


@pytest.mark.parametrize(
    ("roll_deg", "pitch_deg", "tilt_deg"), [(0, 0, 0), (10, -6, 0), (5, 8, 20)]
)
def test_the_bed_is_no_wall_however_the_vehicle_leans(rng, roll_deg, pitch_deg, tilt_deg):
    leaning = rotation_level_base(math.radians(roll_deg), math.radians(pitch_deg))
    tilt = math.radians(tilt_deg)
    T_level_sonar, rotation = fan_in_space(leaning, SE2(0.3, 0.0, 0.0), -0.1, tilt)
    ping = simulator(num_objects=0).ping(0, T_level_sonar, DEPTH_M, rng, rotation)
    mounting = np.eye(4)
    mounting[:3, :3], mounting[:3, 3] = rotation_level_base(0.0, tilt), (0.3, 0.0, -0.1)
    mapper = Mapper(leaning)
    feed(mapper, PointsEvent("auv_1", 0, "sonar", ping.points, max_height_m=1.0), mounting)
    assert len(mapper.points) > 50
    np.testing.assert_allclose(mapper.points[:, 0], WALL_M, atol=0.01)
    feed(mapper, PointsEvent("auv_1", 0, "sonar", ping.points, max_height_m=50.0), mounting)
    assert (mapper.points[:, 0] < WALL_M - 1.0).any()  # the bed, where nothing is left out


def test_bags_hold_its_points(tmp_path):
    config = replace(tiny_mission_config(), duration_s=4.0, sonar_kind="space")
    made = simulate_mission(tmp_path / "a", config)
    assert all(bag.exists() for bag in made.bags)
