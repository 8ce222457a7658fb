"""How well two maps fix a pose: the curvature of the objective, and what pulls at its maximum.

Errors of walls that lie next to each other are common to them, so the information of a match does
not grow with the number of its cells. How much is common shows in the maps themselves: the pulls
of the walls on the pose, summed over squares, scatter as much as the squares err independently of
each other (the sandwich estimator of a maximum with clustered observations: Huber 1967, White
1982, Liang and Zeger 1986).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.registration.grids.problem import GridProblem
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["PoseSpread", "curvature", "pose_spread"]

FloatArray = NDArray[np.float64]
Seen = tuple[NDArray[np.uint8], NDArray[np.uint8]]
_BLOCK_CELLS = 32.0
_STRAIN_CELLS = 24.0
_LEAST_POINTS = 8  # of a square whose own displacement is looked at
# A bend moves the two maps against each other as a whole, too, which no residual shows. It is
# taken to be the larger, the more the squares are displaced: from `study overlap`, and as much on
# maps that were not simulated.
_UNSEEN_PER_CELL2 = 60.0
_FLOOR_CELLS = 0.03
_SHIFTS = ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5))  # where squares begin is arbitrary
_FIRST_STEP_CELLS = 4.0  # nearer, walls lie on the kernels of those that they lay on
_STEP_FACTOR = math.sqrt(2.0)
_SQUARE_ERROR = 0.05  # of its worth, at least: maps do not agree to the last cell
_LEAST_ERRORS = 0.5  # a pose d away that is as good tells of s = d, not of infinity
_EXCLUDED_ERRORS = 2.0  # standard errors by which the maps must speak against a pose


@dataclass(frozen=True, slots=True, eq=False)
class PoseSpread:
    """How well two maps fix a pose.

    ``covariance`` (3, 3) is of [theta, t_x, t_y] in [rad, cells]. ``weakest_cells`` is the
    standard deviation in the direction that is fixed the least, at the rim for turns.
    """

    covariance: FloatArray
    weakest_cells: float


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


def pose_spread(
    problem: GridProblem, pose: FloatArray, sigma_cells: float, seen: Seen
) -> PoseSpread:
    """Spread of a pose (3,) at a maximum of the objective.

    ``sigma_cells`` is the walls' kernel; ``seen`` (R, C) of source and target, in the problem's
    cells, are zero where a map is unknown.
    """
    scale = np.array([1.0 / problem.radius, 1.0, 1.0])
    pulls, places = problem.point_gradients(pose)
    weights = np.concatenate([problem.source_weights, problem.target_weights])
    is_pulling = np.abs(pulls).sum(axis=1) > 0.0
    # A direction is one of turning about the walls that pull and of moving them: these are common
    # to both maps, so neither is the first.
    about = _About.of(places[is_pulling], pose)
    back = about.jacobian_of_pose()
    hessian = (back / scale[:, None]).T @ curvature(problem, pose) @ (back / scale[:, None])
    values, vectors = np.linalg.eigh(0.5 * (hessian + hessian.T))
    # Along a corridor, or round a bay.
    straight = np.array([0.0, *np.linalg.eigh(hessian[1:, 1:])[1][:, 0]])
    weakest = [
        (direction, _free_deviation(problem, pose, about, direction, places, seen))
        for direction in (straight, vectors[:, 0])
    ]
    pulls, places, weights = pulls[is_pulling] @ back, places[is_pulling], weights[is_pulling]
    # Directions that the maps do not fix at all get the size of the map, not infinity.
    floor = max(float(values.max()), 1e-9) * 1e-5
    inverse = vectors @ np.diag(1.0 / np.maximum(values, floor)) @ vectors.T
    strain = _mean_square_displacement(pulls[:, 1:], places, weights, sigma_cells)
    covariance = inverse @ _scatter(pulls, places) @ inverse
    covariance *= 1.0 + _UNSEEN_PER_CELL2 * strain
    covariance += _FLOOR_CELLS**2 * np.eye(3)
    for direction, free in weakest:
        known = float(direction @ covariance @ direction)
        covariance += max(free**2 - known, 0.0) * np.outer(direction, direction)
    deviation = math.sqrt(float(np.linalg.eigvalsh(covariance)[-1]))
    return PoseSpread(back @ covariance @ back.T, deviation)


@dataclass(frozen=True, slots=True, eq=False)
class _About:
    """Small motions about the middle of the places where two maps pull at each other.

    One is [turn at the rim, x, y] in target cells; ``arm`` (2,) goes from there to where the
    source's centre lies, ``rim`` is the root mean square distance of the places.
    """

    middle: FloatArray
    rim: float
    arm: FloatArray

    @staticmethod
    def of(places: FloatArray, pose: FloatArray) -> _About:
        """About places (N, 2), at a pose (3,)."""
        middle = places.mean(axis=0) if len(places) else pose[1:]
        spread = float(((places - middle) ** 2).sum(axis=1).mean()) if len(places) else 1.0
        return _About(middle, max(math.sqrt(spread), 1.0), pose[1:] - middle)

    def jacobian_of_pose(self) -> FloatArray:
        """Derivative (3, 3) of [theta, t_x, t_y] by a motion."""
        jacobian = np.eye(3)
        jacobian[:, 0] = np.array([1.0, -self.arm[1], self.arm[0]]) / self.rim
        return jacobian

    def moved(self, pose: FloatArray, motion: FloatArray) -> FloatArray:
        """The pose after a motion at constant twist, the same way back as forth."""
        turn = float(motion[0]) / self.rim
        half = 0.5 * turn
        chord = math.sin(half) / half if abs(half) > 1e-9 else 1.0
        shift = SE2(yaw=half).rotation() @ motion[1:] * chord
        arm = SE2(yaw=turn).rotation() @ self.arm
        return np.array([pose[0] + turn, *(self.middle + arm + shift)])


def _free_deviation(
    problem: GridProblem,
    pose: FloatArray,
    about: _About,
    direction: FloatArray,
    places: FloatArray,
    seen: Seen,
) -> float:
    """Standard deviation [cells] in a direction, from how far off the maps exclude a pose.

    The curvature at a maximum says nothing of poses farther off, which along a corridor are nearly
    as good. Of a normal distribution, a pose d away is d / (2 s) standard errors less likely; so s
    is the greatest d / (2 z) short of where z excludes the pose. A wall that only leaves what the
    other map has seen says nothing against it. The error of the loss is that of the squares' sums,
    and as if one more square erred by their mean: few squares may all err.
    """
    weights = np.concatenate([problem.source_weights, problem.target_weights])
    squares = []
    for shift in _SHIFTS:
        index = _squares(places, _BLOCK_CELLS, shift)
        squares.append((index, _SQUARE_ERROR**2 * float((np.bincount(index, weights) ** 2).sum())))
    here = problem.point_values(pose)
    found, step = 0.0, _FIRST_STEP_CELLS
    while step < 2.0 * about.rim:
        errors = math.inf
        for sign in (1.0, -1.0):
            moved = about.moved(pose, sign * step * direction)
            there = problem.point_values(moved)
            lost = np.where(_is_seen(problem, moved, seen), here - there, 0.0)
            errors = min(errors, _standard_errors(lost, squares))
        if errors >= _EXCLUDED_ERRORS:
            return found
        found = max(found, 0.5 * step / max(errors, _LEAST_ERRORS))
        step *= _STEP_FACTOR
    return max(found, about.rim)


def _is_seen(problem: GridProblem, pose: FloatArray, seen: Seen) -> NDArray[np.bool_]:
    """Which points (M + N,), the source's first, lie on what the other map has seen."""
    found = []
    for cells, grid in zip(problem.point_places(pose), (seen[1], seen[0]), strict=True):
        col, row = np.rint(cells).astype(np.int64).T
        inside = (row >= 0) & (col >= 0) & (row < grid.shape[0]) & (col < grid.shape[1])
        inside[inside] = grid[row[inside], col[inside]] > 0
        found.append(inside)
    return np.concatenate(found)


def _standard_errors(values: FloatArray, squares: list[tuple[NDArray[np.intp], float]]) -> float:
    """Sum of values (N,) over its standard error, from the sums over squares of each shift.

    ``squares`` are the number of each value's square (N,) and the least variance of the sum.
    """
    total = float(values.sum())
    variance = 0.0
    for index, least in squares:
        sums = np.bincount(index, weights=values)
        sums = sums[sums != 0.0]
        count = max(len(sums), 1)
        mean = total / count
        variance += least + mean**2 + float(((sums - mean) ** 2).sum()) * count / max(count - 1, 1)
    return total / math.sqrt(variance / len(squares))


def _squares(places: FloatArray, side: float, shift: tuple[float, float]) -> NDArray[np.intp]:
    """Number of the square (N,) that each place [x, y] (N, 2) lies in."""
    square = np.floor(places / side + shift).astype(np.int64)
    square -= square.min(axis=0, initial=0)
    _, index = np.unique(
        square[:, 1] * (square[:, 0].max(initial=0) + 1) + square[:, 0], return_inverse=True
    )
    return index


def _sums(values: FloatArray, index: NDArray[np.intp]) -> FloatArray:
    columns = [np.bincount(index, weights=column) for column in values.T]
    return np.stack(columns, axis=1)


def _scatter(pulls: FloatArray, places: FloatArray) -> FloatArray:
    """Covariance (3, 3) of the sum of all pulls (N, 3), from that of the squares' sums."""
    total = np.zeros((3, 3))
    for shift in _SHIFTS:
        sums = _sums(pulls, _squares(places, _BLOCK_CELLS, shift))
        total += sums.T @ sums * (len(sums) / max(len(sums) - 3, 1))
    return total / len(_SHIFTS)


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
