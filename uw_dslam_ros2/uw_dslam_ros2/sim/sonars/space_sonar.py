"""A 3-D sonar: points of walls, of the sea bed and of what lies on it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.config import Config, setting
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.waters.world import World

__all__ = ["SpacePing", "SpaceSonarConfig", "SpaceSonarSimulator"]

FloatArray = NDArray[np.float64]

_GRAZING_RAD = math.radians(3.0)  # a bed that is met flatter than that gives no echo


@dataclass(frozen=True, slots=True)
class SpaceSonarConfig(Config):
    """A 3-D sonar and the objects on the sea bed; the defaults resemble a Sonar 3D-15."""

    fov_rad: float = setting(math.radians(90.0), 0.1, 3.1, "horizontal field of view [rad]")
    height_rad: float = setting(math.radians(40.0), 0.05, 1.5, "vertical field of view [rad]")
    num_columns: int = setting(128, 2, 1024, "beams side by side")
    num_rows: int = setting(24, 2, 512, "beams above each other")
    max_range_m: float = setting(15.0, 1.0, 200.0, "nothing farther is heard [m]")
    noise_m: float = setting(0.03, 0.0, 1.0, "white noise of each range [m]")
    num_objects: int = setting(60, 0, 10000, "boulders and wrecks on the sea bed of the place")
    object_height_m: float = setting(
        3.0, 0.1, 50.0, "largest height of these; the smallest is a tenth [m]"
    )


@dataclass(frozen=True, slots=True, eq=False)
class SpacePing:
    """Echoes (N, 3) [m] of one ping in the sonar's axes: x ahead, y to port, z up."""

    stamp_ns: int
    points: FloatArray


class SpaceSonarSimulator:
    """Makes point clouds of one place: every beam ends at the first thing that it meets."""

    def __init__(self, world: World, config: SpaceSonarConfig) -> None:
        self._world, self._config = world, config
        rng = np.random.default_rng([world.seed, 5])
        x_min, y_min, x_max, y_max = world.bounds
        count = config.num_objects
        self._centers = rng.uniform((x_min, y_min), (x_max, y_max), (count, 2))
        self._radii = rng.uniform(0.3, 1.5, count)
        self._heights = config.object_height_m * rng.uniform(0.1, 1.0, count)
        azimuth = np.linspace(0.5, -0.5, config.num_columns) * config.fov_rad
        elevation = np.linspace(0.5, -0.5, config.num_rows) * config.height_rad
        across, up = (grid.ravel() for grid in np.meshgrid(azimuth, elevation))
        self._beams = np.stack(
            [np.cos(up) * np.cos(across), np.cos(up) * np.sin(across), np.sin(up)]
        )

    def ping(
        self,
        stamp_ns: int,
        T_map_sonar: SE2,
        depth_m: float,
        rng: np.random.Generator,
        R_level_sonar: FloatArray | None = None,
    ) -> SpacePing:
        """Return the points of one ping; the rotation (3, 3) is that of `sway.fan_in_space`."""
        config = self._config
        x, y, z = self._beams if R_level_sonar is None else R_level_sonar @ self._beams
        level = np.hypot(x, y)
        azimuth = T_map_sonar.yaw + np.arctan2(y, x)
        range_m = self._walls(T_map_sonar, azimuth, level, z, depth_m)
        altitude_m = self._world.water_depth_m - depth_m
        is_down = z < -math.sin(_GRAZING_RAD)
        bed = np.where(is_down, altitude_m / np.where(is_down, -z, 1.0), np.inf)
        range_m = np.minimum(range_m, bed)
        for i in np.flatnonzero(self._near(T_map_sonar)):
            range_m = np.minimum(
                range_m, self._object(int(i), T_map_sonar, azimuth, level, z, altitude_m)
            )
        noisy = range_m + rng.normal(0.0, config.noise_m, len(range_m))
        heard = np.isfinite(range_m) & (noisy > 0.0) & (noisy < config.max_range_m)
        return SpacePing(stamp_ns, (self._beams[:, heard] * noisy[heard]).T)

    def _walls(
        self, place: SE2, azimuth: FloatArray, level: FloatArray, z: FloatArray, depth_m: float
    ) -> FloatArray:
        """Slant ranges (K,) to walls, which reach from the bed to the surface; inf: none."""
        hits = self._world.cast((place.x, place.y), azimuth, self._config.max_range_m)
        found = hits.range_m / np.maximum(level, 1e-9)
        height = np.where(np.isfinite(found), found, 0.0) * z
        is_wall = (height < depth_m) & (height > depth_m - self._world.water_depth_m)
        return np.where(is_wall, found, np.inf)

    def _near(self, place: SE2) -> NDArray[np.bool_]:
        away = np.hypot(*(self._centers - [place.x, place.y]).T)
        # Vehicles keep clear of what stands in their way.
        return (away < self._config.max_range_m + self._radii) & (away > self._radii + 1.0)

    def _object(
        self,
        number: int,
        place: SE2,
        azimuth: FloatArray,
        level: FloatArray,
        z: FloatArray,
        altitude_m: float,
    ) -> FloatArray:
        """Slant ranges (K,) to a cylinder that stands on the bed: its side, or its top."""
        top_m = self._heights[number] - altitude_m
        dx, dy = self._centers[number] - [place.x, place.y]
        ahead = np.cos(azimuth) * dx + np.sin(azimuth) * dy
        beside = -np.sin(azimuth) * dx + np.cos(azimuth) * dy
        half = np.sqrt(np.maximum(self._radii[number] ** 2 - beside**2, 0.0))
        is_met = (half > 0.0) & (ahead > 0.0)
        slope = z / np.maximum(level, 1e-9)
        first, last = ahead - half, ahead + half
        side = is_met & (first * slope <= top_m)
        over = is_met & ~side & (last * slope <= top_m)  # comes down on its top
        reach = np.where(side, first, np.where(over, top_m / np.where(over, slope, 1.0), np.inf))
        return np.where(side | over, reach / np.maximum(level, 1e-9), np.inf)
