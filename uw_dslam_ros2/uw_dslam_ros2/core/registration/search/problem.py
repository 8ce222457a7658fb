"""Terms of a search, and the same terms as the kernels want them: flat arrays.

A term is a set of weighted points and the `Field` they are scored in; see `branch_and_bound`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.registration.search import kernels
from uw_dslam_ros2.core.registration.search.field import FIRST_LEVEL, Field, window_spans
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
    """Terms as the kernels want them: flat arrays, both frames moved to their middle."""

    def __init__(self, terms: Sequence[Term], is_source_centred: bool = True) -> None:
        self.terms = [term for term in terms if len(term.points)]
        if not self.terms:
            raise InvalidInputError("a search needs at least one term with points, got none")
        self.source_center = self._center(False) if is_source_centred else np.zeros(2)
        self.target_center = self._center(True)
        points, rows, frames, levels = [], [], [], []
        num_points, num_levels, sizes = 0, 0, np.zeros(3, dtype=np.int64)
        for term in self.terms:
            own, others = self.source_center, self.target_center
            if term.is_inverse:
                own, others = others, own
            field = term.field
            points.append(np.column_stack([term.points - own, term.weights])[_shuffled(term)])
            shape = field.coefficients.shape
            rows.append(
                [
                    num_points,
                    num_points + len(term.points),
                    int(term.is_inverse),
                    sizes[0],
                    *shape,
                    num_levels - FIRST_LEVEL,
                    sizes[2],
                ]
            )
            frames.append([*(field.origin - others), field.pitch_m])
            table = field.levels + np.array([sizes[1], 0, 0])
            levels.append(table)
            num_points += len(term.points)
            num_levels += len(table)
            sizes += [field.coefficients.size, field.bounds.size, field.curvatures.size]
        self.rows = np.array(rows, dtype=np.int64)
        self.levels = np.ascontiguousarray(np.concatenate(levels))
        self.coefficients = _joined([term.field.coefficients.ravel() for term in self.terms])
        self.bounds = _joined([term.field.bounds for term in self.terms])
        self.windows = _joined([term.field.windows.ravel() for term in self.terms])
        self.curvatures = _joined([term.field.curvatures.ravel() for term in self.terms])
        self.level_of = _level_table(int(self.rows[:, 4:6].max()))
        self.half_of = window_spans()
        self.window = self._window()
        stacked = np.concatenate(points)
        weights, spread = stacked[:, 2], (stacked[:, :2] ** 2).sum(axis=1)
        self.points = np.vstack([stacked.T, self._rests(weights)])
        rounding = self._rounding(frames, math.sqrt(float(spread.max())))
        self.frames = np.column_stack([np.array(frames), rounding])
        self.arm = math.sqrt(float((weights * spread).sum() / max(float(weights.sum()), 1e-300)))
        self.arm = max([self.arm, *(self._turning_radius(t) for t in self.terms if t.is_inverse)])
        self.reach = 5.0 * max(term.field.pitch_m for term in self.terms)
        self.arm = max(self.arm, 1e-3 * self.reach)
        self.radius = self.reach  # of the neighbourhood of an optimum
        self.small = _SMALL * min(term.field.pitch_m for term in self.terms)
        peak = sum(
            float(term.weights.sum()) * float(np.abs(term.field.coefficients).max())
            for term in self.terms
        )
        self.margin = peak * (
            1e-11 * max(1.0, math.sqrt(len(stacked)) / 30.0) + 2.0 * float(rounding.max() - _CELL)
        )

    def _turning_radius(self, term: Term) -> float:
        """Mean distance of a source field's content from the centre it turns about [m]."""
        field, square = term.field, 0.0
        size = np.abs(field.coefficients.astype(np.float64))
        for axis in range(2):
            along = size.sum(axis=1 - axis)  # axis 0 counts rows, which are y
            place = field.origin[1 - axis] + field.pitch_m * np.arange(len(along))
            square += float((along * (place - self.source_center[1 - axis]) ** 2).sum())
        return math.sqrt(square / max(float(size.sum()), 1e-300))

    def _rests(self, weights: FloatArray) -> FloatArray:
        """For every point, the most that all points after it can bring (K,)."""
        peaks = np.repeat(
            [term.field.maximum for term in self.terms], [len(term.points) for term in self.terms]
        )
        after = np.cumsum((weights * peaks)[::-1])[::-1] - weights * peaks
        return np.maximum(after, 0.0)

    def _rounding(self, frames: list[list[float]], radius_m: float) -> FloatArray:
        """How far [cells] a computed place may be off in each field (T,)."""
        reach_m = radius_m + float(np.abs(self.window[1:3]).max() + self.window[4:].max())
        return np.array(
            [_CELL + 2.0**-48 * (reach_m + abs(x) + abs(y)) / pitch_m for x, y, pitch_m in frames]
        )

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
        low, high = self._extent(
            [term.field for term in self.terms if term.is_inverse != is_target]
        )
        return 0.5 * (low + high)

    @staticmethod
    def _extent(fields: Sequence[Field]) -> tuple[FloatArray, FloatArray]:
        lows = [field.origin for field in fields]
        highs = [
            field.origin + field.pitch_m * (np.array(field.coefficients.shape)[::-1] - 1)
            for field in fields
        ]
        return np.array(lows).min(axis=0), np.array(highs).max(axis=0)

    def _window(self) -> FloatArray:
        """All (theta, x, y) at which a point can touch its field: centre, half widths (6,)."""
        lows, highs = [], []
        for term in self.terms:
            low, high = self._extent([term.field])
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

    def to_pose(self, theta: float, x: float, y: float) -> SE2:
        """``T_target_source`` of the centred parameters."""
        cos, sin = math.cos(theta), math.sin(theta)
        sx, sy = self.source_center
        tx, ty = self.target_center
        return SE2(x + tx - (cos * sx - sin * sy), y + ty - (sin * sx + cos * sy), theta)

    def from_pose(self, T_target_source: SE2) -> FloatArray:
        """Centred parameters (theta, x, y) of a pose."""
        moved = T_target_source.apply(self.source_center) - self.target_center
        return np.array([T_target_source.yaw, *moved])

    def value_at(self, parameters: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Objective, gradient (3,), second derivatives (3, 3) in (theta, x, y), all centred."""
        gradient, hessian = np.zeros(3), np.zeros((3, 3))
        value = kernels.evaluate(
            self.points,
            self.rows,
            self.frames,
            self.coefficients,
            np.asarray(parameters, dtype=np.float64),
            gradient,
            hessian,
        )
        return float(value), gradient, hessian

    def ascend(self, parameters: FloatArray, max_steps: int = 50) -> tuple[float, FloatArray]:
        """Climb to the local optimum above (theta, x, y)."""
        pose = np.array(parameters, dtype=np.float64)
        value = kernels.ascend(
            self.points,
            self.rows,
            self.frames,
            self.coefficients,
            self.window,
            self.arm,
            self.reach,
            pose,
            max_steps,
            1e-10,
            np.empty((10, 3)),
        )
        return float(value), pose


def _shuffled(term: Term) -> NDArray[np.int64]:
    """A fixed order without pattern, so that the first points stand for all."""
    return np.random.default_rng(0).permutation(len(term.points))


def _joined(arrays: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    """One flat array; a single one is not copied."""
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)


def _level_table(size: int) -> NDArray[np.int8]:
    """For every span: smallest pyramid level whose windows hold span + 1 cells from anywhere."""
    table = np.empty(size + 1, dtype=np.int8)
    level = 0
    for span in range(size + 1):
        while (1 << level) - (1 << max(0, level - 2)) < span:
            level += 1
        table[span] = level
    return table


def as_points(points: ArrayLike, name: str) -> FloatArray:
    """Checked points (N, 2) float64 [m]."""
    array = np.ascontiguousarray(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 2:
        raise InvalidInputError(f"{name} has shape {array.shape}, expected (N, 2)")
    if not np.isfinite(array).all():
        bad = array[~np.isfinite(array).all(axis=1)][0]
        raise InvalidInputError(f"{name} holds {bad.tolist()}, expected finite coordinates")
    return array
