"""What makes up the images of a multibeam sonar: settings, and powers by range and angle.

Powers are linear, relative to a flat concrete wall at normal incidence after the receiver's
time-varying gain.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.config import Config, setting
from uw_dslam_ros2.sim.waters.world import World

__all__ = [
    "SonarConfig",
    "amplitude_taps",
    "beam_response",
    "noise_power",
    "power_of_db",
    "reverberation_power",
    "seabed_power",
    "seabed_texture",
]

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]

_ABSORPTION_DB_PER_M = 0.4  # sea water at 1.2 MHz (Francois and Garrison 1982), one way
_REVERBERATION_RANGE_M = 5.0


@dataclass(frozen=True, slots=True)
class SonarConfig(Config):
    """A multibeam imaging sonar; the defaults resemble an Oculus M750d at 1.2 MHz."""

    fov_rad: float = setting(math.radians(130.0), 0.1, 3.2, "horizontal field of view [rad]")
    num_beams: int = setting(256, 8, 2048, "beams, evenly spaced")
    num_ranges: int = setting(400, 16, 20000, "range bins")
    max_range_m: float = setting(40.0, 1.0, 200.0, "outer edge of the last range bin [m]")
    min_range_m: float = setting(0.1, 0.0, 10.0, "nothing nearer is heard [m]")
    beam_width_rad: float = setting(
        math.radians(0.6), 0.001, 0.2, "-3 dB width of a receive beam [rad]"
    )
    side_lobe_db: float = setting(-26.0, -60.0, -5.0, "first side lobes of a beam [dB]")
    far_lobe_db: float = setting(-48.0, -90.0, -10.0, "beam response far off its axis [dB]")
    vertical_width_rad: float = setting(
        math.radians(20.0), 0.02, 1.5, "-3 dB height of the beams [rad]"
    )
    pulse_length_m: float = setting(0.08, 0.001, 1.0, "range resolution of the pulse [m]")
    saturation_db: float = setting(2.0, -30.0, 40.0, "echo power of a full-scale pixel [dB]")
    noise_db: float = setting(-26.0, -80.0, 0.0, "noise after gain at the maximum range [dB]")
    noise_floor_db: float = setting(-54.0, -90.0, 0.0, "noise of the receiver after the gain [dB]")
    seabed_db: float = setting(-15.0, -80.0, 10.0, "echo of the seabed at 45 degrees [dB]")
    seabed_patch_m: float = setting(3.0, 0.2, 50.0, "size of the seabed's patches [m]")
    reverberation_db: float = setting(
        -38.0, -90.0, 0.0, "scattering of the water itself at 5 m, falling with range [dB]"
    )
    ring_db: float = setting(
        -32.0, -90.0, 0.0, "echo straight from the surface and the seabed, in every beam [dB]"
    )
    ghost_db: float = setting(-16.0, -90.0, 0.0, "echo that came by way of the surface [dB]")
    double_bounce_db: float = setting(-24.0, -90.0, 0.0, "echo at twice the range [dB]")
    sound_speed_sigma: float = setting(
        0.002, 0.0, 0.05, "sigma of the error of the assumed speed of sound, which scales ranges"
    )
    misalignment_rad: float = setting(
        math.radians(0.3), 0.0, 0.2, "sigma of the error of the mounting angle [rad]"
    )


def power_of_db(level_db: float) -> float:
    """Linear power of a level."""
    return float(10.0 ** (level_db / 10.0))


def beam_response(config: SonarConfig, ray_step_rad: float, num_steps: int) -> Float32Array:
    """Power (L,) of one ray by multiples of the ray step off a beam's axis.

    An even wall that fills the main lobe gives its own power, summed over rays.
    """
    x = np.arange(num_steps) * ray_step_rad / config.beam_width_rad
    main = np.exp(-4.0 * math.log(2.0) * x * x)
    envelope = power_of_db(config.side_lobe_db) / (1.0 + (x / 3.0) ** 2)
    side = np.where(x > 0.75, envelope * np.sin(math.pi * x) ** 2, 0.0)
    response = main + side + power_of_db(config.far_lobe_db)
    return (response / (2.0 * main.sum() - main[0])).astype(np.float32)


def noise_power(config: SonarConfig, range_m: FloatArray) -> Float32Array:
    """Mean noise (R,): white before the gain, which makes up for spreading and absorption."""
    fraction = range_m / config.max_range_m
    loss_db = 2.0 * _ABSORPTION_DB_PER_M * (config.max_range_m - range_m)
    gained = 10.0 ** ((config.noise_db - loss_db) / 10.0) * fraction**3
    return (gained + power_of_db(config.noise_floor_db)).astype(np.float32)


def seabed_power(
    config: SonarConfig, range_m: FloatArray, altitude_m: float, elevation_rad: float = 0.0
) -> Float32Array:
    """Mean power (R,) of an even seabed: Lambert's law inside the vertical beam pattern.

    ``elevation_rad`` is where the middle of the beam looks, above the horizontal.
    """
    sine = np.clip(altitude_m / np.maximum(range_m, altitude_m), 0.0, 1.0)
    down = (np.arcsin(sine) + elevation_rad) / config.vertical_width_rad
    # Twice: sent and received.
    pattern = np.exp(-8.0 * math.log(2.0) * down**2)
    level = power_of_db(config.seabed_db) * 2.0 * sine**1.5 * pattern
    return np.where(range_m > altitude_m, level, 0.0).astype(np.float32)


def reverberation_power(
    config: SonarConfig, range_m: FloatArray, depth_m: float, altitude_m: float
) -> Float32Array:
    """Mean power (R,) that comes from no direction: the water, and what is right above and below.

    Surface and seabed answer at their distances through the beams' vertical side lobes, however
    far these look away: rings.
    """
    volume = power_of_db(config.reverberation_db) * (
        _REVERBERATION_RANGE_M / np.maximum(range_m, 1.0)
    )
    rings = np.zeros_like(range_m)
    for distance_m in (depth_m, altitude_m):
        behind = range_m - distance_m
        rings += np.where(behind > -config.pulse_length_m, np.exp(-np.abs(behind) / 0.25), 0.0)
    return (volume + power_of_db(config.ring_db) * rings).astype(np.float32)


def amplitude_taps(spacing_rad: float, beam_width_rad: float) -> Float32Array:
    """Weights by which neighbouring beams share one speckle: their overlap in amplitude."""
    reach = min(8, math.ceil(1.5 * beam_width_rad / spacing_rad))
    offsets = np.arange(-reach, reach + 1) * spacing_rad / beam_width_rad
    taps = np.exp(-2.0 * math.log(2.0) * offsets**2)
    return (taps / math.sqrt(2.0 * (taps**2).sum())).astype(np.float32)


def seabed_texture(world: World, patch_m: float) -> Float32Array:
    """Relative strength of the seabed on a grid of half patches over the place: sand and weed."""
    rng = np.random.default_rng([world.seed, 3])
    x_min, y_min, x_max, y_max = world.bounds
    step = 0.5 * patch_m
    shape = (max(4, math.ceil((y_max - y_min) / step)), max(4, math.ceil((x_max - x_min) / step)))
    field = rng.normal(size=shape)
    for axis in (0, 1):
        field = field + np.roll(field, 1, axis) + np.roll(field, -1, axis)
    field /= field.std()
    return (10.0 ** (3.0 * field / 10.0)).astype(np.float32)
