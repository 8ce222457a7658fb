"""The two sides of a match of points, checked and centred."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.registration.search.branch_and_bound import as_points
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["Cloud", "Pair", "cloud_of"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """One side: points about their own centre."""

    points: FloatArray  # (m, 2) [m]
    weights: FloatArray  # (m,), mean 1
    sigmas_m: FloatArray | None  # (m,)
    center: FloatArray  # (2,) [m]

    def subset(self, mask: NDArray[np.bool_]) -> Cloud:
        """The points of a mask, about the same centre."""
        sigmas_m = None if self.sigmas_m is None else self.sigmas_m[mask]
        return Cloud(self.points[mask], self.weights[mask], sigmas_m, self.center)

    def original(self) -> FloatArray:
        """Points (m, 2) as they came in."""
        return self.points + self.center


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Both sides as they are searched; ``is_swapped``: the caller's source is the target."""

    source: Cloud
    target: Cloud
    is_swapped: bool

    def full_pose(self, pose: SE2) -> SE2:
        """The caller's ``T_target_source`` of a pose between the centred sides."""
        sx, sy = self.source.center
        tx, ty = self.target.center
        moved = SE2(pose.x + tx, pose.y + ty, pose.yaw) @ SE2(-sx, -sy, 0.0)
        return moved.inverse() if self.is_swapped else moved

    def full_covariance(self, covariance: FloatArray, pose: SE2) -> FloatArray:
        """Covariance (3, 3) of x, y, yaw of the caller's pose, from theta, x, y of the centred."""
        order = np.array([1, 2, 0])
        covariance = covariance[np.ix_(order, order)]
        if not np.isfinite(covariance).all():
            return covariance
        turned = SE2(0.0, 0.0, pose.yaw).apply(self.source.center)
        jacobian = np.eye(3)
        # Turning about the source's centre shifts its origin.
        jacobian[0, 2], jacobian[1, 2] = turned[1], -turned[0]
        covariance = jacobian @ covariance @ jacobian.T
        if self.is_swapped:
            full = self.full_pose(pose)
            jacobian = np.eye(3)
            jacobian[:2, :2] = -full.rotation()
            jacobian[:2, 2] = (full.y, -full.x)
            jacobian[2, 2] = -1.0
            covariance = jacobian @ covariance @ jacobian.T
        symmetric: FloatArray = 0.5 * (covariance + covariance.T)
        return symmetric

    def caller_points(self) -> tuple[FloatArray, FloatArray]:
        """The caller's source and target points."""
        points = self.source.original(), self.target.original()
        return (points[1], points[0]) if self.is_swapped else points


def cloud_of(
    name: str, points: ArrayLike, weights: ArrayLike | None, sigmas_m: ArrayLike | None
) -> Cloud:
    """Check one side; `name` is how errors call it."""
    array = as_points(points, name)
    plain = _positive(f"{name}_weights", weights, len(array))
    deviations = _positive(f"{name}_sigma_m", sigmas_m, len(array))
    center = np.zeros(2)
    if len(array):
        center = 0.5 * (array.min(axis=0) + array.max(axis=0))
        center = center + (array - center).mean(axis=0)
    mixture = np.ones(len(array)) if plain is None else plain / plain.mean()
    return Cloud(array - center, mixture, deviations, center)


def _positive(name: str, values: ArrayLike | None, count: int) -> FloatArray | None:
    if values is None:
        return None
    numbers = np.asarray(values, dtype=np.float64)
    if numbers.shape != (count,):
        raise InvalidInputError(f"{name} has shape {numbers.shape}, expected ({count},)")
    is_good = np.isfinite(numbers) & (numbers > 0.0)
    if not is_good.all():
        raise InvalidInputError(f"{name} holds {numbers[~is_good][0]}, expected positive numbers")
    return numbers
