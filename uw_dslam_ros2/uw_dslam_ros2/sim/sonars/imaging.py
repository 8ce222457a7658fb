"""Images of a multibeam forward-looking sonar: echoes, seabed, shadows, ghosts, speckle, noise.

The mean echo power of every pixel is summed in linear units (`model`). Fully developed
speckle multiplies it, and the display's compression makes 8-bit pixels of it, ``power ** 0.25``:
real Oculus pings have just those statistics (a coefficient of variation of 0.28 where the scene
is even).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar.types import SonarImage
from uw_dslam_ros2.sim.sonars.kernels import add_echoes, add_seabed, filter_beams
from uw_dslam_ros2.sim.sonars.model import (
    SonarConfig,
    amplitude_taps,
    beam_response,
    noise_power,
    power_of_db,
    reverberation_power,
    seabed_power,
    seabed_texture,
)
from uw_dslam_ros2.sim.waters.clutter import Scatterers
from uw_dslam_ros2.sim.waters.world import RayHits, World

__all__ = ["Intruder", "SonarConfig", "SonarSimulator"]

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]

_RAYS_PER_BEAM = 4
_DYNAMIC_POWER = 0.25
_TWO_WAY = 0.5 / math.sqrt(2.0)
"""Half of a beam's height that counts for an echo: it was sent through it and received."""


@dataclass(frozen=True, slots=True)
class Intruder:
    """A ping of another vehicle, heard in the middle of an own one."""

    bearing_rad: float
    range_m: float
    """Where it seems to be, by the time at which it comes."""
    power: float


class SonarSimulator:
    """Makes pings of one place with one sonar; randomness comes from the caller's generator.

    Parameters
    ----------
    world, config : the place and the instrument.
    range_scale : what the instrument says where the range is 1, by its speed of sound.
    """

    def __init__(
        self, world: World, config: SonarConfig | None = None, range_scale: float = 1.0
    ) -> None:
        config = config or SonarConfig()
        self.config = config
        self._world = world
        self._range_scale = range_scale
        half = 0.5 * config.fov_rad
        # Port first: the way the instrument's y axis (to starboard) counts.
        self.bearing_rad = np.linspace(half, -half, config.num_beams, dtype=np.float64)
        self._bin_m = config.max_range_m / config.num_ranges
        self.range_m = (np.arange(config.num_ranges, dtype=np.float64) + 0.5) * self._bin_m
        spacing = config.fov_rad / (config.num_beams - 1)
        self._beam_step = spacing
        # Rays also beyond the edges: what lies there leaks in through the beams' flanks.
        num_extra = math.ceil(2.0 * config.beam_width_rad / spacing)
        self._first_ray = num_extra * _RAYS_PER_BEAM
        count = config.num_beams * _RAYS_PER_BEAM + 2 * self._first_ray
        edge = half + (num_extra + 0.5) * spacing
        self._ray_step = 2.0 * edge / count
        self._ray_rad = edge - (np.arange(count, dtype=np.float64) + 0.5) * self._ray_step
        self._response = beam_response(config, self._ray_step, count)
        self._num_near = math.ceil(1.5 * config.beam_width_rad / self._ray_step)
        self._speckle_taps = amplitude_taps(spacing, config.beam_width_rad)
        self._noise = noise_power(config, self.range_m)
        self._texture = seabed_texture(world, config.seabed_patch_m)

    def ping(
        self,
        stamp_ns: int,
        T_map_sonar: SE2,
        depth_m: float,
        rng: np.random.Generator,
        clutter: Scatterers | None = None,
        R_level_fan: FloatArray | None = None,
        intruder: Intruder | None = None,
    ) -> SonarImage:
        """Return the 8-bit image of one ping from a pose in the world and a depth.

        ``R_level_fan`` (3, 3) is that of `sway.fan_in_space`; None: the fan is level.
        """
        power = self._mean_power(T_map_sonar, depth_m, rng, clutter, R_level_fan)
        if intruder is not None:
            self._add_intruder(power, intruder)
        speckle = filter_beams(
            rng.standard_normal((2, *power.shape), dtype=np.float32), self._speckle_taps
        )
        scale = 255.0 / 10.0 ** (_DYNAMIC_POWER * self.config.saturation_db / 10.0)
        power *= speckle
        pixels = scale * np.sqrt(np.sqrt(power))
        image = np.minimum(pixels, 255.0).astype(np.uint8)
        image[self.range_m < self.config.min_range_m] = 0
        return SonarImage(stamp_ns, image, self.range_m, self.bearing_rad)

    def _mean_power(
        self,
        T_map_sonar: SE2,
        depth_m: float,
        rng: np.random.Generator,
        clutter: Scatterers | None,
        R_level_fan: FloatArray | None,
    ) -> Float32Array:
        """Mean echo power (R, B), before speckle."""
        config, world = self.config, self._world
        azimuth_rad, elevation_rad = self._ray_rad, None
        if R_level_fan is not None:
            azimuth_rad, elevation_rad = _directions(R_level_fan, self._ray_rad)
        hits = world.cast(
            (T_map_sonar.x, T_map_sonar.y),
            T_map_sonar.yaw + azimuth_rad,
            config.max_range_m / self._range_scale,
        )
        # From here on ranges are as the instrument measures them.
        ranges = self._range_scale * hits.range_m
        power = np.zeros((config.num_beams, config.num_ranges), dtype=np.float32)
        strength = self._echo_strength(hits)
        altitude_m = world.water_depth_m - depth_m
        if elevation_rad is None:
            self._add_walls(power, ranges, hits.cos_incidence, strength, min(depth_m, altitude_m))
            bed = seabed_power(config, self.range_m, altitude_m)
            beds = np.broadcast_to(bed, power.shape)
        else:
            limits_m = (altitude_m, depth_m)
            ranges, strength = self._add_slanted(
                power, ranges, hits.cos_incidence, strength, elevation_rad, limits_m
            )
            assert R_level_fan is not None
            beams = _directions(R_level_fan, self.bearing_rad)[1]
            beds = np.stack([seabed_power(config, self.range_m, altitude_m, e) for e in beams])
        self._add_ghosts(power, ranges, hits.cos_incidence, strength, depth_m, rng)
        if clutter is not None:
            self._add_clutter(power, ranges, T_map_sonar, clutter)
        add_seabed(
            power,
            ranges,
            (T_map_sonar.x, T_map_sonar.y),
            T_map_sonar.yaw + self.bearing_rad,
            self._first_ray,
            _RAYS_PER_BEAM,
            np.ascontiguousarray(beds),
            self._texture,
            (world.bounds[0], world.bounds[1]),
            0.5 * config.seabed_patch_m,
            self._bin_m,
        )
        everywhere = self._noise + reverberation_power(config, self.range_m, depth_m, altitude_m)
        return np.ascontiguousarray(power.T) + everywhere[:, None]

    def _echo_strength(self, hits: RayHits) -> FloatArray:
        """Power (K,) of each ray's wall: Lambert's law, and a flash near normal incidence."""
        world = self._world
        strength_db = np.array([s.strength_db for s in world.surfaces])
        specular_db = np.array([s.specular_db for s in world.surfaces])
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

    def _add(
        self,
        power: Float32Array,
        offsets_rad: FloatArray,
        ranges: FloatArray,
        strength: FloatArray,
        widths: FloatArray,
        tails: FloatArray,
        num_near: int,
    ) -> None:
        """Add echoes at angles to port of the axis; only `num_near` ray steps wide."""
        add_echoes(
            power,
            np.where(np.isfinite(ranges), ranges, 0.0),
            strength,
            widths,
            tails,
            self._response,
            offsets_rad - self.bearing_rad[0],
            self._ray_step,
            self._beam_step,
            self._bin_m,
            num_near,
        )

    def _add_walls(
        self,
        power: Float32Array,
        ranges: FloatArray,
        cos_incidence: FloatArray,
        strength: FloatArray,
        reach_m: float,
    ) -> None:
        """Direct echoes. A wall is tall: what lies above and below the axis answers later."""
        config = self.config
        near = np.where(np.isfinite(ranges), ranges, 0.0)
        tangent = np.sqrt(1.0 / np.clip(cos_incidence, 0.05, 1.0) ** 2 - 1.0)
        spread = np.minimum(near * self._ray_step * tangent, 1.5)
        reach = np.minimum(reach_m, near * math.tan(0.5 * config.vertical_width_rad))
        tail = np.hypot(near, reach) - near
        width = spread + config.pulse_length_m
        self._add(power, self._ray_rad, near, strength, width, tail, len(self._response))

    def _add_slanted(
        self,
        power: Float32Array,
        ranges: FloatArray,
        cos_incidence: FloatArray,
        strength: FloatArray,
        elevation_rad: FloatArray,
        limits_m: tuple[float, float],
    ) -> tuple[FloatArray, FloatArray]:
        """Direct echoes of beams that look up or down (K,), as far as a wall is in their height.

        ``ranges`` are horizontal; a wall reaches `limits_m` below and above the sonar. Returns the
        slant ranges to the middle of what is seen of the walls, and its strength.
        """
        config = self.config
        half = _TWO_WAY * config.vertical_width_rad
        near = np.where(np.isfinite(ranges), ranges, 1.0)
        low = np.maximum(elevation_rad - half, -np.arctan2(limits_m[0], near))
        high = np.minimum(elevation_rad + half, np.arctan2(limits_m[1], near))
        is_seen = np.isfinite(ranges) & (high > low)
        nearest = np.where((low < 0.0) & (high > 0.0), 0.0, np.minimum(abs(low), abs(high)))
        first = near / np.cos(nearest)
        last = near / np.cos(np.maximum(abs(low), abs(high)))
        slant = np.where(is_seen, 0.5 * (first + last), np.inf)
        seen = np.where(is_seen, strength * (high - low) / (2.0 * half), 0.0)
        tangent = np.sqrt(1.0 / np.clip(cos_incidence, 0.05, 1.0) ** 2 - 1.0)
        spread = np.minimum(near * self._ray_step * tangent, 1.5)
        width = spread + config.pulse_length_m + (last - first)
        tail = np.zeros(len(near))
        self._add(power, self._ray_rad, slant, seen, width, tail, len(self._response))
        return slant, seen

    def _add_intruder(self, power: Float32Array, intruder: Intruder) -> None:
        """A short flash in all beams that hear its direction, by their side lobes too."""
        flash = np.zeros(power.shape[::-1], dtype=np.float32)
        self._add(
            flash,
            np.array([intruder.bearing_rad]),
            np.array([intruder.range_m]),
            np.array([intruder.power / float(self._response[0])]),
            np.array([2.0 * self.config.pulse_length_m]),
            np.zeros(1),
            len(self._response),
        )
        power += flash.T

    def _add_ghosts(
        self,
        power: Float32Array,
        ranges: FloatArray,
        cos_incidence: FloatArray,
        strength: FloatArray,
        depth_m: float,
        rng: np.random.Generator,
    ) -> None:
        """Echoes by way of the surface, and between a flat wall and the vehicle itself."""
        config = self.config
        bounced = np.hypot(ranges, 2.0 * depth_m)
        # The surface moves: a ghost's strength is another one each ping.
        fading = rng.exponential(size=3)
        one_way, double = power_of_db(config.ghost_db), power_of_db(config.double_bounce_db)
        square_on = np.where(cos_incidence > 0.96, strength, 0.0)
        paths = (
            (0.5 * (ranges + bounced), strength * one_way * fading[0]),
            (bounced, strength * one_way**1.5 * fading[1]),
            (2.0 * ranges, square_on * double * fading[2]),
        )
        width = np.full(len(ranges), 2.0 * config.pulse_length_m)
        for path_m, path_strength in paths:
            tail = np.where(np.isfinite(path_m), 0.02 * path_m, 0.0)
            self._add(power, self._ray_rad, path_m, path_strength, width, tail, self._num_near)

    def _add_clutter(
        self, power: Float32Array, ranges: FloatArray, T_map_sonar: SE2, clutter: Scatterers
    ) -> None:
        """Small things in the water that no wall hides."""
        local = T_map_sonar.inverse().apply(clutter.points)
        distance = self._range_scale * np.hypot(local[:, 0], local[:, 1])
        bearing = np.arctan2(local[:, 1], local[:, 0])
        ray = np.rint((self._ray_rad[0] - bearing) / self._ray_step).astype(np.int64)
        is_inside = (ray >= 0) & (ray < len(ranges)) & (distance < self.config.max_range_m)
        is_seen = is_inside & (distance < ranges[np.clip(ray, 0, len(ranges) - 1)])
        # A point's power does not depend on how many rays are cast: it fills one beam.
        gain = 1.0 / float(self._response[0])
        self._add(
            power,
            bearing[is_seen],
            distance[is_seen],
            gain * clutter.power[is_seen],
            np.full(int(is_seen.sum()), self.config.pulse_length_m),
            np.zeros(int(is_seen.sum())),
            self._num_near,
        )


def _directions(R_level_fan: FloatArray, bearing_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Azimuth and elevation (K,) [rad] in the level frame of bearings in the fan's plane."""
    fan = np.stack([np.cos(bearing_rad), np.sin(bearing_rad), np.zeros(len(bearing_rad))])
    x, y, z = R_level_fan @ fan
    return np.arctan2(y, x), np.arcsin(np.clip(z, -1.0, 1.0))
