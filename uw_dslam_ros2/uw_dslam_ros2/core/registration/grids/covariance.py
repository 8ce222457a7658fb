"""How well two maps fix a pose: the curvature of the objective, and what pulls at its maximum.

Errors of walls that lie next to each other are common to them, so the information of a match does
not grow with the number of its cells. How much is common shows in the maps themselves: the pulls
of the walls on the pose, summed over squares, scatter as much as the squares err independently of
each other (the sandwich estimator of a maximum with clustered observations: Huber 1967, White
1982, Liang and Zeger 1986).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.registration.grids.problem import GridProblem

__all__ = ["curvature", "pose_covariance", "slide_share"]

FloatArray = NDArray[np.float64]
_BLOCK_CELLS = 32.0
_STRAIN_CELLS = 24.0
_LEAST_POINTS = 8  # of a square whose own displacement is looked at
# A bend moves the two maps against each other as a whole, too, which no residual shows. It is
# taken to be the larger, the more the squares are displaced: from `study overlap`, and as much on
# maps that were not simulated.
_UNSEEN_PER_CELL2 = 60.0
_FLOOR_CELLS = 0.03
_FREE_SLIDE_SHARE = 0.85  # as good as free: the pose may be anywhere along the map


def curvature(problem: GridProblem, pose: FloatArray) -> FloatArray:
    """Negative Hessian (3, 3) of the objective, theta in cells at the rim."""
    scale = np.array([1.0 / problem.radius, 1.0, 1.0])
    step = 0.25
    hessian = np.empty((3, 3))
    for axis in range(3):
        offset = np.zeros(3)
        offset[axis] = step
        ahead = problem.gradient(pose + offset * scale)
        behind = problem.gradient(pose - offset * scale)
        hessian[axis] = (ahead - behind) * scale / (2.0 * step)
    return -0.5 * (hessian + hessian.T)


def slide_share(problem: GridProblem, pose: FloatArray, distance_cells: float) -> float:
    """Objective some cells away in the least curved direction, as a share of that at the pose.

    Near 1 where the walls leave a direction free, as a straight wall does.
    """
    _, vectors = np.linalg.eigh(curvature(problem, pose))
    step = distance_cells * vectors[:, 0] * (1.0 / problem.radius, 1.0, 1.0)
    best = max(problem.value(pose), 1e-9)
    return max(problem.value(pose + step), problem.value(pose - step), 0.0) / best


def pose_covariance(
    problem: GridProblem, pose: FloatArray, sigma_cells: float, slide: float
) -> FloatArray:
    """Covariance (3, 3) of [theta, t_x, t_y] in [rad, cells] at a maximum of the objective.

    ``sigma_cells`` is the kernel of the walls, ``slide`` the `slide_share` of the pose.
    """
    scale = np.array([1.0 / problem.radius, 1.0, 1.0])
    pulls, places = problem.point_gradients(pose)
    weights = np.concatenate([problem.source_weights, problem.target_weights])
    is_pulling = np.abs(pulls).sum(axis=1) > 0.0
    pulls, places, weights = pulls[is_pulling] * scale, places[is_pulling], weights[is_pulling]
    values, vectors = np.linalg.eigh(curvature(problem, pose))
    # Directions that the maps do not fix at all get the size of the map, not infinity.
    floor = max(float(values.max()), 1e-9) * 1e-5
    inverse = vectors @ np.diag(1.0 / np.maximum(values, floor)) @ vectors.T
    strain = _mean_square_displacement(pulls[:, 1:], places, weights, sigma_cells)
    covariance = inverse @ _scatter(pulls, places) @ inverse
    covariance *= 1.0 + _UNSEEN_PER_CELL2 * strain
    covariance += _FLOOR_CELLS**2 * np.eye(3)
    if slide > _FREE_SLIDE_SHARE:
        covariance += problem.radius**2 * np.outer(vectors[:, 0], vectors[:, 0])
    return np.diag(scale) @ covariance @ np.diag(scale)


def _squares(places: FloatArray, side: float, shift: tuple[float, float]) -> NDArray[np.intp]:
    """Number of the square (N,) that each place [x, y] (N, 2) lies in."""
    _, index = np.unique(np.floor(places / side + shift), axis=0, return_inverse=True)
    return index.ravel()


def _sums(values: FloatArray, index: NDArray[np.intp]) -> FloatArray:
    columns = [np.bincount(index, weights=column) for column in values.T]
    return np.stack(columns, axis=1)


def _scatter(pulls: FloatArray, places: FloatArray) -> FloatArray:
    """Covariance (3, 3) of the sum of all pulls (N, 3), from that of the squares' sums."""
    total = np.zeros((3, 3))
    shifts = ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5))  # where squares begin is arbitrary
    for shift in shifts:
        sums = _sums(pulls, _squares(places, _BLOCK_CELLS, shift))
        total += sums.T @ sums * (len(sums) / max(len(sums) - 3, 1))
    return total / len(shifts)


def _mean_square_displacement(
    pulls: FloatArray, places: FloatArray, weights: FloatArray, sigma_cells: float
) -> float:
    """By how much squares of walls are displaced against the pose [cells^2], a weighted mean.

    The objective is a sum of exp(-d^2 / 2 s^2), which pulls by d / s^2 where d is small.
    """
    total = weight = 0.0
    for shift in ((0.0, 0.0), (0.5, 0.5)):
        index = _squares(places, _STRAIN_CELLS, shift)
        shares = np.bincount(index, weights=weights)
        square = (_sums(pulls, index) ** 2).sum(axis=1) * sigma_cells**4
        is_enough = np.bincount(index) >= _LEAST_POINTS
        total += float((square[is_enough] / shares[is_enough]).sum())
        weight += float(shares[is_enough].sum())
    return total / max(weight, 1e-9)
