"""Pairs of point sets with a known motion between them: the paper's protocol, and beyond."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["PointSetProblem", "outlier_problem", "overlap_problem", "unrelated_problem"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class PointSetProblem:
    """Two point sets and the truth.

    ``T_target_source`` moves ``source[source_index]`` onto ``target[target_index]``.

    ``noise_m`` is the standard deviation [m] of each coordinate's noise. Points without a
    counterpart are in neither index. Where nothing matches, both indices are empty and
    ``T_target_source`` is only the frame the target was drawn in.
    """

    source: FloatArray  # (m, 2) [m]
    target: FloatArray  # (n, 2) [m]
    T_target_source: SE2
    source_index: NDArray[np.intp]  # (k,)
    target_index: NDArray[np.intp]  # (k,)
    noise_m: float


def outlier_problem(
    num_points: int, outlier_share: float = 0.0, noise_m: float = 0.0, *, seed: int
) -> PointSetProblem:
    """Draw the paper's protocol (section 4.1.2): the target is the source moved, and outliers.

    Parameters
    ----------
    num_points : int
        m, drawn uniformly in [-1, 1]^2; rotation uniform in [-pi, pi], translation in [-1, 1]^2.
    outlier_share : float
        Share of the *target* that is clutter, in [0, 1): n = m / (1 - share), so 0.9 sets 100
        against 1000. Clutter is uniform over the same square, moved as the source is, so that no
        outline gives the motion away.
    noise_m : float
        Standard deviation [m] of Gaussian noise on every coordinate of the target; 0.05 is the
        paper's 5 %.
    seed : int
        The same seed gives the same problem.
    """
    _check(num_points, outlier_share, noise_m)
    if not outlier_share < 1.0:
        raise InvalidInputError(f"outlier_share is {outlier_share}, expected 0 <= share < 1")
    rng = np.random.default_rng(seed)
    source = rng.uniform(-1.0, 1.0, (num_points, 2))
    num_outliers = round(num_points * outlier_share / (1.0 - outlier_share))
    clutter = rng.uniform(-1.0, 1.0, (num_outliers, 2))
    return _finished(source, np.arange(num_points), clutter, noise_m, rng)


def overlap_problem(
    num_points: int, common_share: float, noise_m: float = 0.0, *, seed: int
) -> PointSetProblem:
    """Partial overlap: m = n, and only a share of each set is in the other.

    `common_share` in [0, 1] is that share; the rest of both sets is drawn anew in the same square.
    Other parameters as in `outlier_problem`.
    """
    _check(num_points, common_share, noise_m)
    rng = np.random.default_rng(seed)
    source = rng.uniform(-1.0, 1.0, (num_points, 2))
    common = rng.permutation(num_points)[: round(num_points * common_share)]
    own = rng.uniform(-1.0, 1.0, (num_points - len(common), 2))
    return _finished(source, common, own, noise_m, rng)


def unrelated_problem(num_source: int, num_target: int, *, seed: int) -> PointSetProblem:
    """Two sets with nothing in common: the right answer is a refusal."""
    _check(num_source, 0.0, 0.0)
    _check(num_target, 0.0, 0.0)
    rng = np.random.default_rng(seed)
    source = rng.uniform(-1.0, 1.0, (num_source, 2))
    other = rng.uniform(-1.0, 1.0, (num_target, 2))
    return _finished(source, np.arange(0), other, 0.0, rng)


def _finished(
    source: FloatArray,
    common: NDArray[np.intp],
    clutter: FloatArray,
    noise_m: float,
    rng: np.random.Generator,
) -> PointSetProblem:
    """Move the common points and the clutter, add noise, shuffle the target."""
    x, y = rng.uniform(-1.0, 1.0, 2)
    T_target_source = SE2(float(x), float(y), float(rng.uniform(-math.pi, math.pi)))
    target = T_target_source.apply(np.vstack([source[common], clutter]))
    target += noise_m * rng.standard_normal(target.shape)
    order = rng.permutation(len(target))
    place = np.argsort(order)  # where each point went
    return PointSetProblem(
        source, target[order], T_target_source, common, place[: len(common)], noise_m
    )


def _check(num_points: int, share: float, noise_m: float) -> None:
    if num_points < 1:
        raise InvalidInputError(f"the number of points is {num_points}, expected at least 1")
    if not 0.0 <= share <= 1.0:
        raise InvalidInputError(f"the share is {share}, expected 0 to 1")
    if not (noise_m >= 0.0 and math.isfinite(noise_m)):
        raise InvalidInputError(f"noise_m is {noise_m}, expected a finite number >= 0")
