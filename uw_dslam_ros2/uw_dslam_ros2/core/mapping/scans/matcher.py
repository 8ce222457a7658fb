"""Matching points against points: correlation over a window, then Newton steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.mapping.scans.match_kernels import (
    derivatives,
    score_poses,
    score_window,
    splat,
)
from uw_dslam_ros2.core.se2 import SE2, wrap_angle

__all__ = ["LikelihoodField", "Prior", "ScanMatch", "match_points", "thin"]

FloatArray = NDArray[np.float64]

_LINE_SUPPORT = 1.5
_MEETS = 0.25
_MAX_CELLS = 4_000_000
_MAX_STEPS = 12
_NUM_STARTS = 8
_START_SHARE = 0.8


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """What is known of ``T_target_source``: mean and covariance (3, 3) in the target frame."""

    T_target_source: SE2
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ScanMatch:
    """Outcome of one match; the caller decides whether to believe it.

    ``information`` (3, 3) comes from the score's curvature alone, without the prior: it is
    (nearly) singular along directions that the points leave free. ``overlap`` is the share of
    source points that meet the target's, ``score`` the mean field value under them, ``lead`` how
    far the best other pose stays behind, as a share.
    """

    T_target_source: SE2
    information: FloatArray
    overlap: float
    score: float
    lead: float


def thin(points: FloatArray, weight: FloatArray, cell_m: float) -> tuple[FloatArray, FloatArray]:
    """Replace the points (N, 2) of a square cell by their weighted mean; weights add up."""
    if len(points) == 0:
        return points, weight
    cells = np.floor(points / cell_m).astype(np.int64)
    cells -= cells.min(axis=0)
    keys = cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]
    _, inverse = np.unique(keys, return_inverse=True)
    total = np.bincount(inverse, weights=weight)
    mean = np.column_stack(
        [np.bincount(inverse, weights=weight * points[:, k]) / total for k in (0, 1)]
    )
    return mean, total


class LikelihoodField:
    """How likely an echo is near known ones: in [0, 1), highest along lines of echoes.

    Kernel density of points thinned to one per sigma: dense clusters count no more than lines,
    single points less.
    """

    def __init__(self, points: FloatArray, weight: FloatArray, sigma_m: float) -> None:
        if len(points) == 0 or not sigma_m > 0.0:
            raise InvalidInputError(
                f"a field needs points and a positive sigma, got {len(points)} and {sigma_m}"
            )
        centers, support = thin(points, weight, sigma_m)
        low = centers.min(axis=0) - 4.0 * sigma_m
        size = centers.max(axis=0) + 4.0 * sigma_m - low
        cell = max(0.5 * sigma_m, float(np.sqrt(size[0] * size[1] / _MAX_CELLS)))
        cols, rows = np.ceil(size / cell).astype(int)
        self.values = np.zeros((rows, cols))
        splat(
            self.values, centers, 1.0 - np.exp(-support), float(low[0]), float(low[1]),
            cell, max(sigma_m, 1.5 * cell), _LINE_SUPPORT,
        )  # fmt: skip
        self.sigma_m = sigma_m
        self.cell_m = cell
        self.origin = (float(low[0]), float(low[1]))

    def scores(self, points: FloatArray, weight: FloatArray, poses: FloatArray) -> FloatArray:
        """Sums of weighted values under points (N, 2) at each pose (K, 3)."""
        return score_poses(self.values, *self.origin, self.cell_m, points, weight, poses)

    def derivatives(
        self, points: FloatArray, weight: FloatArray, pose: FloatArray, steps: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Gradient (3,) and Hessian (3, 3) of the score at a pose, by differences over `steps`."""
        found: tuple[FloatArray, FloatArray] = derivatives(
            self.values, *self.origin, self.cell_m, points, weight, pose, steps
        )
        return found

    def values_at(self, points: FloatArray) -> FloatArray:
        """Values (N,) of the cells that hold points (N, 2); 0 outside."""
        cells = np.floor((points - self.origin) / self.cell_m).astype(np.int64)
        inside = (cells >= 0).all(axis=1) & (cells < np.array(self.values.shape)[::-1]).all(axis=1)
        result = np.zeros(len(points))
        result[inside] = self.values[cells[inside, 1], cells[inside, 0]]
        return result

    def window(
        self,
        points: FloatArray,
        weight: FloatArray,
        center: FloatArray,
        num_steps: NDArray[np.int64],
        step: float,
        yaw_step: float,
    ) -> FloatArray:
        """Scores over a lattice of poses, (yaw, y, x)."""
        return score_window(
            self.values,
            *self.origin,
            self.cell_m,
            points,
            weight,
            center,
            num_steps,
            step,
            yaw_step,
        )


def match_points(
    target: list[LikelihoodField],
    source: FloatArray,
    weight: FloatArray,
    prior: Prior,
    half_width: tuple[float, float, float],
    information_share: float,
) -> ScanMatch:
    """Find ``T_target_source`` near a prior.

    Parameters
    ----------
    target : list of LikelihoodField
        Of the same points, from coarse to fine; the coarsest is searched, the others refine.
    source, weight : (N, 2), (N,)
        Points [m] in the source frame, N > 0.
    prior : Prior
        Guides the search and breaks ties; it is not part of the returned information.
    half_width : (x, y, yaw)
        Search window [m, m, rad] around the prior's mean.
    information_share : float
        Independent information per point.
    """
    total = float(weight.sum())
    weight = weight / total * len(weight)
    scale = np.sqrt(np.mean(np.sum((source - source.mean(axis=0)) ** 2, axis=1))) + 1e-3
    prior_information = np.linalg.inv(prior.covariance)
    mean = prior.T_target_source.as_array()

    starts = _search(
        target[0],
        source,
        weight,
        mean,
        half_width,
        float(scale),
        prior_information,
        information_share,
    )
    candidates = []
    for start in starts:
        pose = start
        for field in target:
            pose = _climb(
                field,
                source,
                weight,
                pose,
                mean,
                prior_information,
                information_share,
                float(scale),
            )
        value = float(target[-1].scores(source, weight, pose[None])[0])
        delta = _difference(pose, mean)
        posterior = information_share * value - 0.5 * float(delta @ prior_information @ delta)
        candidates.append((posterior, value, pose))
    candidates.sort(key=lambda item: -item[0])
    _, value, pose = candidates[0]
    reach = 3.0 * target[-1].sigma_m
    lead = 1.0
    for _, other_value, other in candidates[1:]:
        delta = np.abs(_difference(other, pose))
        if max(delta[0], delta[1], delta[2] * scale) > reach:
            lead = min(lead, (value - other_value) / max(value, 1e-9))
    field = target[-1]
    pose, information = _polish(
        field, source, weight, pose, prior_information, information_share, float(scale)
    )
    T_target_source = SE2.from_array(pose)
    single = field.values_at(T_target_source.apply(source))
    return ScanMatch(
        T_target_source,
        information,
        float(np.mean(single > _MEETS)),
        value / len(source),
        lead,
    )


def _difference(pose: FloatArray, mean: FloatArray) -> FloatArray:
    delta = pose - mean
    delta[2] = wrap_angle(float(delta[2]))
    return delta


def _search(
    field: LikelihoodField,
    source: FloatArray,
    weight: FloatArray,
    mean: FloatArray,
    half_width: tuple[float, float, float],
    scale: float,
    prior_information: FloatArray,
    information_share: float,
) -> list[FloatArray]:
    """The best local maxima of the posterior over the window, at most `_NUM_STARTS`."""
    step = field.sigma_m
    yaw_step = field.sigma_m / max(scale, field.sigma_m)
    num = np.ceil(np.array(half_width) / (step, step, yaw_step)).astype(np.int64)
    scores = field.window(source, weight, mean, num, step, yaw_step)
    dx = np.arange(-num[0], num[0] + 1) * step
    dy = np.arange(-num[1], num[1] + 1) * step
    dt = np.arange(-num[2], num[2] + 1) * yaw_step
    grid = np.stack(
        np.broadcast_arrays(dx[None, None, :], dy[None, :, None], dt[:, None, None]), axis=-1
    )
    spread = np.einsum("...i,ij,...j->...", grid, prior_information, grid)
    posterior = information_share * scores - 0.5 * spread
    starts: list[FloatArray] = []
    flat = posterior.ravel()
    order = np.argpartition(-flat, min(len(flat) - 1, 400))[:400]
    order = order[np.lexsort((order, -flat[order]))]
    # What is far behind already will not come first after a few Newton steps.
    order = order[scores.ravel()[order] >= _START_SHARE * scores.ravel()[order[0]]]
    offsets = grid.reshape(-1, 3)[order]
    lattice = np.array([step, step, yaw_step])
    for offset in offsets:
        pose = mean + offset
        if all((np.abs((pose - other) / lattice) > 2.01).any() for other in starts):
            starts.append(pose)
            if len(starts) == _NUM_STARTS:
                break
    return starts


def _polish(
    field: LikelihoodField,
    source: FloatArray,
    weight: FloatArray,
    pose: FloatArray,
    prior_information: FloatArray,
    share: float,
    scale: float,
) -> tuple[FloatArray, FloatArray]:
    """From the posterior's peak to the likelihood's, along directions that the points know.

    Whoever fuses the match with the prior would count the prior twice otherwise. A direction is
    known where the points say more than the prior; the information (3, 3) of others is zero. The
    derivatives are smooth over a sigma: interpolation between cells has its peaks at cells.
    """
    size = np.array([1.0, 1.0, scale])
    units, steps = np.outer(size, size), field.sigma_m / size
    start = pose
    known = np.zeros((3, 3))
    for _ in range(4):
        gradient, hessian = field.derivatives(source, weight, pose, steps)
        values, vectors = np.linalg.eigh(-share * hessian / units)
        prior_values = np.einsum("ik,ij,jk->k", vectors, prior_information / units, vectors)
        chosen = values > np.maximum(prior_values, 1e-9)
        basis = vectors[:, chosen]
        known = (basis * values[chosen]) @ basis.T * units
        step = basis @ ((basis.T @ (share * gradient / size)) / values[chosen]) / size
        if np.abs((pose + step - start) * size).max() > 2.0 * field.sigma_m:
            break
        pose = pose + step
    return pose, known


def _climb(
    field: LikelihoodField,
    source: FloatArray,
    weight: FloatArray,
    pose: FloatArray,
    mean: FloatArray,
    prior_information: FloatArray,
    share: float,
    scale: float,
) -> FloatArray:
    """Damped Newton ascent of share * score + log prior."""
    damping = 1e-3
    size = np.array([1.0, 1.0, scale])
    units, steps = np.outer(size, size), 0.5 * field.sigma_m / size
    best = share * float(field.scores(source, weight, pose[None])[0])
    delta = _difference(pose, mean)
    best -= 0.5 * float(delta @ prior_information @ delta)
    for _ in range(_MAX_STEPS):
        gradient, hessian = field.derivatives(source, weight, pose, steps)
        values, vectors = np.linalg.eigh(-share * hessian / units)
        curvature = (vectors * np.abs(values)) @ vectors.T * units + prior_information
        damped, diagonal = curvature.copy(), np.diag(curvature)
        slope = share * gradient - prior_information @ _difference(pose, mean)
        moved = False
        for _ in range(5):
            np.fill_diagonal(damped, diagonal + damping * diagonal)
            step = np.linalg.solve(damped, slope)
            trial = pose + step
            delta = _difference(trial, mean)
            value = share * float(field.scores(source, weight, trial[None])[0])
            value -= 0.5 * float(delta @ prior_information @ delta)
            if value > best:
                pose, best, damping, moved = trial, value, max(damping * 0.3, 1e-6), True
                break
            damping = min(damping * 10.0, 1e6)
        if not moved or np.abs(step * size).max() < 1e-3 * field.sigma_m:
            break
    return pose
