"""Images of a multibeam forward-looking sonar: echoes, seabed, shadows, ghosts, speckle, noise.

The mean echo power of every pixel is summed in linear units, relative to a flat concrete wall at
normal incidence (0 dB) after time-varying gain. Fully developed speckle multiplies it, and the
display's compression makes 8-bit pixels of it, ``power ** 0.25``: real Oculus pings have just
those statistics (a coefficient of variation of 0.28 where the scene is even).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.config import Config, setting
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar.types import SonarImage
from uw_dslam_ros2.sim.sonar_kernels import add_echoes, add_seabed, filter_beams
from uw_dslam_ros2.sim.world import RayHits, World

__all__ = ["SonarConfig", "SonarSimulator"]

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]

_RAYS_PER_BEAM = 4
_DYNAMIC_POWER = 0.25
_ABSORPTION_DB_PER_M = 0.4  # sea water at 1.2 MHz (Francois and Garrison 1982), one way


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
    ghost_db: float = setting(-16.0, -90.0, 0.0, "echo that came by way of the surface [dB]")
    double_bounce_db: float = setting(-24.0, -90.0, 0.0, "echo at twice the range [dB]")


class SonarSimulator:
    """Makes pings of one place with one sonar; randomness comes from the caller's generator."""

    def __init__(self, world: World, config: SonarConfig = SonarConfig()) -> None:
        self.config = config
        self._world = world
        half = 0.5 * config.fov_rad
        # Port first: the way the instrument's y axis (to starboard) counts.
        self.bearing_rad: FloatArray = np.linspace(half, -half, config.num_beams)
        self._bin_m = config.max_range_m / config.num_ranges
        self.range_m = (np.arange(config.num_ranges, dtype=np.float64) + 0.5) * self._bin_m
        spacing = config.fov_rad / (config.num_beams - 1)
        # Rays also beyond the edges: what lies there leaks in through the beams' flanks.
        num_extra = math.ceil(2.0 * config.beam_width_rad / spacing)
        count = (config.num_beams + 2 * num_extra) * _RAYS_PER_BEAM
        edge = half + (num_extra + 0.5) * spacing
        self._ray_step = 2.0 * edge / count
        self._ray_rad = edge - (np.arange(count, dtype=np.float64) + 0.5) * self._ray_step
        self._response = self._beam_response()
        self._speckle_taps = _amplitude_taps(spacing, config.beam_width_rad)
        self._noise = self._noise_power()
        self._texture = _seabed_texture(world, config.seabed_patch_m)

    def _beam_response(self) -> Float32Array:
        """Power by multiples of the ray step off a beam's axis; a beam sees the sum over rays."""
        config = self.config
        off_rad = np.arange(len(self._ray_rad)) * self._ray_step
        x = off_rad / config.beam_width_rad
        main = np.exp(-4.0 * math.log(2.0) * x * x)
        envelope = 10.0 ** (config.side_lobe_db / 10.0) / (1.0 + (x / 3.0) ** 2)
        side = np.where(x > 0.75, envelope * np.sin(math.pi * x) ** 2, 0.0)
        far = 10.0 ** (config.far_lobe_db / 10.0)
        response = main + side + far
        # An even wall that fills the main lobe gives its own power.
        main_sum = 2.0 * main.sum() - main[0]
        return (response / main_sum).astype(np.float32)

    def _noise_power(self) -> Float32Array:
        """Mean noise (R,): white before the gain, which makes up for spreading and absorption."""
        config = self.config
        fraction = self.range_m / config.max_range_m
        loss_db = 2.0 * _ABSORPTION_DB_PER_M * (config.max_range_m - self.range_m)
        gained = 10.0 ** ((config.noise_db - loss_db) / 10.0) * fraction**3
        return (gained + 10.0 ** (config.noise_floor_db / 10.0)).astype(np.float32)

    def ping(
        self, stamp_ns: int, T_map_sonar: SE2, depth_m: float, rng: np.random.Generator
    ) -> SonarImage:
        """Return the 8-bit image of one ping from a pose in the world and a depth."""
        power = self._mean_power(T_map_sonar, depth_m, rng)
        speckle = filter_beams(
            rng.standard_normal((2, *power.shape), dtype=np.float32), self._speckle_taps
        )
        scale = 255.0 / 10.0 ** (_DYNAMIC_POWER * self.config.saturation_db / 10.0)
        pixels = scale * np.sqrt(np.sqrt(power * speckle))
        image = np.minimum(pixels, 255.0).astype(np.uint8)
        image[self.range_m < self.config.min_range_m] = 0
        return SonarImage(stamp_ns, image, self.range_m, self.bearing_rad)

    def _mean_power(
        self, T_map_sonar: SE2, depth_m: float, rng: np.random.Generator
    ) -> Float32Array:
        """Mean echo power (R, B), before speckle."""
        config, world = self.config, self._world
        hits = world.cast(
            (T_map_sonar.x, T_map_sonar.y), T_map_sonar.yaw + self._ray_rad, config.max_range_m
        )
        power = np.zeros((config.num_beams, config.num_ranges), dtype=np.float32)
        strength = self._echo_strength(hits)
        altitude_m = world.water_depth_m - depth_m
        self._add_walls(power, hits, strength, min(depth_m, altitude_m))
        self._add_ghosts(power, hits, strength, depth_m, rng)
        add_seabed(
            power,
            hits.range_m,
            (T_map_sonar.x, T_map_sonar.y),
            T_map_sonar.yaw + self.bearing_rad,
            self._first_ray(),
            _RAYS_PER_BEAM,
            self._seabed_power(altitude_m),
            self._texture,
            (world.bounds[0], world.bounds[1]),
            0.5 * config.seabed_patch_m,
            self._bin_m,
        )
        return np.ascontiguousarray(power.T) + self._noise[:, None]

    def _first_ray(self) -> int:
        """Index of the first ray that belongs to the first beam."""
        return (len(self._ray_rad) - self.config.num_beams * _RAYS_PER_BEAM) // 2

    def _echo_strength(self, hits: RayHits) -> FloatArray:
        """Power (K,) of each ray's wall: Lambert's law, and a flash near normal incidence."""
        world = self._world
        surfaces = world.surfaces
        strength_db = np.array([s.strength_db for s in surfaces])
        specular_db = np.array([s.specular_db for s in surfaces])
        is_hit = hits.segment >= 0
        kind = world.surface_of[np.where(is_hit, hits.segment, 0)]
        cosine = np.clip(hits.cos_incidence, 0.02, 1.0)
        incidence = np.arccos(cosine)
        flash = (10.0 ** (specular_db[kind] / 10.0) - 1.0) * np.exp(-((incidence / 0.15) ** 2))
        # Concrete and rock are uneven: the strength varies along the wall, but not with time.
        pattern = np.sin(1.7 * hits.along_m + 1.3 * hits.segment) + np.sin(
            4.1 * hits.along_m + 2.9 * hits.segment
        )
        level_db = strength_db[kind] + 1.5 * pattern
        return np.where(is_hit, 10.0 ** (level_db / 10.0) * (cosine**2 + flash), 0.0)

    def _add_walls(
        self, power: Float32Array, hits: RayHits, strength: FloatArray, reach_m: float
    ) -> None:
        """Direct echoes. A wall is tall: what lies above and below the axis answers later."""
        config = self.config
        ranges = np.where(np.isfinite(hits.range_m), hits.range_m, 0.0)
        tangent = np.sqrt(1.0 / np.clip(hits.cos_incidence, 0.05, 1.0) ** 2 - 1.0)
        spread = np.minimum(ranges * self._ray_step * tangent, 1.5)
        reach = np.minimum(reach_m, ranges * math.tan(0.5 * config.vertical_width_rad))
        tail = np.hypot(ranges, reach) - ranges
        add_echoes(
            power,
            ranges,
            strength,
            spread + config.pulse_length_m,
            tail,
            self._response,
            self._ray_rad[0] - self.bearing_rad[0],
            self._ray_step,
            self.bearing_rad[0] - self.bearing_rad[1],
            self._bin_m,
            len(self._response),
        )

    def _add_ghosts(
        self,
        power: Float32Array,
        hits: RayHits,
        strength: FloatArray,
        depth_m: float,
        rng: np.random.Generator,
    ) -> None:
        """Echoes by way of the surface, and between a flat wall and the vehicle itself."""
        config = self.config
        is_hit = np.isfinite(hits.range_m)
        direct = np.where(is_hit, hits.range_m, 0.0)
        bounced = np.hypot(direct, 2.0 * depth_m)
        # The surface moves: a ghost's strength is another one each ping.
        fading = rng.exponential(size=3)
        one_way = 10.0 ** (config.ghost_db / 10.0)
        is_square = hits.cos_incidence > 0.96
        paths = (
            (0.5 * (direct + bounced), strength * one_way * fading[0]),
            (bounced, strength * one_way**1.5 * fading[1]),
            (
                2.0 * direct,
                np.where(is_square, strength, 0.0)
                * 10.0 ** (config.double_bounce_db / 10.0)
                * fading[2],
            ),
        )
        num_near = math.ceil(1.5 * config.beam_width_rad / self._ray_step)
        for path_m, path_strength in paths:
            add_echoes(
                power,
                np.where(is_hit, path_m, 0.0),
                path_strength,
                np.full(len(path_m), 2.0 * config.pulse_length_m),
                0.02 * path_m,
                self._response,
                self._ray_rad[0] - self.bearing_rad[0],
                self._ray_step,
                self.bearing_rad[0] - self.bearing_rad[1],
                self._bin_m,
                num_near,
            )

    def _seabed_power(self, altitude_m: float) -> Float32Array:
        """Mean power (R,) of an even seabed: Lambert's law inside the vertical beam pattern."""
        config = self.config
        sine = np.clip(altitude_m / np.maximum(self.range_m, altitude_m), 0.0, 1.0)
        down_rad = np.arcsin(sine)
        pattern = np.exp(-4.0 * math.log(2.0) * (down_rad / config.vertical_width_rad) ** 2)
        # Twice: sent and received.
        level = 10.0 ** (config.seabed_db / 10.0) * 2.0 * sine**1.5 * pattern**2
        return np.where(self.range_m > altitude_m, level, 0.0).astype(np.float32)


def _amplitude_taps(spacing_rad: float, beam_width_rad: float) -> Float32Array:
    """Weights by which neighbouring beams share one speckle: their overlap in amplitude."""
    reach = min(8, math.ceil(1.5 * beam_width_rad / spacing_rad))
    offsets = np.arange(-reach, reach + 1) * spacing_rad / beam_width_rad
    taps = np.exp(-2.0 * math.log(2.0) * offsets**2)
    return (taps / math.sqrt(2.0 * (taps**2).sum())).astype(np.float32)


def _seabed_texture(world: World, patch_m: float) -> Float32Array:
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
