"""A sonar that turns: one beam at a time, as scanning sonars of small vehicles make them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.config import Config, setting
from uw_dslam_ros2.core.se2 import SE2, wrap_angle
from uw_dslam_ros2.core.sonar.types import SonarImage
from uw_dslam_ros2.sim.sonars.imaging import Intruder, SonarSimulator
from uw_dslam_ros2.sim.sonars.model import SonarConfig
from uw_dslam_ros2.sim.waters.clutter import Scatterers
from uw_dslam_ros2.sim.waters.world import World

__all__ = [
    "TURNING_MESSAGES",
    "TurningSonarConfig",
    "TurningSonarSimulator",
    "beam_bearing_rad",
    "counted_rad",
]

FloatArray = NDArray[np.float64]

TURNING_MESSAGES = ("beam", "turn", "points")
"""What a message of the sonar can hold."""

_FAN_BEAMS, _FAN_RAD = 9, 0.12
"""A narrow fan around the beam, of which the middle is kept: what it hears from beside it."""


@dataclass(frozen=True, slots=True)
class TurningSonarConfig(Config):
    """A mechanically scanned sonar; the defaults resemble a Ping360.

    What is not set here is as the imaging sonar has it.
    """

    turn_s: float = setting(14.0, 1.0, 120.0, "time of a whole turn [s]")
    num_beams: int = setting(200, 16, 3600, "beams in a turn")
    beam_width_rad: float = setting(math.radians(2.0), 0.005, 0.2, "-3 dB width of the beam [rad]")
    num_ranges: int = setting(600, 16, 20000, "range bins")
    max_range_m: float = setting(30.0, 1.0, 200.0, "outer edge of the last range bin [m]")
    message: str = setting(
        "beam",
        choices=TURNING_MESSAGES,
        doc="a LaserScan holds one beam or a turn; or the points of a turn, deskewed",
    )
    zero_rad: float = setting(
        0.0, -math.pi, math.pi, "where its zero really points, counter-clockwise from ahead [rad]"
    )
    is_clockwise: bool = setting(False, doc="its angles grow clockwise, and nobody says so")

    @property
    def interval_s(self) -> float:
        """Time from beam to beam."""
        return self.turn_s / self.num_beams


def beam_bearing_rad(config: TurningSonarConfig, index: int) -> float:
    """Where the beam of some number points: counter-clockwise from ahead."""
    return wrap_angle(2.0 * math.pi * (index % config.num_beams) / config.num_beams)


def counted_rad(config: TurningSonarConfig, bearing_rad: float) -> float:
    """What the sonar says of a bearing."""
    side = -1.0 if config.is_clockwise else 1.0
    return side * wrap_angle(bearing_rad - config.zero_rad)


class TurningSonarSimulator:
    """Makes single beams of one place; randomness comes from the caller's generator."""

    def __init__(
        self, world: World, config: TurningSonarConfig, like: SonarConfig, range_scale: float
    ) -> None:
        self._config = config
        fan = replace(
            like,
            fov_rad=_FAN_RAD,
            num_beams=_FAN_BEAMS,
            beam_width_rad=config.beam_width_rad,
            num_ranges=config.num_ranges,
            max_range_m=config.max_range_m,
        )
        self._fan = SonarSimulator(world, fan, range_scale)

    def beam(
        self,
        stamp_ns: int,
        index: int,
        T_map_beam: SE2,
        depth_m: float,
        rng: np.random.Generator,
        clutter: Scatterers | None = None,
        R_level_fan: FloatArray | None = None,
        intruder: Intruder | None = None,
    ) -> SonarImage:
        """Return the 8-bit intensities (R, 1) of one beam, from where it looks; see `ping`."""
        bearing = beam_bearing_rad(self._config, index)
        fan = self._fan.ping(stamp_ns, T_map_beam, depth_m, rng, clutter, R_level_fan, intruder)
        middle = _FAN_BEAMS // 2
        return SonarImage(
            stamp_ns, fan.intensity[:, middle : middle + 1], fan.range_m, np.array([bearing])
        )
