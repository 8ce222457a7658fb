"""Two maps by their spectra: Fourier-Mellin and Hough spectrum, which need no features."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.registration.baselines.result import BaselineResult
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["fourier_mellin", "hough_spectrum"]

FloatArray = NDArray[np.float64]
ByteGrid = NDArray[np.uint8]

_WALL_PERCENT = 65
_NUM_ANGLES = 360  # of half a turn
_LEAST_COMMON = 0.1  # of the smaller map; in a few cells anything agrees
_BLUR_CELLS = 1.5  # walls of two maps lie on each other to about that
_MOST_CELLS = 1024  # a longer map is looked at in coarser cells


def fourier_mellin(
    source: OccupancyMap, target: OccupancyMap, *, num_rotations: int = 4, min_peak: float = 0.06
) -> BaselineResult:
    """Register the walls of two maps by the magnitudes of their Fourier transforms, then by phase.

    The magnitude does not depend on the shift, so its rings over the angle give the rotation, up
    to half a turn; phase correlation gives the shift of both. Without scale, which maps do not
    have (Reddy and Chatterji 1996). The motion is None below ``min_peak`` of the correlation.
    """
    walls, cell_m = _wall_pictures(source, target)
    size = 2 * cv2.getOptimalDFTSize(max(max(wall.shape) for wall in walls))
    padded = [_padded(wall, size) for wall in walls]
    rings = [_rings(image) for image in padded]
    power = np.conj(np.fft.rfft(rings[0], axis=0)) * np.fft.rfft(rings[1], axis=0)
    overlap = np.fft.irfft(power.sum(axis=1), n=_NUM_ANGLES)
    best = (-1.0, 0.0, (0.0, 0.0))
    blurred = [cv2.GaussianBlur(image, (0, 0), _BLUR_CELLS) for image in padded]
    for yaw in _rotations(overlap, num_rotations):
        shift, peak = cv2.phaseCorrelate(_turned(blurred[0], yaw), blurred[1])
        best = max(best, (float(peak), yaw, shift))
    peak, yaw, (d_col, d_row) = best
    if peak < min_peak:
        return BaselineResult(None, peak)
    return BaselineResult(_motion(source, target, walls, cell_m, yaw, (d_col, d_row)), peak)


def hough_spectrum(
    source: OccupancyMap, target: OccupancyMap, *, num_rotations: int = 4, min_index: float = 0.9
) -> BaselineResult:
    """Register two maps by the directions of their walls, then by their shadows along x and y.

    The spectrum of the Hough transform does not depend on the shift; its best rotations are tried,
    each with the shift that lays the walls' projections on each other (Carpin 2008). The motion
    that is kept has the best acceptance index: the share of cells known to both that agree; it is
    None below ``min_index``.
    """
    walls, cell_m = _wall_pictures(source, target)
    size = 2 * max(max(wall.shape) for wall in walls)
    padded = [_padded(wall, size) for wall in walls]
    spectra = [_hough(image) for image in padded]
    power = np.conj(np.fft.rfft(spectra[0])) * np.fft.rfft(spectra[1])
    overlap = np.fft.irfft(power, n=_NUM_ANGLES)
    best: tuple[float, SE2 | None] = (-1.0, None)
    for yaw in _rotations(overlap, num_rotations):
        turned = _turned(padded[0], yaw)
        d_col, d_row = (_shift(turned.sum(axis=a), padded[1].sum(axis=a)) for a in (0, 1))
        motion = _motion(source, target, walls, cell_m, yaw, (d_col, d_row))
        index = _acceptance_index(source, target, motion)
        if index > best[0]:
            best = index, motion
    index, found = best
    return BaselineResult(found if index >= min_index else None, index)


def _wall_pictures(
    source: OccupancyMap, target: OccupancyMap
) -> tuple[tuple[FloatArray, FloatArray], float]:
    """Walls of both maps as images of one cell size [m], and that size."""
    if source.spec.resolution_m != target.spec.resolution_m:
        raise InvalidInputError(
            f"source has {source.spec.resolution_m} m per cell and target "
            f"{target.spec.resolution_m}, expected equal resolutions"
        )
    longest = max(*source.spec.shape, *target.spec.shape)
    step = -(-longest // _MOST_CELLS)
    images = []
    for occupancy in (source, target):
        cells = np.argwhere(occupancy.values >= _WALL_PERCENT) // step
        # Even sides, so that the image's middle comes to lie on that of an even square.
        rows, cols = (2 * -(-side // (2 * step)) for side in occupancy.spec.shape)
        image = np.zeros((rows, cols))
        image[cells[:, 0], cells[:, 1]] = 1.0
        images.append(image)
    return (images[0], images[1]), step * source.spec.resolution_m


def _rotations(overlap: FloatArray, count: int) -> list[float]:
    """The angles of the highest peaks over half a turn, and half a turn on."""
    is_peak = (overlap >= np.roll(overlap, 1)) & (overlap >= np.roll(overlap, -1))
    peaks = sorted(np.flatnonzero(is_peak).tolist(), key=lambda k: -overlap[k])[:count]
    return [math.pi * (k / _NUM_ANGLES + turns) for k in peaks for turns in (0.0, 1.0)]


def _padded(image: FloatArray, size: int) -> FloatArray:
    """The image in the middle of a square; both have even sides."""
    result = np.zeros((size, size))
    row, col = ((size - side) // 2 for side in image.shape)
    result[row : row + image.shape[0], col : col + image.shape[1]] = image
    return result


def _rings(image: FloatArray) -> FloatArray:
    """Magnitude of the spectrum over half a turn and radius, each ring without its mean."""
    size = len(image)
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    spectrum = np.log1p(np.abs(np.fft.fftshift(np.fft.fft2(smooth))))
    middle = float(size // 2)
    polar = cv2.warpPolar(
        spectrum, (size // 4, 2 * _NUM_ANGLES), (middle, middle), 0.5 * middle, cv2.INTER_LINEAR
    )
    half = polar[:_NUM_ANGLES, 4:]
    centred: FloatArray = half - half.mean(axis=0)
    return centred


def _turned(image: FloatArray, yaw: float) -> FloatArray:
    """An image turned about its middle, from column to row for a positive yaw."""
    middle = 0.5 * (len(image) - 1)
    cos, sin = math.cos(yaw), math.sin(yaw)
    matrix = np.array(
        [
            [cos, -sin, middle - cos * middle + sin * middle],
            [sin, cos, middle - sin * middle - cos * middle],
        ]
    )
    turned: FloatArray = cv2.warpAffine(image, matrix, image.shape[::-1])
    return turned


def _hough(image: FloatArray) -> FloatArray:
    """Sum over distance of the squared Hough transform, by the normal's angle over half a turn."""
    points = np.argwhere(image > 0.0)[:, ::-1] - 0.5 * (len(image) - 1)
    angles = math.pi * np.arange(_NUM_ANGLES) / _NUM_ANGLES
    spectrum = np.empty(_NUM_ANGLES)
    for k, angle in enumerate(angles):
        distance = np.rint(points @ (math.cos(angle), math.sin(angle))).astype(np.int64)
        counts = np.bincount(distance + len(image))
        spectrum[k] = float(counts.astype(np.float64) @ counts)
    return spectrum


def _shift(moved: FloatArray, fixed: FloatArray) -> float:
    """By how many cells a profile has to move to lie best on another one."""
    size = 2 * len(moved)
    power = np.conj(np.fft.rfft(moved, size)) * np.fft.rfft(fixed, size)
    best = int(np.argmax(np.fft.irfft(power, n=size)))
    return float(best if best < len(moved) else best - size)


def _motion(
    source: OccupancyMap,
    target: OccupancyMap,
    walls: tuple[FloatArray, FloatArray],
    cell_m: float,
    yaw: float,
    shift: tuple[float, float],
) -> SE2:
    """``T_target_source`` of a turn about the middle of the padded square and a shift [cells]."""
    middles = [0.5 * np.array(wall.shape[::-1], dtype=np.float64) for wall in walls]
    turn = SE2(yaw=yaw)
    moved = turn.apply(-middles[0]) + middles[1] + np.array(shift)
    T_pixels = SE2(float(cell_m * moved[0]), float(cell_m * moved[1]), yaw)
    return target.spec.T_frame_grid @ T_pixels @ source.spec.T_frame_grid.inverse()


def _acceptance_index(source: OccupancyMap, target: OccupancyMap, T_target_source: SE2) -> float:
    """Share of the cells known to both maps that agree in being wall or not; 0 of too few."""
    cells = np.argwhere(source.known)
    places = target.spec.cells_of(T_target_source.apply(source.spec.centers_of(cells)))
    is_inside = target.spec.contains(places)
    own = source.values[cells[is_inside, 0], cells[is_inside, 1]]
    other = target.values[places[is_inside, 0], places[is_inside, 1]]
    is_both = other >= 0
    least = _LEAST_COMMON * min(source.known.sum(), target.known.sum())
    if is_both.sum() < max(least, 1):
        return 0.0
    agree = (own[is_both] >= _WALL_PERCENT) == (other[is_both] >= _WALL_PERCENT)
    return float(agree.mean())
