"""The objective over all poses of a coarse lattice, by Fourier transforms."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.registration.grids.finding import landscape_kernels
from uw_dslam_ros2.core.registration.grids.problem import GridProblem, PoseWindow
from uw_dslam_ros2.core.registration.grids.signed_field import PAD
from uw_dslam_ros2.core.se2 import wrap_angle
from uw_dslam_ros2.core.suppression import first_apart

__all__ = ["Landscape", "distinct", "scan_landscape"]

FloatArray = NDArray[np.float64]
FloatStack = NDArray[np.float32]
_PEAKS_PER_ROTATION = 4
_PEAK_RADIUS = 3  # cells
_BACKGROUND_STRIDE = 4  # rotations
_STACK_CELLS = 200_000  # some rotations at a time: fewer calls, and a stack that fits the cache


@dataclass(frozen=True, slots=True, eq=False)
class Landscape:
    """Peaks of the objective, best first: ``poses`` (K, 3), ``scores`` (K,).

    ``background_poses`` (L, 3) and ``background_scores`` (L,) are the best of evenly
    spaced rotations over the whole plane, whatever the window: what alignments of these two
    maps reach by accident.
    """

    poses: FloatArray
    scores: FloatArray
    background_poses: FloatArray
    background_scores: FloatArray


def scan_landscape(
    problem: GridProblem, num_peaks: int, window: PoseWindow | None = None
) -> Landscape:
    """Best poses of a window, or of the whole plane of motions, about a cell apart.

    Both directions are correlations for a fixed rotation: the turned source points with the
    target's field, and the target's points with the turned source field; they share one inverse
    transform.
    """
    scan = _Scan(problem)
    num_rotations = max(16, math.ceil(2.0 * math.pi * problem.radius * 1.2 / 1.3))
    peaks, greatest = scan.best(_rotations(num_rotations, window), window)
    if _is_whole(num_rotations, window):
        background = greatest[::_BACKGROUND_STRIDE]
    else:
        _, background = scan.best(
            _rotations(num_rotations, None)[::_BACKGROUND_STRIDE].copy(), None
        )
    peaks = peaks.reshape(-1, 4)
    peaks = peaks[peaks[:, 3] > -np.inf]
    peaks = peaks[np.argsort(peaks[:, 3], kind="stable")[::-1]]
    peaks = peaks[distinct(peaks[:, :3], problem.radius, 3.0, num_peaks)]
    return Landscape(peaks[:, :3].copy(), peaks[:, 3].copy(), background[:, :3], background[:, 3])


def _is_whole(num_rotations: int, window: PoseWindow | None) -> bool:
    return window is None or float(window.half[0]) > math.pi - 2.0 * math.pi / num_rotations


def _rotations(num_rotations: int, window: PoseWindow | None) -> FloatArray:
    """Evenly spaced rotations of a window, its middle among them."""
    step = 2.0 * math.pi / num_rotations
    if window is None or _is_whole(num_rotations, window):
        return np.arange(num_rotations, dtype=np.float64) * step - math.pi
    num_beside = math.ceil(float(window.half[0]) / step)
    steps = np.arange(-num_beside, num_beside + 1) / num_beside
    rotations: FloatArray = window.middle[0] + window.half[0] * steps
    return rotations


def distinct(poses: FloatArray, radius: float, separation_cells: float, limit: int) -> list[int]:
    """Indices of the first poses (K, 3) that are apart from those before, in place or turn."""

    def is_near(k: int) -> NDArray[np.bool_]:
        turn = np.abs(wrap_angle(poses[:, 0] - poses[k, 0]))
        shift = np.hypot(poses[:, 1] - poses[k, 1], poses[:, 2] - poses[k, 2])
        return (turn * radius < separation_cells) & (shift < separation_cells)

    return first_apart(len(poses), is_near, limit)


class _Scan:
    """Transforms that all rotations share."""

    def __init__(self, problem: GridProblem) -> None:
        from scipy import fft  # large, and not every node that starts will search

        self._problem = problem
        rows, cols = (size - 2 * PAD for size in problem.source_field.coefficients.shape)
        # The turned source is drawn about its middle, so any angle fits into this square.
        self._half = math.ceil(0.5 * math.hypot(rows + 1, cols + 1) + 0.5)
        self._middle = 0.5 * np.array([cols - 1, rows - 1]) - problem.center
        field = problem.target_field.coefficients[PAD - 1 : 1 - PAD, PAD - 1 : 1 - PAD]
        sizes = [fft.next_fast_len(size + 2 * self._half, real=True) for size in field.shape]
        self._shape = (sizes[0], sizes[1])
        self._last = np.array(field.shape[::-1], np.int64) - 1
        walls = np.zeros(field.shape, np.float32)
        landscape_kernels.splat(
            walls, problem.target_points, problem.target_weights, 1.0, 0.0, 1.0, 1.0
        )
        self._target_spectra = [fft.rfft2(image, s=self._shape) for image in (field, walls)]
        most = max(1, _STACK_CELLS // (sizes[0] * sizes[1]))
        self._stack = np.zeros((most, 2, *self._shape), np.float32)

    def best(self, thetas: FloatArray, window: PoseWindow | None) -> tuple[FloatArray, FloatArray]:
        """Peaks (K, P, 4) inside a window, and the greatest of all (K, 4), of each rotation (K,).

        Both are [theta, t_x, t_y, score]; -inf is the score of a peak that a window has no room
        for.
        """
        peaks = np.empty((len(thetas), _PEAKS_PER_ROTATION, 3))
        greatest = np.empty((len(thetas), 3))
        limits = np.array([[-np.inf, -np.inf], [np.inf, np.inf]])
        if window is not None:
            reach = window.half[1:] + 1.0
            limits = np.array([window.middle[1:] - reach, window.middle[1:] + reach])
        places = self._places(thetas)
        for first in range(0, len(thetas), len(self._stack)):
            some = slice(first, first + len(self._stack))
            landscape_kernels.find_peaks(
                self._scores(thetas[some], places[some]), 1.0 - places[some], self._last, limits,
                _PEAK_RADIUS, peaks[some], greatest[some],
            )  # fmt: skip
        angles = np.broadcast_to(thetas[:, None, None], (*peaks.shape[:2], 1))
        return (
            np.concatenate([angles, peaks], axis=2),
            np.column_stack([thetas, greatest]),
        )

    def _places(self, thetas: FloatArray) -> FloatArray:
        """Where in the square the source's centre comes to lie (K, 2), in whole cells [x, y]."""
        cos, sin = np.cos(thetas), np.sin(thetas)
        x, y = self._middle
        return self._half - np.rint(np.column_stack([cos * x - sin * y, sin * x + cos * y]))

    def _scores(self, thetas: FloatArray, places: FloatArray) -> FloatStack:
        """Objective (K, R, C) by lag between the square and the target with a rim of one cell."""
        from scipy import fft

        problem = self._problem
        stack = self._stack[: len(thetas)]
        landscape_kernels.draw_turned(
            thetas, places, problem.source_points, problem.source_weights,
            problem.source_field.coefficients, PAD, problem.center, 2 * self._half + 1, stack,
        )  # fmt: skip
        spectra = fft.rfft2(stack)
        landscape_kernels.correlate(spectra, *self._target_spectra)
        scores: FloatStack = fft.irfft2(spectra[:, 0], s=self._shape)
        return scores
