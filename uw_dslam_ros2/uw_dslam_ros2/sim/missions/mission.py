"""Missions: several vehicles survey overlapping parts of one place, each on its own."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.config import Config, setting
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar.types import SonarImage
from uw_dslam_ros2.sim.sonars.imaging import Intruder, SonarConfig, SonarSimulator
from uw_dslam_ros2.sim.sonars.model import power_of_db
from uw_dslam_ros2.sim.sonars.space_sonar import SpacePing, SpaceSonarConfig, SpaceSonarSimulator
from uw_dslam_ros2.sim.sonars.turning import (
    TurningSonarConfig,
    TurningSonarSimulator,
    beam_bearing_rad,
)
from uw_dslam_ros2.sim.vehicles.instruments import InstrumentConfig, NavigationLog, measure
from uw_dslam_ros2.sim.vehicles.paths import SurveyArea, plan_survey, split_areas
from uw_dslam_ros2.sim.vehicles.sway import SwayConfig, fan_in_space, rotation_level_base
from uw_dslam_ros2.sim.vehicles.vehicle import DriveConfig, Motion, drive
from uw_dslam_ros2.sim.waters.clutter import ClutterConfig, MovingClutter
from uw_dslam_ros2.sim.waters.places import PLACES, make_place
from uw_dslam_ros2.sim.waters.world import World

__all__ = [
    "ALL_SONAR_KINDS",
    "SONAR_HEIGHT_M",
    "SONAR_KINDS",
    "T_BASE_DVL",
    "T_BASE_SONAR",
    "Mission",
    "MissionConfig",
    "PingMaker",
    "VehicleRun",
    "every_metre",
    "plan_mission",
    "tiny_mission_config",
]

IntArray = NDArray[np.int64]

_NS = 1_000_000_000
# Any time would do; a round one in the past shows that nobody reads the wall clock.
_START_NS = 1_700_000_000 * _NS

T_BASE_SONAR = SE2(0.30, 0.0, 0.0)
"""Where the sonar sits on every vehicle, looking ahead."""
SONAR_HEIGHT_M = -0.10
"""And how high."""
T_BASE_DVL = SE2(-0.10, 0.05, 0.0)
"""Where the DVL sits."""

SONAR_KINDS = ("imaging", "turning")
"""A fan of beams at once, or one beam that turns."""
ALL_SONAR_KINDS = (*SONAR_KINDS, "space")
"""Also one that hears in three dimensions."""


@dataclass(frozen=True, slots=True)
class MissionConfig(Config):
    """What to simulate."""

    seed: int = setting(0, 0, 2**31 - 1, "a different place and mission for every seed")
    place: str = setting("harbour", choices=PLACES, doc="kind of place")
    num_vehicles: int = setting(3, 1, 20, "vehicles")
    place_width_m: float = setting(0.0, 0.0, 2000.0, "0: by the number of vehicles [m]")
    duration_s: float = setting(200.0, 2.0, 7200.0, "length of each recording [s]")
    overlap: float = setting(
        0.3, 0.0, 0.95, "part of an area's width that the next vehicle surveys too"
    )
    clearance_m: float = setting(4.0, 1.0, 20.0, "distance kept from walls [m]")
    sonar_kind: str = setting("imaging", choices=ALL_SONAR_KINDS, doc="what the vehicles carry")
    ping_rate_hz: float = setting(3.0, 0.2, 30.0, "imaging: sonar pings per second")
    truth_resolution_m: float = setting(0.05, 0.01, 2.0, "cell size of the true map [m]")
    sonar: SonarConfig = setting(SonarConfig())
    turning: TurningSonarConfig = setting(TurningSonarConfig())
    space: SpaceSonarConfig = setting(SpaceSonarConfig())
    drive: DriveConfig = setting(DriveConfig())
    instruments: InstrumentConfig = setting(InstrumentConfig())
    clutter: ClutterConfig = setting(ClutterConfig())
    sway: SwayConfig = setting(SwayConfig())
    depth_step_m: float = setting(
        0.0, -20.0, 20.0, "each vehicle cruises so much deeper than the one before [m]"
    )
    crosstalk_share: float = setting(
        0.0, 0.0, 1.0, "part of the pings in which one of another vehicle is heard, 1"
    )
    crosstalk_db: float = setting(
        10.0, -60.0, 60.0, "how loud that is, in the beam that looks at that vehicle [dB]"
    )

    @property
    def is_turning(self) -> bool:
        """Whether a ping is one beam of a sonar that turns."""
        return self.sonar_kind == "turning"

    @property
    def ping_interval_ns(self) -> int:
        """Time from ping to ping."""
        if self.is_turning:
            return round(_NS * self.turning.interval_s)
        return round(_NS / self.ping_rate_hz)

    @property
    def field_of_view(self) -> tuple[float, float]:
        """What the sonar sees in the end: angle [rad] and range [m]."""
        if self.is_turning:
            return 2.0 * math.pi, self.turning.max_range_m
        if self.sonar_kind == "space":
            return self.space.fov_rad, self.space.max_range_m
        return self.sonar.fov_rad, self.sonar.max_range_m


def tiny_mission_config(seed: int = 0) -> MissionConfig:
    """Two vehicles that see nearly the same place, in a second or two: for tests."""
    return MissionConfig(
        seed=seed,
        num_vehicles=2,
        place_width_m=60.0,
        duration_s=60.0,
        overlap=0.9,
        ping_rate_hz=2.0,
        truth_resolution_m=0.1,
        sonar=SonarConfig(num_beams=128, num_ranges=200),
        drive=DriveConfig(speed_m_s=1.5),
        clutter=ClutterConfig(num_schools=1, num_bubble_clouds=1),
    )


@dataclass(frozen=True, slots=True, eq=False)
class VehicleRun:
    """One vehicle's part of a mission; ``ping_motion`` is the motion at the times of the pings.

    ``range_scale`` and ``T_base_sonar`` are the sonar's true ones; the recording says 1 and
    `T_BASE_SONAR`.
    """

    vehicle_id: str
    area: SurveyArea
    motion: Motion
    navigation: NavigationLog
    ping_motion: Motion
    range_scale: float
    T_base_sonar: SE2

    def sonar_poses(self) -> NDArray[np.float64]:
        """True poses (K, 3) [x, y, yaw] of the sonar in the world at its pings."""
        poses = [self.ping_motion.pose(i) @ self.T_base_sonar for i in range(self.num_pings)]
        return np.array([pose.as_array() for pose in poses])

    @property
    def num_pings(self) -> int:
        """How many pings the vehicle makes."""
        return len(self.ping_motion.stamp_ns)


@dataclass(frozen=True, slots=True, eq=False)
class Mission:
    """Everything about a mission but its images, which `PingMaker` makes one by one."""

    config: MissionConfig
    world: World
    runs: tuple[VehicleRun, ...]


def plan_mission(
    config: MissionConfig, world: World | None = None, areas: Sequence[SurveyArea] | None = None
) -> Mission:
    """Build the place, send the vehicles through it, and sample their instruments.

    Another place than the configuration's, and areas for the vehicles, may be given.
    """
    if world is None:
        world = make_place(config.place, config.seed, config.num_vehicles, config.place_width_m)
    if areas is None:
        areas = split_areas(world, config.num_vehicles, config.overlap)
    runs = [_run(config, world, area, index) for index, area in enumerate(areas)]
    return Mission(config, world, tuple(runs))


def _run(config: MissionConfig, world: World, area: SurveyArea, index: int) -> VehicleRun:
    rng = np.random.default_rng([config.seed, 10, index])
    # Bends cost time: a route for the cruising speed is always long enough.
    length_m = 1.2 * config.drive.speed_m_s * config.duration_s + 20.0
    route = plan_survey(world, area, length_m, config.clearance_m, rng)
    # Vehicles do not start at the same moment.
    start_ns = _START_NS + index * 370_000_000
    how = config.drive
    how = replace(how, depth_m=how.depth_m + index * config.depth_step_m)
    motion = drive(route, start_ns, config.duration_s, how, rng)
    log = measure(motion, config.instruments, T_BASE_DVL, rng, world)
    first = start_ns + int(rng.integers(50_000_000, 150_000_000))
    pings = np.arange(first, motion.stamp_ns[-1], config.ping_interval_ns)
    sonar = config.sonar
    return VehicleRun(
        vehicle_id=f"auv_{index + 1}",
        area=area,
        motion=motion,
        navigation=log,
        ping_motion=motion.at(pings),
        range_scale=1.0 + float(rng.normal(0.0, sonar.sound_speed_sigma)),
        T_base_sonar=T_BASE_SONAR @ SE2(yaw=float(rng.normal(0.0, sonar.misalignment_rad))),
    )


class PingMaker:
    """Makes the images of a mission in any order: each ping has a seed of its own."""

    def __init__(self, mission: Mission) -> None:
        self._mission = mission
        config, world = mission.config, mission.world
        self._fans: list[SonarSimulator] = []
        self._turning: list[TurningSonarSimulator] = []
        for run in mission.runs:
            if config.is_turning:
                sonar = TurningSonarSimulator(world, config.turning, config.sonar, run.range_scale)
                self._turning.append(sonar)
            else:
                self._fans.append(SonarSimulator(world, config.sonar, run.range_scale))
        self._space = SpaceSonarSimulator(world, config.space)
        self._clutter = MovingClutter(mission.world, mission.config.clutter)

    def ping(self, vehicle: int, index: int) -> SonarImage:
        """Return the image of one ping: of one beam where the sonar turns."""
        run = self._mission.runs[vehicle]
        motion, stamp_ns = run.ping_motion, int(run.ping_motion.stamp_ns[index])
        rng = np.random.default_rng([self._mission.config.seed, 20, vehicle, index])
        config = self._mission.config
        place, rotation = self._place(vehicle, index)
        depth_m = float(motion.depth_m[index])
        clutter = self._clutter.at((stamp_ns - _START_NS) / _NS)
        intruder = self._intruder(vehicle, index, place)
        if config.is_turning:
            return self._turning[vehicle].beam(
                stamp_ns, index, place, depth_m, rng, clutter, rotation, intruder
            )
        return self._fans[vehicle].ping(stamp_ns, place, depth_m, rng, clutter, rotation, intruder)

    def space_ping(self, vehicle: int, index: int) -> SpacePing:
        """Return the points of one ping of a sonar that hears in three dimensions."""
        motion = self._mission.runs[vehicle].ping_motion
        rng = np.random.default_rng([self._mission.config.seed, 20, vehicle, index])
        place, rotation = self._place(vehicle, index)
        stamp_ns, depth_m = int(motion.stamp_ns[index]), float(motion.depth_m[index])
        return self._space.ping(stamp_ns, place, depth_m, rng, rotation)

    def _place(self, vehicle: int, index: int) -> tuple[SE2, NDArray[np.float64] | None]:
        """Where the sonar, or the beam of one that turns, is and looks; see `fan_in_space`."""
        run, config = self._mission.runs[vehicle], self._mission.config
        T_map_base, turn = run.ping_motion.pose(index), SE2()
        if config.is_turning:
            turn = SE2(yaw=beam_bearing_rad(config.turning, index))
        if config.sway.is_level:
            return T_map_base @ run.T_base_sonar @ turn, None
        T_level_fan, rotation = fan_in_space(
            rotation_level_base(*config.sway.at(int(run.ping_motion.stamp_ns[index]))[:2]),
            run.T_base_sonar @ turn,
            SONAR_HEIGHT_M,
            config.sway.sonar_tilt_rad,
        )
        return T_map_base @ T_level_fan, rotation

    def _intruder(self, vehicle: int, index: int, T_map_fan: SE2) -> Intruder | None:
        """Another vehicle's ping: its sonar runs by itself, so that it comes at any time."""
        config, runs = self._mission.config, self._mission.runs
        if config.crosstalk_share == 0.0 or len(runs) < 2:
            return None
        rng = np.random.default_rng([config.seed, 30, vehicle, index])
        if rng.random() >= config.crosstalk_share:
            return None
        others = [i for i in range(len(runs)) if i != vehicle]
        other = runs[others[int(rng.integers(len(others)))]]
        stamp_ns = runs[vehicle].ping_motion.stamp_ns[index : index + 1]
        seen = T_map_fan.inverse() @ other.motion.at(stamp_ns).pose(0)
        range_m = float(rng.uniform(0.0, config.field_of_view[1]))
        bearing_rad = math.atan2(seen.y, seen.x)
        return Intruder(bearing_rad, range_m, power_of_db(config.crosstalk_db))

    def pings(self, vehicle: int, indices: range) -> Iterator[SonarImage | SpacePing]:
        """What several pings of one vehicle give."""
        make = self.space_ping if self._mission.config.sonar_kind == "space" else self.ping
        for index in indices:
            yield make(vehicle, index)


def every_metre(run: VehicleRun) -> NDArray[np.float64]:
    """Sonar poses (K, 3) of a run, thinned to one for about each metre or ten degrees."""
    poses = run.sonar_poses()
    moved = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    moved += np.abs(np.diff(np.unwrap(poses[:, 2]))) / math.radians(10.0)
    keys = np.floor(np.concatenate([[0.0], np.cumsum(moved)]))
    return poses[np.unique(keys, return_index=True)[1]]
