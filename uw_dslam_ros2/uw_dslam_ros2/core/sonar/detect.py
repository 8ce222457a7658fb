"""From a sonar's image, scan or points to detections."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.sonar.cfar import cell_averaging_factors, smallest_of_factor
from uw_dslam_ros2.core.sonar.config import SonarConfig
from uw_dslam_ros2.core.sonar.kernels import (
    cfar_ratio,
    neighbor_counts,
    row_ratio,
    select_returns,
    to_power,
)
from uw_dslam_ros2.core.sonar.silence import silent_beams
from uw_dslam_ros2.core.sonar.types import Detections, SonarImage

__all__ = [
    "BeamEchoes",
    "beam_spacing",
    "checked_points",
    "detect",
    "detections_from_points",
    "detections_from_scan",
    "has_neighbors",
    "image_echoes",
    "polar",
    "scan_echoes",
    "spacing_of_turn",
]

FloatArray = NDArray[np.float64]
_MODES = {"first": 0, "strongest": 1, "all": 2}
_MIN_WEIGHT = 0.1
_NO_ECHO_FREE_SHARE = 0.5
"""A beam that met nothing is free water only up to this share of its range: beyond, a weak
reflector may have been missed.
"""

_WIDE_FAN_RAD, _RING_SHARE = (1.5, 4.0), 0.6
"""Of so wide a fan no wall fills so many beams at one range: that is the sea bed's or the
surface's first echo, or another sonar's ping. A turn may be of a round basin."""
_MAX_CUT_SHARE, _MIN_CUT_LEVEL = 0.03, 0.02
"""Of an image that its driver cut off at a threshold few pixels are left, none of which is dark:
in power a fiftieth of the brightest."""
_CUT_RATIO = 4.0
_POINT_SPACING_RAD = 0.02
_MIN_TURN_POINTS, _MAX_TURN_GAP_RAD, _TURN_SPACING_RAD = 30, 0.5 * np.pi, (0.01, 0.1)


def detect(image: SonarImage, config: SonarConfig = SonarConfig()) -> Detections:  # noqa: B008 (frozen)
    """Find the echoes of one ping.

    Threshold segmentation, then distance-constrained filtering, after Cheng et al. 2022 (Front.
    Neurorobot. 15:801956).

    Parameters
    ----------
    image : SonarImage
        Any integer or real type, any bearings, any range bins.
    config : SonarConfig
        The stages.

    Raises
    ------
    InvalidInputError
        Ranges that do not rise, bearings or intensities that are not finite.
    """
    return _unmoved(image.stamp_ns, image.bearing_rad, image_echoes(image, config), config)


def detections_from_scan(
    stamp_ns: int,
    angles_rad: ArrayLike,
    ranges_m: ArrayLike,
    range_max_m: float,
    config: SonarConfig = SonarConfig(),  # noqa: B008 (frozen)
) -> Detections:
    """Detections of a scan: angles (B,) and ranges (B,) in the sonar's frame.

    A range that is not finite, or not within the range gate and `range_max_m`, is no echo.
    Infinity says that the beam met nothing, so the water is free for half of
    `range_max_m`; NaN says nothing.
    """
    return _unmoved(
        stamp_ns, angles_rad, scan_echoes(angles_rad, ranges_m, range_max_m, config), config
    )


def detections_from_points(
    stamp_ns: int,
    points: ArrayLike,
    config: SonarConfig = SonarConfig(),  # noqa: B008 (frozen)
    turn_spacing_rad: float = 0.0,
) -> Detections:
    """Detections that somebody else has made, (N, 2) [m] in the sonar's frame (x forward, y left).

    Which beams met nothing is not known, so the water counts as free only before the nearest point
    of a bearing. Points all round are a turn of a sonar with a single beam: they lie as far from
    one another as its beams, and come out in their order, not filtered by neighbours. Of a sonar
    that is known to turn (`Clouds`), so do few points, of beams ``turn_spacing_rad`` apart.
    """
    xy = checked_points(points)
    ranges = np.hypot(xy[:, 0], xy[:, 1])
    inside = (ranges >= config.min_range_m) & (ranges < config.max_range_m)
    xy, ranges = xy[inside], ranges[inside]
    own_spacing_rad = spacing_of_turn(xy)
    spacing_rad = own_spacing_rad or turn_spacing_rad
    if spacing_rad > 0.0:
        order = np.argsort(np.arctan2(xy[:, 1], xy[:, 0]), kind="stable")
        xy, ranges = xy[order], ranges[order]
    width = config.beamwidth_rad or spacing_rad or _POINT_SPACING_RAD
    keep = np.ones(len(xy), np.bool_)
    if spacing_rad == 0.0:
        keep = has_neighbors(xy, width, config)
    beams = np.floor(np.arctan2(xy[:, 1], xy[:, 0]) / width).astype(np.int64)
    unique, inverse = np.unique(beams, return_inverse=True)
    nearest = np.full(len(unique), np.inf)
    np.minimum.at(nearest, inverse, ranges)
    if turn_spacing_rad > 0.0 and own_spacing_rad == 0.0:
        # The beams without an echo were there, too; how far they saw is not known.
        around = np.arange(math.floor(-np.pi / width), math.floor(np.pi / width) + 1)
        free = np.zeros(len(around))
        free[np.searchsorted(around, unique)] = nearest
        unique, nearest = around, free
    return Detections(
        stamp_ns,
        xy[keep],
        np.ones(int(keep.sum())),
        np.asarray((unique + 0.5) * width, np.float64),
        nearest,
        width,
        config.range_sigma_m,
    )


def checked_points(points: ArrayLike) -> FloatArray:
    """Points (N, 2); `InvalidInputError` for other shapes, and for coordinates not finite."""
    xy = np.asarray(points, dtype=np.float64)
    if xy.ndim != 2 or xy.shape[1] != 2:
        raise InvalidInputError(f"points have shape {xy.shape}, expected (N, 2)")
    if not np.isfinite(xy).all():
        raise InvalidInputError("points hold coordinates that are not finite")
    return xy


def spacing_of_turn(points: FloatArray) -> float:
    """How far points (N, 2) all round lie apart in bearing [rad]; 0: they are not all round."""
    if len(points) < _MIN_TURN_POINTS:
        return 0.0
    bearing = np.sort(np.arctan2(points[:, 1], points[:, 0]))
    gaps = np.diff(bearing, append=bearing[0] + 2.0 * np.pi)
    if gaps.max() > _MAX_TURN_GAP_RAD:
        return 0.0
    return float(np.clip(np.median(gaps), *_TURN_SPACING_RAD))


@dataclass(frozen=True, slots=True, eq=False)
class BeamEchoes:
    """Echoes before any filter that looks beyond one beam, and what each beam says of the water.

    ``beam`` (N,) of each echo, ``range_m`` (N,), ``weight`` (N,) in (0, 1]; ``free_range_m`` (B,).
    """

    beam: NDArray[np.int64]
    range_m: FloatArray
    weight: FloatArray
    free_range_m: FloatArray
    range_sigma_m: float


def image_echoes(image: SonarImage, config: SonarConfig) -> BeamEchoes:
    """Echoes along each beam of an image; raises as `detect` does."""
    range_m, bearing_rad = _checked_axes(image)
    first, last = np.searchsorted(range_m, [config.min_range_m, config.max_range_m], side="left")
    bin_m = float(np.median(np.diff(range_m))) if len(range_m) > 1 else 0.0
    range_sigma_m = float(np.hypot(config.range_sigma_m, bin_m / np.sqrt(12.0)))
    if last <= first:
        nothing = np.empty(0)
        return BeamEchoes(
            np.empty(0, np.int64), nothing, nothing, np.zeros(len(bearing_rad)), range_sigma_m
        )
    intensity = image.intensity
    if config.intensity == "decibel":
        intensity = _of_decibels(intensity, config.db_per_count)
    is_amplitude = config.intensity != "power"
    power = to_power(np.ascontiguousarray(intensity), is_amplitude, first, last)
    if not np.isfinite(power[:, :].sum(dtype=np.float64)):
        raise InvalidInputError("intensity holds values that are not finite")
    ratio = _threshold_ratio(power, _full_scale(intensity.dtype), config)
    if _is_cut_off(power):
        ratio[power > 0.0] = np.maximum(ratio[power > 0.0], _CUT_RATIO)
    if _WIDE_FAN_RAD[0] < np.ptp(bearing_rad) < _WIDE_FAN_RAD[1]:
        ratio[(ratio > 1.0).mean(axis=1) > _RING_SHARE] = 0.0
    gap_bins = config.min_separation_m / bin_m if bin_m > 0.0 else 1.0
    beams, bins, strengths, first_above = select_returns(
        power, ratio, _MODES[config.returns], gap_bins
    )
    # What a later filter throws away was an echo of something: the water behind stays unknown.
    free_range_m = np.where(
        first_above >= 0,
        range_m[first + np.maximum(first_above, 0)] - 0.5 * bin_m,
        _NO_ECHO_FREE_SHARE * range_m[last - 1],
    )
    free_range_m[silent_beams(power)] = 0.0
    return BeamEchoes(
        beams,
        np.interp(first + bins, np.arange(len(range_m)), range_m),
        np.clip(1.0 - 1.0 / strengths, _MIN_WEIGHT, 1.0),
        np.maximum(free_range_m, 0.0),
        range_sigma_m,
    )


def _is_cut_off(power: NDArray[np.float32]) -> bool:
    """Whether a driver's threshold left nothing but echoes, so that no noise is there to judge by.

    Power is (R, B).
    """
    num_left = int(np.count_nonzero(power))
    if not 0 < num_left <= _MAX_CUT_SHARE * power.size:
        return False
    return bool(power[power > 0.0].min() >= _MIN_CUT_LEVEL * power.max())


def scan_echoes(
    angles_rad: ArrayLike, ranges_m: ArrayLike, range_max_m: ArrayLike, config: SonarConfig
) -> BeamEchoes:
    """Echoes of beams with one range each; ``range_max_m`` is a number or one of each beam (B,).

    Raises as `detections_from_scan` does.
    """
    bearing = np.asarray(angles_rad, dtype=np.float64)
    ranges = np.asarray(ranges_m, dtype=np.float64)
    range_max = np.asarray(range_max_m, dtype=np.float64)
    if bearing.ndim != 1 or bearing.shape != ranges.shape or len(bearing) == 0:
        raise InvalidInputError(
            f"angles have shape {bearing.shape} and ranges {ranges.shape}, expected the same (B "
            f"> 0,)"
        )
    if not np.isfinite(bearing).all():
        raise InvalidInputError("angles hold values that are not finite")
    if not (np.isfinite(range_max) & (range_max > 0.0)).all():
        raise InvalidInputError(f"range_max_m is {range_max}, expected a positive number")
    limit = np.broadcast_to(np.minimum(range_max, config.max_range_m), ranges.shape)
    is_echo = np.isfinite(ranges) & (ranges >= config.min_range_m) & (ranges < limit)
    free = np.zeros(len(bearing))
    free[is_echo] = ranges[is_echo]
    met_nothing = (ranges >= limit) & ~np.isnan(ranges)
    free[met_nothing] = _NO_ECHO_FREE_SHARE * limit[met_nothing]
    beam = np.flatnonzero(is_echo)
    return BeamEchoes(beam, ranges[beam], np.ones(len(beam)), free, config.range_sigma_m)


def _unmoved(
    stamp_ns: int, bearing_rad: ArrayLike, echoes: BeamEchoes, config: SonarConfig
) -> Detections:
    """Detections of beams that were all heard at one place."""
    bearing = np.asarray(bearing_rad, dtype=np.float64)
    beamwidth_rad = beam_spacing(bearing, config)
    points = polar(echoes.range_m, bearing[echoes.beam])
    keep = has_neighbors(points, beamwidth_rad, config)
    return Detections(
        stamp_ns,
        points[keep],
        echoes.weight[keep],
        bearing,
        echoes.free_range_m,
        beamwidth_rad,
        echoes.range_sigma_m,
    )


def has_neighbors(
    points: FloatArray,
    beamwidth_rad: float,
    config: SonarConfig,
) -> NDArray[np.bool_]:
    """Distance-constrained filter: which points (N, 2) have `min_neighbors` others near them.

    Beams spread, so the reach grows by the distance between two neighbouring beams at the point's
    range from the frame's zero.
    """
    if config.neighbor_distance_m <= 0.0 or len(points) == 0:
        return np.ones(len(points), np.bool_)
    range_m = np.hypot(points[:, 0], points[:, 1])
    reach = config.neighbor_distance_m + beamwidth_rad * range_m
    order = np.argsort(points[:, 0], kind="stable")
    counts = np.empty(len(points), np.int64)
    counts[order] = neighbor_counts(points[order], reach[order])
    return counts >= config.min_neighbors


def _checked_axes(image: SonarImage) -> tuple[FloatArray, FloatArray]:
    range_m = np.asarray(image.range_m, dtype=np.float64)
    bearing_rad = np.asarray(image.bearing_rad, dtype=np.float64)
    if not np.isfinite(range_m).all() or (np.diff(range_m) <= 0.0).any() or range_m[0] < 0.0:
        raise InvalidInputError("range_m must be finite, not negative, and rise from bin to bin")
    if not np.isfinite(bearing_rad).all():
        raise InvalidInputError("bearing_rad holds values that are not finite")
    if image.intensity.dtype.kind not in "uif":
        raise InvalidInputError(
            f"intensity has type {image.intensity.dtype}, expected integers or reals"
        )
    return range_m, bearing_rad


def beam_spacing(bearing_rad: FloatArray, config: SonarConfig) -> float:
    """Width of a beam [rad], as set or as wide as the beams (B,) lie apart."""
    if config.beamwidth_rad > 0.0 or len(bearing_rad) < 2:
        return config.beamwidth_rad or 0.02
    steps = np.abs(np.diff(bearing_rad))
    return float(np.median(np.minimum(steps, np.abs(2.0 * np.pi - steps))))


def _full_scale(dtype: np.dtype[np.generic]) -> float:
    # All bits but the sign, which unsigned types do not have.
    bits = 8 * dtype.itemsize - (dtype.kind == "i")
    return float(2**bits - 1) if dtype.kind in "ui" else 1.0


def _of_decibels(pixels: NDArray[np.generic], db_per_count: float) -> NDArray[np.float32]:
    """Amplitudes, of full scale 1; reals have their full scale at 0 dB."""
    top = _full_scale(pixels.dtype) if pixels.dtype.kind in "ui" else 0.0
    if pixels.dtype.kind == "u" and pixels.dtype.itemsize <= 2:
        counts = np.arange(top + 1.0)
        table = np.asarray(10.0 ** ((counts - top) * db_per_count / 20.0), np.float32)
        return table[pixels.astype(np.intp)]
    values = np.asarray(pixels, np.float32)
    return np.asarray(10.0 ** ((values - top) * np.float32(db_per_count / 20.0)), np.float32)


def _threshold_ratio(
    power: NDArray[np.float32], full_scale: float, config: SonarConfig
) -> NDArray[np.float32]:
    exponent = 1 if config.intensity == "power" else 2
    floor = (config.min_threshold * full_scale) ** exponent
    if config.segmentation == "fixed":
        threshold = max((config.fixed_threshold * full_scale) ** exponent, 1e-30)
        return np.asarray(power / np.float32(threshold), np.float32)
    if config.segmentation == "adaptive":
        return row_ratio(power, config.adaptive_factor, floor)
    num_train, rate = config.num_train_cells, config.false_alarm_rate
    so_factor = smallest_of_factor(num_train, rate) if config.segmentation == "cfar_soca" else 0.0
    factors = cell_averaging_factors(2 * num_train, rate)
    return cfar_ratio(power, num_train, config.num_guard_cells, factors, so_factor, floor)


def polar(range_m: FloatArray, bearing_rad: FloatArray) -> FloatArray:
    """Points (N, 2)."""
    return np.column_stack([range_m * np.cos(bearing_rad), range_m * np.sin(bearing_rad)])
