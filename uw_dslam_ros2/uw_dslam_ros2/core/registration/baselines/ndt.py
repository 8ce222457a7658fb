"""The normal distributions transform, from one start."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.registration.baselines.result import BaselineResult, checked_points
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["ndt"]

FloatArray = NDArray[np.float64]
Cells = dict[tuple[int, int, int], tuple[FloatArray, FloatArray]]

_MIN_POINTS = 3
_SHIFTS = ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5))  # of the four overlapping grids


def ndt(
    source: ArrayLike,
    target: ArrayLike,
    *,
    T_initial: SE2 | None = None,
    cell_m: float = 0.5,
    max_iterations: int = 60,
) -> BaselineResult:
    """Normal distributions transform of the target, and damped Newton steps from one start.

    Parameters
    ----------
    source, target : (m, 2) and (n, 2)
        Points [m].
    cell_m : float
        Side of a cell [m], > 0; cells with fewer than three points are left empty.

    Notes
    -----
    Biber and Strasser (2003): four overlapping grids, a normal distribution in each cell, its
    smaller eigenvalue raised to a thousandth of the larger; Newton's method on minus the score.
    The motion is None where no cell holds enough points.
    """
    source, target = checked_points("source", source), checked_points("target", target)
    cells = _cells(target, cell_m)
    if not cells:
        return BaselineResult(None, 0.0, {"num_cells": 0.0})
    pose = (SE2() if T_initial is None else T_initial).as_array()
    score, gradient, hessian = _derivatives(source, pose, cells, cell_m)
    damping, iterations = 1e-3, 0
    while iterations < max_iterations:
        iterations += 1
        # Minus the score is minimised; damping makes its Hessian positive definite.
        lowest = float(np.linalg.eigvalsh(-hessian)[0])
        shift = max(damping, damping - lowest) * np.eye(3)
        step = np.linalg.solve(-hessian + shift, gradient)
        tried = pose + step
        new = _derivatives(source, tried, cells, cell_m)
        if new[0] > score:
            pose, (score, gradient, hessian) = tried, new
            damping = max(damping / 4.0, 1e-6)
            if np.abs(step).max() < 1e-7:
                break
        else:
            damping *= 8.0
            if damping > 1e8:
                break
    diagnostics = {"num_iterations": float(iterations), "num_cells": float(len(cells))}
    return BaselineResult(SE2.from_array(pose), score / len(source), diagnostics)


def _cells(points: FloatArray, cell_m: float) -> Cells:
    """Mean and inverse covariance of each cell of the four grids that holds enough points."""
    cells: Cells = {}
    for grid, shift in enumerate(_SHIFTS):
        keys = np.floor(points / cell_m + shift).astype(np.int64)
        unique, inverse = np.unique(keys, axis=0, return_inverse=True)
        for number, key in enumerate(unique):
            members = points[inverse.reshape(-1) == number]
            if len(members) < _MIN_POINTS:
                continue
            values, vectors = np.linalg.eigh(np.cov(members.T))
            if values[1] <= 0.0:
                continue  # all in one place
            values[0] = max(values[0], 1e-3 * values[1])
            inverse_covariance = vectors @ np.diag(1.0 / values) @ vectors.T
            cells[grid, int(key[0]), int(key[1])] = (members.mean(axis=0), inverse_covariance)
    return cells


def _derivatives(
    source: FloatArray, pose: FloatArray, cells: Cells, cell_m: float
) -> tuple[float, FloatArray, FloatArray]:
    """Score, its gradient (3,) and its Hessian (3, 3) in x, y, yaw."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    x, y = source.T
    moved = np.stack([cos * x - sin * y + pose[0], sin * x + cos * y + pose[1]], axis=1)
    turned = np.stack([-sin * x - cos * y, cos * x - sin * y], axis=1)  # d moved / d yaw
    indices, means, inverses = [], [], []
    for grid, shift in enumerate(_SHIFTS):
        keys = np.floor(moved / cell_m + shift).astype(np.int64).tolist()
        for i, (column, row) in enumerate(keys):
            cell = cells.get((grid, column, row))
            if cell is not None:
                indices.append(i)
                means.append(cell[0])
                inverses.append(cell[1])
    if not indices:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    inverse = np.array(inverses)
    q = moved[indices] - np.array(means)
    jacobian = np.zeros((len(indices), 2, 3))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
    jacobian[:, :, 2] = turned[indices]
    inverse_q = np.einsum("kab,kb->ka", inverse, q)
    values = np.exp(-0.5 * np.einsum("ka,ka->k", q, inverse_q))
    slopes = np.einsum("ka,kai->ki", inverse_q, jacobian)
    gradient = -np.einsum("k,ki->i", values, slopes)
    hessian = np.einsum("k,ki,kj->ij", values, slopes, slopes)
    hessian -= np.einsum("k,kai,kab,kbj->ij", values, jacobian, inverse, jacobian)
    # The second derivative of a moved point by yaw is minus its rotated position.
    rotated = moved[indices] - pose[:2]
    hessian[2, 2] += np.sum(values * np.einsum("ka,ka->k", inverse_q, rotated))
    return float(values.sum()), gradient, hessian
