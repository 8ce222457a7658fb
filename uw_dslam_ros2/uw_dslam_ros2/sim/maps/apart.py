"""Maps of one place that were built apart: by other vehicles, sonars and settings, years later.

Every vehicle swims its own way through a part of its place, with a sonar, instruments and mapper
settings of its own, and goes through the real mapper. Nothing of a pair of such maps is common but
the place, so that they differ as maps of different owners do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import FREE, OCCUPIED, UNKNOWN, OccupancyMap
from uw_dslam_ros2.core.mapping import OccupancyConfig, SubmapConfig, VehicleMapperConfig
from uw_dslam_ros2.core.metrics import align_points
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.maps.pairs import MapPair
from uw_dslam_ros2.sim.missions.mapped import MappedRun, map_run
from uw_dslam_ros2.sim.missions.mission import Mission, MissionConfig, plan_mission
from uw_dslam_ros2.sim.sonars.model import SonarConfig
from uw_dslam_ros2.sim.sonars.turning import TurningSonarConfig
from uw_dslam_ros2.sim.vehicles.instruments import InstrumentConfig
from uw_dslam_ros2.sim.vehicles.paths import SurveyArea
from uw_dslam_ros2.sim.vehicles.vehicle import DriveConfig
from uw_dslam_ros2.sim.waters.clutter import ClutterConfig
from uw_dslam_ros2.sim.waters.places import make_canal, make_harbour, make_lake, make_symmetric
from uw_dslam_ros2.sim.waters.seasons import another_season
from uw_dslam_ros2.sim.waters.world import World

__all__ = ["APART_KINDS", "ApartMap", "apart_pair", "different_pair", "make_apart_map"]

FloatArray = NDArray[np.float64]

APART_KINDS = ("harbour", "lake", "canal", "twin", "symmetric")
"""Kinds of places; "twin": two basins of one plan, "symmetric": one that looks alike half-turned.

Of every four vehicles the last two come in another season, to the other twin, to the other half.
"""

_CELLS_M = (0.05, 0.1, 0.1, 0.15, 0.25, 0.5)
_NUM_AREA_TRIES = 30
_LEAST_AREA_M = 30.0
_LOCAL_M = 25.0  # poses this near the middle of what both saw say where it lies
_LEAST_LOCAL = 12
_TOLERANCE_M, _TOLERANCE_CELLS, _TOLERANCE_BENDS = 0.3, 2.0, 1.0
_TOLERANCE_RAD = math.radians(3.0)


@dataclass(frozen=True, slots=True, eq=False)
class ApartMap:
    """A vehicle's map, and where it really was.

    ``site`` is equal for maps of one place, whatever the season, and for no others.
    """

    kind: str
    site: tuple[str, int, int]
    season: int
    run: MappedRun

    @property
    def seed(self) -> int:
        """Of its place, and of the twin of its place."""
        return self.site[1]


def make_apart_map(kind: str, seed: int, vehicle: int) -> ApartMap:
    """One vehicle's map of a place; the same arguments give the same map.

    Raises
    ------
    InvalidInputError
        For an unknown kind, or where the vehicle finds no way.
    """
    is_second = vehicle % 4 >= 2
    twin = 1 + is_second if kind == "twin" else 0
    world = _world(kind, seed, twin)
    rng = np.random.default_rng([seed, APART_KINDS.index(kind), 40 + vehicle])
    season = int(is_second and kind in ("harbour", "lake"))
    if season:
        world = another_season(world, np.random.default_rng([seed, 41, season]))
    half = None if kind != "symmetric" else int(is_second)
    mission, mapper, is_trinary = _planned(world, rng, half)
    run = map_run(mission, 0, mapper)
    if is_trinary:
        run = replace(run, map=_trinary(run.map))
    return ApartMap(kind, (kind, seed, twin), season, run)


def _world(kind: str, seed: int, twin: int) -> World:
    width_m = float(np.random.default_rng([seed, 42]).uniform(60.0, 120.0))
    match kind:
        case "harbour" | "twin":
            return make_harbour(seed, width_m=width_m, twin=twin)
        case "lake":
            return make_lake(seed, width_m=width_m)
        case "canal":
            return make_canal(seed, width_m)
        case "symmetric":
            return make_symmetric(seed, width_m)
    raise InvalidInputError(f"kind is {kind!r}, expected one of {', '.join(APART_KINDS)}")


def _planned(
    world: World, rng: np.random.Generator, half: int | None
) -> tuple[Mission, VehicleMapperConfig, bool]:
    """A vehicle's survey, its mapper's settings, and whether its map is given away trinary."""
    is_turning = rng.random() < 0.3
    speed_m_s = rng.uniform(0.4, 0.8) if is_turning else rng.uniform(0.8, 1.5)
    path_m = rng.uniform(40.0, 90.0) if is_turning else rng.uniform(60.0, 180.0)
    drift = math.exp(rng.uniform(math.log(0.5), math.log(4.0)))
    usual = InstrumentConfig()
    config = MissionConfig(
        seed=int(rng.integers(2**31)),
        num_vehicles=1,
        duration_s=float(path_m / speed_m_s),
        clearance_m=float(rng.uniform(2.5, 6.0)),
        sonar_kind="turning" if is_turning else "imaging",
        ping_rate_hz=float(rng.uniform(1.5, 3.0)),
        sonar=SonarConfig(
            fov_rad=math.radians(rng.uniform(70.0, 130.0)),
            num_beams=int(rng.choice([96, 128, 192])),
            num_ranges=int(rng.choice([200, 300])),
            max_range_m=float(rng.uniform(15.0, 40.0)),
            beam_width_rad=math.radians(rng.uniform(0.6, 1.5)),
        ),
        turning=TurningSonarConfig(
            turn_s=float(rng.uniform(4.0, 9.0)),
            num_beams=int(rng.choice([100, 150, 200])),
            num_ranges=300,
            max_range_m=float(rng.uniform(15.0, 40.0)),
        ),
        drive=DriveConfig(speed_m_s=float(speed_m_s), current_yaw_rad=float(rng.uniform(-3, 3))),
        instruments=InstrumentConfig(
            heading_source=str(rng.choice(["gyro", "gyro", "gyro", "compass"])),
            gyro_bias_deg_h=drift * usual.gyro_bias_deg_h,
            angle_walk_deg_sqrt_h=drift * usual.angle_walk_deg_sqrt_h,
            dvl_scale_sigma=drift * usual.dvl_scale_sigma,
            dvl_noise_m_s=drift * usual.dvl_noise_m_s,
            compass_deflection_rad=math.radians(4.0),
        ),
        clutter=ClutterConfig(num_schools=int(rng.integers(0, 5))),
    )
    mapper = VehicleMapperConfig(
        estimator=str(rng.choice(["scan_matching"] * 5 + ["dead_reckoning"])),
        occupancy=OccupancyConfig(
            resolution_m=float(rng.choice(_CELLS_M)),
            hit_log_odds=float(rng.uniform(0.4, 1.0)),
            free_margin_m=float(rng.uniform(0.1, 0.4)),
        ),
        submap=SubmapConfig(max_length_m=float(rng.uniform(15.0, 40.0))),
    )
    is_trinary = bool(rng.random() < 0.5)
    for _ in range(_NUM_AREA_TRIES):
        try:
            mission = plan_mission(config, world, [_area(world, rng, half)])
        except InvalidInputError:  # no way through there, or none that is long enough
            continue
        return mission, mapper, is_trinary
    raise InvalidInputError(f"{world.name} {world.seed} has no area that a vehicle can survey")


def _area(world: World, rng: np.random.Generator, half: int | None) -> SurveyArea:
    """A rectangle of any size from a third of the place up, or a half of it."""
    x_min, y_min, x_max, y_max = world.bounds
    if half is not None:
        middle = 0.5 * (x_min + x_max)
        x_min, x_max = (x_min, middle) if half == 0 else (middle, x_max)
        return SurveyArea(x_min, y_min, x_max, y_max)
    width = max(rng.uniform(0.3, 1.0) * (x_max - x_min), _LEAST_AREA_M)
    height = max(rng.uniform(0.4, 1.0) * (y_max - y_min), _LEAST_AREA_M)
    x = rng.uniform(x_min, max(x_max - width, x_min))
    y = rng.uniform(y_min, max(y_max - height, y_min))
    return SurveyArea(float(x), float(y), float(x + width), float(y + height))


def _trinary(occupancy: OccupancyMap) -> OccupancyMap:
    """As a map server's file keeps it."""
    values = np.full(occupancy.values.shape, UNKNOWN, np.int8)
    values[(occupancy.values >= 0) & (occupancy.values <= 20)] = FREE
    values[occupancy.values >= 65] = OCCUPIED
    return replace(occupancy, values=values)


def apart_pair(source: ApartMap, target: ApartMap) -> MapPair:
    """Two maps of one place, with the motion that lays what both saw on itself.

    Maps are bent, so the true motion is that of the part in common: it is fitted to the poses near
    its middle, in both maps, and what they are bent there is part of the tolerance.
    ``MapPair.overlap`` is the share of the smaller seen area; without any there is no answer.
    """
    known = [_seen_in_world(one, _placed(one)) for one in (source, target)]
    common = known[0] & known[1]
    overlap = len(common) / max(min(len(known[0]), len(known[1])), 1)
    if not common:
        return different_pair(source, target)
    middle = np.mean(np.array(list(common)), axis=0) + 0.5
    places, bends = zip(*(_placed_near(one, middle) for one in (source, target)), strict=True)
    cell_m = max(one.run.map.spec.resolution_m for one in (source, target))
    at = places[0].inverse().apply(middle)
    return MapPair(
        source.kind,
        "season" if source.season != target.season else "apart",
        overlap,
        source.run.map,
        target.run.map,
        places[1].inverse() @ places[0],
        source.kind == "symmetric",
        (float(at[0]), float(at[1])),
        _TOLERANCE_M + _TOLERANCE_CELLS * cell_m + _TOLERANCE_BENDS * math.hypot(*bends),
        _TOLERANCE_RAD,
    )


def different_pair(source: ApartMap, target: ApartMap) -> MapPair:
    """Two maps that show no common place."""
    kind = "twin" if source.kind == target.kind == "twin" and source.seed == target.seed else "any"
    return MapPair(kind, "different", 0.0, source.run.map, target.run.map, None)


def _placed(one: ApartMap) -> SE2:
    """``T_world_map`` by all poses."""
    return align_points(one.run.poses[:, :2], one.run.true_poses[:, :2])


def _placed_near(one: ApartMap, middle: FloatArray) -> tuple[SE2, float]:
    """``T_world_map`` by the poses near a place in the world, and how far they lie off it [m]."""
    poses, truth = one.run.poses[:, :2], one.run.true_poses[:, :2]
    distance = np.hypot(*(truth - middle).T)
    nearest = np.partition(distance, min(_LEAST_LOCAL, len(distance)) - 1)
    is_near = distance <= max(_LOCAL_M, float(nearest[min(_LEAST_LOCAL, len(distance)) - 1]))
    placed = align_points(poses[is_near], truth[is_near])
    error = placed.apply(poses[is_near]) - truth[is_near]
    return placed, float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def _seen_in_world(one: ApartMap, T_world_map: SE2) -> set[tuple[int, int]]:
    """Square metres of the world that a map knows anything of."""
    spec = one.run.map.spec
    step = max(1, round(0.25 / spec.resolution_m))
    cells = np.argwhere(one.run.map.known[::step, ::step]) * step
    squares = np.unique(np.floor(T_world_map.apply(spec.centers_of(cells))), axis=0)
    return set(map(tuple, squares.astype(int).tolist()))
