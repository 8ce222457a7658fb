"""Where else a submap would fit: agreement of echoes with another submap's walls and water."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.grid import UNITS_PER_NAT
from uw_dslam_ros2.core.mapping.drawing.log_odds_grid import CompressedGrid, LogOddsGrid
from uw_dslam_ros2.core.mapping.scans.matcher import LikelihoodField, Prior, match_points
from uw_dslam_ros2.core.mapping.section import ClosedSection
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.suppression import first_apart

__all__ = ["conflict", "rivals", "without_direction"]

FloatArray = NDArray[np.float64]
_SURELY_FREE_NATS = 0.6
_MEETS = 0.25
_MAX_POINTS = 400
_MAX_PEAKS = 12
# A rival explains at least half as many echoes, and contradicts hardly more of them. The overlap
# itself is no evidence: on periodic piers it is largest wherever the two submaps begin together.
_LEAST_SHARE = 0.5
# A rival that the prior makes twenty times less likely than the pose itself is none.
_LOG_ODDS = 3.0
_SLACK = 0.08
# How far a submap may turn between one fit and the next along the same walls.
_YAW_RAD = 0.03
_ANYWHERE_M2 = 1e8


def conflict(seen: CompressedGrid | LogOddsGrid, points: FloatArray, T_grid_points: SE2) -> float:
    """Share of the points (N, 2) that fall on surely free water of a grid.

    Who asks often unpacks the grid first.
    """
    if len(points) == 0:
        return 0.0
    grid = seen.decompressed() if isinstance(seen, CompressedGrid) else seen
    return float(_on_water(grid, points, T_grid_points).sum()) / len(points)


def rivals(
    target: ClosedSection,
    source: ClosedSection,
    T_target_source: SE2,
    prior: Prior,
    half_width_m: float,
    sigma_m: float,
) -> FloatArray:
    """Offsets (K, 2) [m] to other poses near the prior that explain the source's echoes as well.

    They are sought with the yaw of ``T_target_source``, within `half_width_m` of the prior's mean,
    then matched as that pose itself was; what comes nearer to it than six `sigma_m` is the same.
    How well a pose explains what is in both submaps is the number of echoes that meet echoes,
    over all those where the target has looked.
    """
    stride = max(1, -(-len(source.points) // _MAX_POINTS))
    points = source.points[::stride]
    field = LikelihoodField(target.points, target.weight, sigma_m)
    grid = target.grid.decompressed()
    best_met, best_against = _agreement(field, grid, points, T_target_source)
    least_met = _LEAST_SHARE * best_met
    least_quality = _quality(best_met, best_against) - _SLACK
    limit = _distance(prior, T_target_source) + 2.0 * _LOG_ODDS
    found = []
    for pose in _fits(target, points, T_target_source.yaw, prior, half_width_m, sigma_m):
        is_same = pose.distance_to(T_target_source)[0] <= 6.0 * sigma_m
        if is_same or _distance(prior, pose) > limit:
            continue
        met, against = _agreement(field, grid, points, pose)
        if met >= least_met and _quality(met, against) >= least_quality:
            found.append((pose.x - T_target_source.x, pose.y - T_target_source.y))
    return np.array(found).reshape(-1, 2)


def without_direction(information: FloatArray, offsets: FloatArray) -> FloatArray:
    """Information (3, 3) of a match that fits as well at `offsets` (K, 2) [m] from its pose.

    Nothing is left along the line through them; how far they lie off that line counts as error.
    """
    if len(offsets) == 0:
        return information
    values, vectors = np.linalg.eigh(offsets.T @ offsets)
    along, across = vectors[:, 1], vectors[:, 0]
    spread = np.zeros((3, 3))
    spread[:2, :2] = _ANYWHERE_M2 * np.outer(along, along)
    spread[:2, :2] += values[0] / (len(offsets) + 1) * np.outer(across, across)
    return np.asarray(information @ np.linalg.inv(np.eye(3) + spread @ information))


def _fits(
    target: ClosedSection,
    points: FloatArray,
    yaw_rad: float,
    prior: Prior,
    half_width_m: float,
    sigma_m: float,
) -> list[SE2]:
    """Poses within the window at which points (N, 2) fit the target best, each matched anew."""
    step = 2.0 * sigma_m
    ones = np.ones(len(points))
    coarse = LikelihoodField(target.points, target.weight, step)
    fine = LikelihoodField(target.points, target.weight, sigma_m)
    center = prior.T_target_source.as_array()
    center[2] = yaw_rad
    num = int(np.ceil(half_width_m / step))
    scores = coarse.window(points, ones, center, np.array([num, num, 0]), step, 1.0)[0]
    reach = (step, step, _YAW_RAD)
    fits = []
    for x, y in _peaks(scores, num, step) + center[:2]:
        near = Prior(SE2(float(x), float(y), yaw_rad), np.diag(reach) ** 2)
        fits.append(match_points([fine], points, ones, near, reach, 1.0).T_target_source)
    return fits


def _distance(prior: Prior, pose: SE2) -> float:
    """Squared Mahalanobis distance of a pose's place from the prior's mean."""
    offset = np.array([pose.x - prior.T_target_source.x, pose.y - prior.T_target_source.y])
    return float(offset @ np.linalg.solve(prior.covariance[:2, :2], offset))


def _peaks(scores: FloatArray, num: int, step: float) -> FloatArray:
    """Offsets (K, 2) [x, y] of the best local maxima, best first, apart from each other."""
    rows, cols = np.unravel_index(np.argsort(-scores, axis=None, kind="stable"), scores.shape)
    is_positive = scores[rows, cols] > 0.0
    rows, cols = rows[is_positive], cols[is_positive]
    peaks = first_apart(
        len(rows),
        lambda k: (np.abs(rows - rows[k]) <= 3) & (np.abs(cols - cols[k]) <= 3),
        _MAX_PEAKS,
    )
    return step * np.column_stack([cols[peaks] - num, rows[peaks] - num]).astype(np.float64)


def _quality(met: int, against: int) -> float:
    return met / max(1, met + against)


def _agreement(
    field: LikelihoodField, grid: LogOddsGrid, points: FloatArray, T_grid_points: SE2
) -> tuple[int, int]:
    """How many points meet echoes, and how many of the others are where the target has looked."""
    meets = field.values_at(T_grid_points.apply(points)) > _MEETS
    _, is_seen = _looked_up(grid, points, T_grid_points)
    return int(meets.sum()), int((is_seen & ~meets).sum())


def _on_water(grid: LogOddsGrid, points: FloatArray, T_grid_points: SE2) -> NDArray[np.bool_]:
    log_odds, is_seen = _looked_up(grid, points, T_grid_points)
    return is_seen & (log_odds < -_SURELY_FREE_NATS * UNITS_PER_NAT)


def _looked_up(
    grid: LogOddsGrid, points: FloatArray, T_grid_points: SE2
) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """Log-odds (N,) under the points, and whether their cells were observed (N,)."""
    cells = np.floor(T_grid_points.apply(points) / grid.resolution_m).astype(np.int64)
    rows, cols = cells[:, 1] - grid.row, cells[:, 0] - grid.col
    inside = (rows >= 0) & (cols >= 0)
    inside &= (rows < grid.log_odds.shape[0]) & (cols < grid.log_odds.shape[1])
    log_odds, is_seen = np.zeros(len(points), np.int32), np.zeros(len(points), np.bool_)
    log_odds[inside] = grid.log_odds[rows[inside], cols[inside]]
    is_seen[inside] = grid.observed[rows[inside], cols[inside]]
    return log_odds, is_seen
