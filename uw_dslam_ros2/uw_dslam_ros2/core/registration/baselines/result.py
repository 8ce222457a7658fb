"""What every baseline answers, and the checks and pieces that they share."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["BaselineResult", "checked_points", "procrustes"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class BaselineResult:
    """Outcome of a baseline; None as motion where the method itself found nothing to answer.

    ``score`` is the method's own, higher is better, and compares runs of one method only.
    """

    T_target_source: SE2 | None
    score: float
    diagnostics: dict[str, float] = field(default_factory=dict)


def checked_points(name: str, points: ArrayLike) -> FloatArray:
    """Points as a contiguous (N > 0, 2) float64 array; `InvalidInputError` otherwise."""
    array = np.ascontiguousarray(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 2 or len(array) == 0:
        raise InvalidInputError(f"{name} has shape {array.shape}, expected (N > 0, 2)")
    if not np.isfinite(array).all():
        raise InvalidInputError(f"{name} holds NaN or infinite values, expected finite metres")
    return array


def procrustes(source: ArrayLike, target: ArrayLike, weights: ArrayLike | None = None) -> SE2:
    """Least-squares rigid motion of pairs (N > 0, 2) [m]: what knowing the pairs would allow.

    A rotation needs two distinct points; with one, or with all in one place, yaw is 0.
    """
    source, target = checked_points("source", source), checked_points("target", target)
    if len(source) != len(target):
        raise InvalidInputError(
            f"source has {len(source)} points and target {len(target)}, expected pairs"
        )
    w = np.ones(len(source)) if weights is None else np.asarray(weights, dtype=np.float64)
    c_x, c_y = (w @ source) / w.sum(), (w @ target) / w.sum()
    x, y = source - c_x, target - c_y
    cos = float(np.sum(w * (x[:, 0] * y[:, 0] + x[:, 1] * y[:, 1])))
    sin = float(np.sum(w * (x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0])))
    rotation = SE2(yaw=float(np.arctan2(sin, cos)))
    shift = c_y - rotation.apply(c_x)
    return SE2(float(shift[0]), float(shift[1]), rotation.yaw)
