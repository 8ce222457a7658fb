"""Roll and pitch of a vehicle under way, and how the fan of its sonar then lies in the water."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.config import Config, setting
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["SwayConfig", "body_rates", "fan_in_space", "rotation_level_base"]

FloatArray = NDArray[np.float64]

_ROLL_S, _PITCH_S = 4.7, 6.1
"""Periods: a small vehicle rolls faster than it pitches."""


@dataclass(frozen=True, slots=True)
class SwayConfig(Config):
    """How a vehicle rolls and pitches, and how its sonar is tilted; by default all is level."""

    roll_rad: float = setting(0.0, 0.0, 0.7, "amplitude of the roll [rad]")
    pitch_rad: float = setting(0.0, 0.0, 0.7, "amplitude of the pitch [rad]")
    sonar_tilt_rad: float = setting(
        0.0, -0.9, 0.9, "how far the sonar looks down; its mounting in /tf_static says so [rad]"
    )

    @property
    def is_level(self) -> bool:
        """Whether the fan always lies in the horizontal plane."""
        return self.roll_rad == self.pitch_rad == self.sonar_tilt_rad == 0.0

    @property
    def is_steady(self) -> bool:
        """Whether the vehicle neither rolls nor pitches."""
        return self.roll_rad == self.pitch_rad == 0.0

    def at(self, stamp_ns: int) -> tuple[float, float, float, float]:
        """Roll (port side up) and pitch (bow down) [rad], and how fast they grow [rad/s]."""
        values = []
        for amplitude, period_s in ((self.roll_rad, _ROLL_S), (self.pitch_rad, _PITCH_S)):
            pulsation = 2.0 * math.pi / period_s
            # Whole periods are taken off first, so that no digits are lost.
            phase = pulsation * ((stamp_ns % round(period_s * 1e9)) * 1e-9)
            values.append((amplitude * math.sin(phase), amplitude * pulsation * math.cos(phase)))
        (roll, roll_rate), (pitch, pitch_rate) = values
        return roll, pitch, roll_rate, pitch_rate


def rotation_level_base(roll_rad: float, pitch_rad: float) -> FloatArray:
    """``R_level_base`` (3, 3): pitch about the level y axis after roll about the x axis."""
    cr, sr, cp, sp = (
        math.cos(roll_rad), math.sin(roll_rad), math.cos(pitch_rad), math.sin(pitch_rad),
    )  # fmt: skip
    return np.array([[cp, sp * sr, sp * cr], [0.0, cr, -sr], [-sp, cp * sr, cp * cr]])


def body_rates(
    sway: tuple[float, float, float, float], yaw_rate_rad_s: float
) -> tuple[float, float, float]:
    """What a gyro in the vehicle measures [rad/s], about its own axes x, y, z."""
    roll, pitch, roll_rate, pitch_rate = sway
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    return (
        roll_rate - yaw_rate_rad_s * sp,
        pitch_rate * cr + yaw_rate_rad_s * cp * sr,
        -pitch_rate * sr + yaw_rate_rad_s * cp * cr,
    )


def fan_in_space(
    R_level_base: FloatArray, T_base_fan: SE2, height_m: float, tilt_rad: float
) -> tuple[SE2, FloatArray]:
    """Where a fan mounted at a height above base_link, and tilted down, is on a leaning vehicle.

    Returns its place and direction seen from above, ``T_level_fan``, and the rotation (3, 3) of
    the fan's axes (x ahead, y to port, z up) in the level frame of that direction.
    """
    place = R_level_base @ [T_base_fan.x, T_base_fan.y, height_m]
    turn = _about_z(T_base_fan.yaw)
    rotation = R_level_base @ turn @ rotation_level_base(0.0, tilt_rad)
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    return SE2(float(place[0]), float(place[1]), yaw), _about_z(-yaw) @ rotation


def _about_z(angle_rad: float) -> FloatArray:
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
