"""Inner loops of the sonar simulator."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["add_echoes", "add_seabed", "filter_beams"]

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]

_MAX_BINS = 64


@njit(cache=True, nogil=True)
def add_echoes(
    power: Float32Array,
    ranges: FloatArray,
    strength: FloatArray,
    widths: FloatArray,
    tails: FloatArray,
    response: Float32Array,
    offsets_rad: FloatArray,
    ray_step_rad: float,
    beam_step_rad: float,
    bin_m: float,
    num_near: int,
) -> None:
    """Add each echo to every beam that hears it.

    ``power`` (B, R). Echoes (K,) lie `offsets_rad` to port of the first beam; beams lie
    `beam_step_rad` apart, each to starboard of the one before. An echo fills `widths` [m] of range
    evenly and then decays over `tails` [m]. ``response`` (L,) by steps of `ray_step_rad` off a
    beam's axis; beyond `num_near` steps it is left out.
    """
    num_beams, num_ranges = power.shape
    shape = np.empty(_MAX_BINS, dtype=np.float32)
    for k in range(ranges.shape[0]):
        if ranges[k] <= 0.0 or strength[k] <= 0.0:
            continue
        start = ranges[k] / bin_m
        box = widths[k] / bin_m
        tail = tails[k] / bin_m
        first = math.floor(start - 0.5 * box)
        last = math.floor(start + 0.5 * box + 3.0 * tail)
        last = min(last, first + _MAX_BINS - 1, num_ranges - 1)
        level = strength[k] / max(1.0, box)
        for b in range(first, last + 1):
            # The part of the bin inside the box, and the decaying rest behind it.
            low, high = max(float(b), start - 0.5 * box), min(float(b + 1), start + 0.5 * box)
            value = max(0.0, high - low)
            behind = b + 0.5 - (start + 0.5 * box)
            if tail > 0.0 and behind > 0.0:
                value += 0.25 * math.exp(-behind / tail)
            shape[b - first] = level * value
        for beam in range(num_beams):
            steps = int(abs(offsets_rad[k] + beam * beam_step_rad) / ray_step_rad + 0.5)
            if steps >= num_near or steps >= response.shape[0]:
                continue
            gain = response[steps]
            for b in range(max(first, 0), last + 1):
                power[beam, b] += gain * shape[b - first]


@njit(cache=True, nogil=True)
def add_seabed(
    power: Float32Array,
    hit_ranges: FloatArray,
    origin: tuple[float, float],
    beam_yaws: FloatArray,
    first_ray: int,
    rays_per_beam: int,
    level: Float32Array,
    texture: Float32Array,
    texture_origin: tuple[float, float],
    texture_step_m: float,
    bin_m: float,
) -> None:
    """Add the seabed of ``level`` (B, R), as far as a beam's rays are not stopped by a wall."""
    num_beams, num_ranges = power.shape
    num_rows, num_cols = texture.shape
    for beam in range(num_beams):
        cos, sin = math.cos(beam_yaws[beam]), math.sin(beam_yaws[beam])
        begin = first_ray + beam * rays_per_beam
        for b in range(num_ranges):
            if level[beam, b] <= 0.0:
                continue
            r = (b + 0.5) * bin_m
            num_open = 0
            for k in range(begin, begin + rays_per_beam):
                if hit_ranges[k] > r:
                    num_open += 1
            if num_open == 0:
                break
            x = (origin[0] + r * cos - texture_origin[0]) / texture_step_m
            y = (origin[1] + r * sin - texture_origin[1]) / texture_step_m
            col, row = math.floor(x), math.floor(y)
            u, v = x - col, y - row
            # The texture repeats beyond the place.
            row0, row1 = row % num_rows, (row + 1) % num_rows
            col0, col1 = col % num_cols, (col + 1) % num_cols
            value = (1.0 - v) * ((1.0 - u) * texture[row0, col0] + u * texture[row0, col1])
            value += v * ((1.0 - u) * texture[row1, col0] + u * texture[row1, col1])
            power[beam, b] += level[beam, b] * value * num_open / rays_per_beam


@njit(cache=True, nogil=True)
def filter_beams(noise: Float32Array, taps: Float32Array) -> Float32Array:
    """Speckle intensity (R, B) of white normal numbers (2, R, B), smeared over the beams.

    With taps whose squares sum to a half, the mean intensity is 1 (less at the edges' beams,
    which is made up for).
    """
    _, num_ranges, num_beams = noise.shape
    reach = taps.shape[0] // 2
    edge_gain = np.empty(num_beams, dtype=np.float32)
    for beam in range(num_beams):
        total = np.float32(0.0)
        for k in range(max(-reach, -beam), min(reach, num_beams - 1 - beam) + 1):
            total += taps[k + reach] * taps[k + reach]
        edge_gain[beam] = np.float32(0.5) / total
    result = np.empty((num_ranges, num_beams), dtype=np.float32)
    for r in range(num_ranges):
        for beam in range(num_beams):
            real, imaginary = np.float32(0.0), np.float32(0.0)
            for k in range(max(-reach, -beam), min(reach, num_beams - 1 - beam) + 1):
                real += taps[k + reach] * noise[0, r, beam + k]
                imaginary += taps[k + reach] * noise[1, r, beam + k]
            result[r, beam] = (real * real + imaginary * imaginary) * edge_gain[beam]
    return result
