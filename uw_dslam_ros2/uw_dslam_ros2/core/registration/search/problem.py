"""Terms of a search, and the same terms as the kernels want them: flat arrays.

A term is a set of weighted points and the `Field` they are scored in; see `branch_and_bound`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.registration.search import kernels
from uw_dslam_ros2.core.registration.search.field import NUM_WINDOWS, Field
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["Problem", "Term", "as_points"]

FloatArray = NDArray[np.float64]

_CELL = 1e-9  # part of a cell by which every rectangle is widened
_SMALL = 6.0  # cells that a box may move the points by, for curvature to be tried


@dataclass(frozen=True, slots=True, eq=False)
class Term:
    """Weighted points and the field they are scored in; see the module's text."""

    points: FloatArray  # (k, 2) [m]
    weights: FloatArray  # (k,), not negative
    field: Field
    is_inverse: bool = False

    def __post_init__(self) -> None:
        points = np.ascontiguousarray(self.points, dtype=np.float64)
        weights = np.ascontiguousarray(self.weights, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 2:
            raise InvalidInputError(f"points have shape {points.shape}, expected (k, 2)")
        if weights.shape != (len(points),):
            raise InvalidInputError(
                f"weights have shape {weights.shape}, expected ({len(points)},)"
            )
        if not np.isfinite(points).all():
            raise InvalidInputError("points hold a number that is not finite")
        if not (np.isfinite(weights).all() and (weights >= 0.0).all()):
            raise InvalidInputError("weights hold a number that is negative or not finite")
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "weights", weights)


class Problem:
    """Terms as the kernels want them: flat arrays, both frames moved to their middle.

    Parameters
    ----------
    source_center, target_center : (2,)
        Where the frames are moved to; the middle of what lies in them where None.
    window : (6,)
        Centre and half widths of (theta, x, y) to search; all at which anything can overlap where
        None.
    """

    def __init__(
        self,
        terms: Sequence[Term],
        source_center: FloatArray | None = None,
        target_center: FloatArray | None = None,
        window: FloatArray | None = None,
    ) -> None:
        self.terms = [term for term in terms if len(term.points)]
        if not self.terms:
            raise InvalidInputError("a search needs at least one term with points, got none")
        self.source_center = self._center(False) if source_center is None else source_center
        self.target_center = self._center(True) if target_center is None else target_center
        self.window = self._window() if window is None else window
        self.points = self._stacked()
        weights, spread = self.points[2], (self.points[:2] ** 2).sum(axis=0)
        self.frames = self._frames(math.sqrt(float(spread.max())))
        self.rows = self._rows()
        self.coefficients = _joined([term.field.coefficients for term in self.terms])
        self.pitch_m = min(term.field.pitch_m for term in self.terms)
        self.reach = 5.0 * max(term.field.pitch_m for term in self.terms)
        self.arm = math.sqrt(float((weights * spread).sum() / max(float(weights.sum()), 1e-300)))
        turning = [self._turning_radius(term) for term in self.terms if term.is_inverse]
        self.arm = max([self.arm, 1e-3 * self.reach, *turning])
        self.radius = self.reach  # of the neighbourhood of an optimum
        self.peak = sum(
            float(term.weights.sum()) * float(np.abs(term.field.coefficients).max())
            for term in self.terms
        )
        rounding = float(self.frames[:, 3].max()) - _CELL
        scatter = 1e-11 * max(1.0, math.sqrt(len(weights)) / 30.0)
        self.margin = self.peak * (scatter + 2.0 * rounding)

    @property
    def sum(self) -> kernels.Sum:
        """The terms for the kernels."""
        return kernels.Sum(
            self.points, self.rows, self.frames, self.coefficients, self.window, self.arm,
            self.reach,
        )  # fmt: skip

    @functools.cached_property
    def bounds(self) -> kernels.Bounds:
        """Bound tables of all fields, made when a search first asks for them."""
        windows, curvatures = zip(*(term.field.tables for term in self.terms), strict=True)
        small = _SMALL * self.pitch_m
        return kernels.Bounds(_joined(windows), _joined(curvatures), self.margin, small)

    def _stacked(self) -> FloatArray:
        """All points (4, K): x, y, weight, and the most that all points after it can bring."""
        stacked = []
        for term in self.terms:
            center = self.target_center if term.is_inverse else self.source_center
            most = term.weights * term.field.maximum
            rows = np.column_stack([term.points - center, term.weights, most])
            stacked.append(rows[_shuffled(term)])
        points = np.concatenate(stacked).T.copy()
        after = np.cumsum(points[3, ::-1])[::-1] - points[3]
        points[3] = np.maximum(after, 0.0)
        return points

    def _frames(self, radius_m: float) -> FloatArray:
        """Origin, pitch, rounding of a place in cells, and highest value of each field (T, 5)."""
        reach_m = radius_m + float(np.abs(self.window[1:3]).max() + self.window[4:].max())
        frames = []
        for term in self.terms:
            x, y = term.field.origin - (
                self.source_center if term.is_inverse else self.target_center
            )
            pitch_m = term.field.pitch_m
            rounding = _CELL + 2.0**-48 * (reach_m + abs(x) + abs(y)) / pitch_m
            frames.append([x, y, pitch_m, rounding, term.field.maximum])
        return np.array(frames)

    def _rows(self) -> NDArray[np.int64]:
        """Where the parts of each term are in the flat arrays (T, 7); see `kernels.Sum`."""
        rows, num_points, num_cells = [], 0, 0
        for term in self.terms:
            ends = num_points, num_points + len(term.points)
            shape = term.field.coefficients.shape
            rows.append([*ends, term.is_inverse, num_cells, *shape, NUM_WINDOWS * num_cells])
            num_points, num_cells = ends[1], num_cells + math.prod(shape)
        return np.array(rows, dtype=np.int64)

    def _turning_radius(self, term: Term) -> float:
        """Mean distance of a source field's content from the centre it turns about [m]."""
        field, square = term.field, 0.0
        size = np.abs(field.coefficients.astype(np.float64))
        for axis in range(2):
            along = size.sum(axis=1 - axis)  # axis 0 counts rows, which are y
            place = field.origin[1 - axis] + field.pitch_m * np.arange(len(along))
            square += float((along * (place - self.source_center[1 - axis]) ** 2).sum())
        return math.sqrt(square / max(float(size.sum()), 1e-300))

    def _center(self, is_target: bool) -> FloatArray:
        """Weighted mean of the points in that frame, or the middle of the fields there."""
        points = [term for term in self.terms if term.is_inverse == is_target]
        if points:
            weights = np.concatenate([term.weights for term in points])
            stacked = np.concatenate([term.points for term in points])
            if weights.sum() > 0.0:
                middle = 0.5 * (stacked.min(axis=0) + stacked.max(axis=0))
                mean: FloatArray = (
                    middle + ((stacked - middle) * weights[:, None]).sum(axis=0) / weights.sum()
                )
                return mean
            return stacked.mean(axis=0)
        fields = [term.field for term in self.terms if term.is_inverse != is_target]
        low = np.min([field.origin for field in fields], axis=0)
        high = np.max([field.high for field in fields], axis=0)
        return np.asarray(0.5 * (low + high))

    def _window(self) -> FloatArray:
        """All (theta, x, y) at which a point can touch its field: centre, half widths (6,)."""
        lows, highs = [], []
        for term in self.terms:
            low, high = term.field.origin, term.field.high
            if term.is_inverse:
                corners = np.maximum(
                    np.abs(low - self.source_center), np.abs(high - self.source_center)
                )
                reach = float(np.hypot(*corners))
                points = term.points - self.target_center
                lows.append(points.min(axis=0) - reach)
                highs.append(points.max(axis=0) + reach)
            else:
                reach = float(np.hypot(*(term.points - self.source_center).T).max())
                lows.append(low - self.target_center - reach)
                highs.append(high - self.target_center + reach)
        low, high = np.min(lows, axis=0), np.max(highs, axis=0)
        return np.array([0.0, *(0.5 * (low + high)), math.pi, *(0.5 * (high - low))])

    def motion_of(self, theta: float, x: float, y: float) -> SE2:
        """``T_target_source`` of the centred parameters."""
        cos, sin = math.cos(theta), math.sin(theta)
        sx, sy = self.source_center
        tx, ty = self.target_center
        return SE2(x + tx - (cos * sx - sin * sy), y + ty - (sin * sx + cos * sy), theta)

    def pose_of(self, T_target_source: SE2) -> FloatArray:
        """Centred parameters (theta, x, y) of a pose."""
        moved = T_target_source.apply(self.source_center) - self.target_center
        return np.array([T_target_source.yaw, *moved])

    def value_at(self, parameters: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Objective, gradient (3,), second derivatives (3, 3) in (theta, x, y), all centred."""
        gradient, hessian = np.zeros(3), np.zeros((3, 3))
        pose = np.asarray(parameters, dtype=np.float64)
        return float(kernels.evaluate(self.sum, pose, gradient, hessian)), gradient, hessian

    def ascend(
        self, parameters: FloatArray, max_steps: int = 50, longest_m: float | None = None
    ) -> tuple[float, FloatArray]:
        """Climb to the local optimum above (theta, x, y), in steps no longer than that."""
        pose = np.array(parameters, dtype=np.float64)
        longest_m = self.reach if longest_m is None else longest_m
        value = kernels.ascend(self.sum, longest_m, pose, max_steps, 1e-10, np.empty((10, 3)))
        return float(value), pose


def _shuffled(term: Term) -> NDArray[np.int64]:
    """A fixed order without pattern, so that the first points stand for all."""
    return np.random.default_rng(0).permutation(len(term.points))


def _joined(arrays: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    """One flat array; a single one is not copied."""
    flat = [array.ravel() for array in arrays]
    return flat[0] if len(flat) == 1 else np.concatenate(flat)


def as_points(points: ArrayLike, name: str) -> FloatArray:
    """Checked points (N, 2) float64 [m]."""
    array = np.ascontiguousarray(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 2:
        raise InvalidInputError(f"{name} has shape {array.shape}, expected (N, 2)")
    if not np.isfinite(array).all():
        bad = array[~np.isfinite(array).all(axis=1)][0]
        raise InvalidInputError(f"{name} holds {bad.tolist()}, expected finite coordinates")
    return array
