"""What moves in the water and answers sound: schools of fish, clouds of bubbles."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.config import Config, setting
from uw_dslam_ros2.sim.waters.world import World

__all__ = ["ClutterConfig", "MovingClutter", "Scatterers"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ClutterConfig(Config):
    """How much moves in a place."""

    num_schools: int = setting(3, 0, 100, "schools of fish")
    fish_per_school: int = setting(20, 1, 1000, "fish in each")
    school_radius_m: float = setting(1.2, 0.1, 20.0, "spread of a school, one sigma [m]")
    fish_speed_m_s: float = setting(0.4, 0.0, 3.0, "speed of a school [m/s]")
    fish_db: float = setting(-9.0, -60.0, 20.0, "echo of one fish [dB]")
    num_bubble_clouds: int = setting(2, 0, 100, "clouds of bubbles that rise now and then")
    bubble_radius_m: float = setting(1.0, 0.1, 20.0, "spread of a cloud, one sigma [m]")
    bubble_db: float = setting(-14.0, -60.0, 20.0, "echo of each of its 60 parts at first [dB]")
    bubble_life_s: float = setting(20.0, 1.0, 600.0, "time in which a cloud fades [s]")


@dataclass(frozen=True, slots=True, eq=False)
class Scatterers:
    """Small echoes: ``points`` (N, 2) [m] in the world, ``power`` (N,) linear."""

    points: FloatArray
    power: FloatArray


class MovingClutter:
    """All that moves, as a function of time; the same for every vehicle of a mission."""

    _BUBBLES_PER_CLOUD = 60

    def __init__(self, world: World, config: ClutterConfig) -> None:
        self._config = config
        rng = np.random.default_rng([world.seed, 4])
        x_min, y_min, x_max, y_max = world.bounds
        low, high = (x_min + 10.0, y_min + 10.0), (x_max - 10.0, y_max - 10.0)
        schools, fish, clouds = (
            config.num_schools,
            config.fish_per_school,
            config.num_bubble_clouds,
        )
        self._school_centers = rng.uniform(low, high, (schools, 2))
        self._school_reach_m = rng.uniform(5.0, 12.0, (schools, 2))
        self._school_phase = rng.uniform(0.0, 2.0 * math.pi, (schools, 2))
        self._fish_offset_m = rng.normal(0.0, config.school_radius_m, (schools, fish, 2))
        self._fish_phase = rng.uniform(0.0, 2.0 * math.pi, (schools, fish, 2))
        self._cloud_centers = rng.uniform(low, high, (clouds, 2))
        self._cloud_period_s = rng.uniform(2.0, 5.0, clouds) * config.bubble_life_s
        self._cloud_start_s = rng.uniform(0.0, 1.0, clouds) * self._cloud_period_s
        self._bubble_offset_m = rng.normal(
            0.0, config.bubble_radius_m, (clouds, self._BUBBLES_PER_CLOUD, 2)
        )

    def at(self, time_s: float) -> Scatterers:
        """Where everything is, some time after the mission began."""
        config = self._config
        rate = config.fish_speed_m_s / self._school_reach_m
        centers = self._school_centers + self._school_reach_m * np.sin(
            rate * time_s + self._school_phase
        )
        # Each fish swims about inside its school.
        swim = 0.5 * config.school_radius_m * np.sin(0.6 * time_s + self._fish_phase)
        fish = (centers[:, None] + self._fish_offset_m + swim).reshape(-1, 2)
        age_s = (time_s + self._cloud_start_s) % self._cloud_period_s
        # A cloud spreads while it fades.
        spread = 1.0 + age_s / config.bubble_life_s
        bubbles = (
            self._cloud_centers[:, None] + spread[:, None, None] * self._bubble_offset_m
        ).reshape(-1, 2)
        bubble_power = np.repeat(
            10.0 ** (config.bubble_db / 10.0) * np.exp(-age_s / config.bubble_life_s),
            self._BUBBLES_PER_CLOUD,
        )
        fish_power = np.full(len(fish), 10.0 ** (config.fish_db / 10.0))
        return Scatterers(np.vstack([fish, bubbles]), np.concatenate([fish_power, bubble_power]))
