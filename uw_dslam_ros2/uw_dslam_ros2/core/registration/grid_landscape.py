"""The objective over all poses of a coarse lattice, by Fourier transforms."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import fft

from uw_dslam_ros2.core.registration.grid_problem import GridProblem, PoseWindow
from uw_dslam_ros2.core.registration.signed_field import PAD

__all__ = ["Landscape", "scan_landscape"]

FloatArray = NDArray[np.float64]
_PEAKS_PER_ROTATION = 4
_PEAK_RADIUS = 3  # cells
_CHANCE_STRIDE = 4  # rotations


@dataclass(frozen=True, slots=True, eq=False)
class Landscape:
    """Peaks of the objective, best first: ``poses`` (K, 3), ``scores`` (K,).

    ``chance_poses`` (L, 3) and ``chance_scores`` (L,) are the best of evenly spaced rotations over
    the whole plane, whatever the window: what alignments of these two maps reach by chance.
    """

    poses: FloatArray
    scores: FloatArray
    chance_poses: FloatArray
    chance_scores: FloatArray


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
    poses, scores = [], []
    chance_poses, chance_scores = [], []
    is_whole = _is_whole(num_rotations, window)
    outside = scan.outside(window) if window is not None else None
    for number, theta in enumerate(_rotations(num_rotations, window)):
        scores_here = scan.scores(theta)
        if is_whole and number % _CHANCE_STRIDE == 0:
            pose, score = _greatest(scan, theta, scores_here)
            chance_poses.append(pose)
            chance_scores.append(score)
        if outside is not None:
            scores_here[outside] = -np.inf
        for row, col, score in _peaks(scores_here):
            if score > -math.inf:
                poses.append((theta, *scan.shift_of(row, col)))
                scores.append(score)
    if not is_whole:
        for theta in _rotations(num_rotations, None)[::_CHANCE_STRIDE]:
            pose, score = _greatest(scan, theta, scan.scores(theta))
            chance_poses.append(pose)
            chance_scores.append(score)
    order = np.argsort(scores, kind="stable")[::-1]
    all_poses, all_scores = np.array(poses).reshape(-1, 3)[order], np.array(scores)[order]
    keep = distinct(all_poses, problem.radius, 3.0, num_peaks)
    return Landscape(
        all_poses[keep], all_scores[keep], np.array(chance_poses), np.array(chance_scores)
    )


def _greatest(
    scan: _Scan, theta: float, scores: NDArray[np.float32]
) -> tuple[tuple[float, int, int], float]:
    row, col = divmod(int(scores.argmax()), scores.shape[1])
    return (theta, *scan.shift_of(row, col)), float(scores[row, col])


def _is_whole(num_rotations: int, window: PoseWindow | None) -> bool:
    return window is None or float(window.half[0]) > math.pi - 2.0 * math.pi / num_rotations


def _rotations(num_rotations: int, window: PoseWindow | None) -> list[float]:
    """Evenly spaced rotations of a window, its middle among them."""
    step = 2.0 * math.pi / num_rotations
    if window is None or _is_whole(num_rotations, window):
        return [float(k * step - math.pi) for k in range(num_rotations)]
    num_beside = math.ceil(float(window.half[0]) / step)
    steps = np.arange(-num_beside, num_beside + 1) / num_beside
    return [float(theta) for theta in window.middle[0] + window.half[0] * steps]


def distinct(poses: FloatArray, radius: float, separation_cells: float, limit: int) -> list[int]:
    """Indices of the first poses (K, 3) that are apart from those before, in place or turn."""
    kept: list[int] = []
    for index, pose in enumerate(poses):
        turn = np.abs((poses[kept, 0] - pose[0] + math.pi) % (2.0 * math.pi) - math.pi)
        apart = np.hypot(poses[kept, 1] - pose[1], poses[kept, 2] - pose[2])
        if not ((turn * radius < separation_cells) & (apart < separation_cells)).any():
            kept.append(index)
            if len(kept) == limit:
                break
    return kept


class _Scan:
    """Transforms that all rotations share."""

    def __init__(self, problem: GridProblem) -> None:
        self._problem = problem
        self._source_field = problem.source_field.coefficients[PAD:-PAD, PAD:-PAD]
        target_field = problem.target_field.coefficients[PAD:-PAD, PAD:-PAD]
        rows, cols = self._source_field.shape
        corners = np.array([[0, 0], [cols, 0], [cols, rows], [0, rows]]) - problem.center
        # The turned source is drawn about its centre, so any angle fits into this square.
        self._half = math.ceil(float(np.hypot(*corners.T).max())) + 2
        self._size = 2 * self._half + 1
        shape = [fft.next_fast_len(size + self._size, real=True) for size in target_field.shape]
        self._shape = (shape[0], shape[1])
        self._target_spectrum = fft.rfft2(self._moved(target_field))
        target = np.zeros(self._shape, np.float32)
        _splat(target, problem.target_points + self._half, problem.target_weights)
        self._target_walls_spectrum = fft.rfft2(target)

    def _moved(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        moved = np.zeros(self._shape, np.float32)
        moved[
            self._half : self._half + image.shape[0], self._half : self._half + image.shape[1]
        ] = image
        return moved

    def shift_of(self, row: int, col: int) -> tuple[int, int]:
        """Translation (t_x, t_y) of an entry of `scores`; lags past the target are negative."""
        num_rows, num_cols = self._shape
        last = self._problem.target_field.coefficients.shape
        is_low_row = row > last[0] - 2 * PAD + self._half
        is_low_col = col > last[1] - 2 * PAD + self._half
        return col - num_cols * is_low_col, row - num_rows * is_low_row

    def outside(self, window: PoseWindow) -> NDArray[np.bool_]:
        """Entries of `scores` whose translations lie outside of a window."""
        shifts = [self.shift_of(k, k) for k in range(max(self._shape))]
        col_shift = np.array([s[0] for s in shifts[: self._shape[1]]])
        row_shift = np.array([s[1] for s in shifts[: self._shape[0]]])
        low = window.middle[1:] - window.half[1:] - 1.0
        high = window.middle[1:] + window.half[1:] + 1.0
        is_col = (col_shift >= low[0]) & (col_shift <= high[0])
        is_row = (row_shift >= low[1]) & (row_shift <= high[1])
        return ~(is_row[:, None] & is_col)

    def scores(self, theta: float) -> NDArray[np.float32]:
        """Objective where the source's centre lies; `shift_of` tells where that is."""
        cos, sin = math.cos(theta), math.sin(theta)
        problem = self._problem
        turned = problem.source_points @ np.array([[cos, sin], [-sin, cos]])
        walls = np.zeros(self._shape, np.float32)
        _splat(walls, turned + self._half, problem.source_weights)
        matrix = np.array(
            [
                [cos, sin, problem.center[0] - self._half * (cos + sin)],
                [-sin, cos, problem.center[1] - self._half * (cos - sin)],
            ]
        )
        field = np.zeros(self._shape, np.float32)
        field[: self._size, : self._size] = cv2.warpAffine(
            self._source_field, matrix, (self._size, self._size),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        )  # fmt: skip
        product = np.conj(fft.rfft2(walls)) * self._target_spectrum
        product += np.conj(fft.rfft2(field)) * self._target_walls_spectrum
        return fft.irfft2(product, s=self._shape)


@njit(cache=True, nogil=True)
def _splat(image: NDArray[np.float32], points: FloatArray, weights: FloatArray) -> None:
    """Add weights to the four cells around each point [x, y] (N, 2), all inside the image."""
    for k in range(points.shape[0]):
        col, row = math.floor(points[k, 0]), math.floor(points[k, 1])
        fx, fy = points[k, 0] - col, points[k, 1] - row
        image[row, col] += weights[k] * (1.0 - fx) * (1.0 - fy)
        image[row, col + 1] += weights[k] * fx * (1.0 - fy)
        image[row + 1, col] += weights[k] * (1.0 - fx) * fy
        image[row + 1, col + 1] += weights[k] * fx * fy


def _peaks(scores: NDArray[np.float32]) -> list[tuple[int, int, float]]:
    """Greatest values and where, each a few cells from the better ones; erases them."""
    image, peaks = scores, []
    for _ in range(_PEAKS_PER_ROTATION):
        row, col = divmod(int(image.argmax()), image.shape[1])
        peaks.append((row, col, float(image[row, col])))
        rows = slice(max(row - _PEAK_RADIUS, 0), row + _PEAK_RADIUS + 1)
        image[rows, max(col - _PEAK_RADIUS, 0) : col + _PEAK_RADIUS + 1] = -np.inf
    return peaks
