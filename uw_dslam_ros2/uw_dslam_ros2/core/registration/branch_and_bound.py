"""Certified global maximum of a sum of fields over all rigid motions of the plane.

The objective is a list of *terms*, each a set of weighted points and the `Field` they are scored
in::

    f(T) = sum over terms, sum over their points: weight * field(T p)        forward: source
    points, target field
                                                  weight * field(T^-1 p)     inverse: target
                                                  points, source field

with ``T = T_target_source``. Weights are not negative; the fields may have any sign. A point
mixture is one forward term; maps with evidence of free space are two::

    wall_terms = [
        Term(source_walls, source_weights, field_from_samples(target_evidence, origin, pitch_m)),
        Term(target_walls, target_weights, field_from_samples(source_evidence, origin, pitch_m),
        is_inverse=True),
    ]
    outcome = search(wall_terms, SearchSettings(gap=0.01, max_seconds=2.0), clock=time.monotonic)
    outcome.T_target_source, outcome.lower_bound, outcome.upper_bound, outcome.status,
    outcome.optima

Points are in metres in their own map's frame, the field of a forward term lies in the target's
frame, that of an inverse term in the source's. Offsets (UTM) are taken out inside.
``objective_at`` evaluates the same sum at any pose.

The search is best first over boxes of (theta, x, y). A box is bounded twice: each point's
reachable rectangle against the field's range-maximum pyramid, and, where boxes are small, by
value, summed gradient and bounded curvature at the centre (Consolini et al., arXiv 1901.09641),
which alone closes the gap. Local ascent from promising centres gives the lower bound (GOGMA, arXiv
1603.00150) and does not touch the proof.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.registration import kernels
from uw_dslam_ros2.core.registration.field import Field, window_spans
from uw_dslam_ros2.core.registration.result import PriorWindow, Progress
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["SearchOutcome", "SearchSettings", "Status", "Term", "objective_at", "search"]

FloatArray = NDArray[np.float64]

_BOX_BYTES = 7 * 8 + 8 + 4
_SMALL = 4.0  # cells that a box may move the points by, for curvature to be tried
_CHUNK = 2048  # boxes between two looks at the clock


class Status(enum.Enum):
    """Why a search ended."""

    CERTIFIED = "certified"
    BOXES = "boxes"
    TIME = "time"
    MEMORY = "memory"
    CANCELLED = "cancelled"


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


@dataclass(frozen=True, slots=True)
class SearchSettings:
    """When a search may end."""

    gap: float = 0.01  # relative: (upper - lower) / upper
    max_boxes: int = 10_000_000
    max_seconds: float = math.inf  # counts only with a clock
    max_memory_mb: float = 512.0  # of the open boxes
    keep: float = 1.0  # share of the lower bound down to which boxes stay open, for rivals


@dataclass(frozen=True, slots=True, eq=False)
class SearchOutcome:
    """Pose and proof. Bounds are sums over all terms, not normalised."""

    T_target_source: SE2
    lower_bound: float  # value at the pose, less the rounding margin
    upper_bound: float  # no pose of the window exceeds it
    status: Status
    num_boxes: int
    num_open_boxes: int
    seconds: float  # NaN without a clock
    optima: FloatArray  # (F, 4): value, x, y, yaw of local optima met, best first, each pose once

    @property
    def gap(self) -> float:
        """Relative gap, 0 where there is nothing to gain."""
        return (
            max(0.0, 1.0 - self.lower_bound / self.upper_bound) if self.upper_bound > 0.0 else 0.0
        )


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
            points.append(np.column_stack([term.points - own, term.weights]))
            shape = field.coefficients.shape
            rows.append(
                [
                    num_points,
                    num_points + len(term.points),
                    int(term.is_inverse),
                    sizes[0],
                    *shape,
                    num_levels,
                    sizes[2],
                ]
            )
            frames.append([*(field.origin - others), field.pitch_m])
            table = field.levels + np.array([sizes[1], 0, 0])
            levels.append(table)
            num_points += len(term.points)
            num_levels += len(table)
            sizes += [field.coefficients.size, field.bounds.size, field.curvatures.size]
        self.points = np.ascontiguousarray(np.concatenate(points))
        self.rows = np.array(rows, dtype=np.int64)
        self.frames = np.array(frames, dtype=np.float64)
        self.levels = np.ascontiguousarray(np.concatenate(levels))
        self.coefficients = _joined([term.field.coefficients.ravel() for term in self.terms])
        self.bounds = _joined([term.field.bounds for term in self.terms])
        self.windows = _joined([term.field.windows.ravel() for term in self.terms])
        self.curvatures = _joined([term.field.curvatures.ravel() for term in self.terms])
        self.level_of = _level_table(int(self.rows[:, 4:6].max()))
        self.half_of = window_spans()
        self.window = self._window()
        weights = self.points[:, 2]
        spread = (self.points[:, :2] ** 2).sum(axis=1)
        self.arm = math.sqrt(float((weights * spread).sum() / max(float(weights.sum()), 1e-300)))
        self.reach = 5.0 * max(term.field.pitch_m for term in self.terms)
        self.arm = max(self.arm, 1e-3 * self.reach)
        self.small = _SMALL * min(term.field.pitch_m for term in self.terms)
        peak = sum(
            float(term.weights.sum()) * float(np.abs(term.field.coefficients).max())
            for term in self.terms
        )
        self.margin = 1e-11 * peak * max(1.0, math.sqrt(len(self.points)) / 30.0)

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
            *map(float, parameters),
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
        )
        return float(value), pose


def objective_at(terms: Sequence[Term], T_target_source: SE2) -> float:
    """The sum that `search` maximises, at a pose."""
    problem = Problem(terms)
    return problem.value_at(problem.from_pose(T_target_source))[0]


def search(
    terms: Sequence[Term],
    settings: SearchSettings | None = None,
    *,
    prior: PriorWindow | None = None,
    clock: Callable[[], float] | None = None,
    progress: Callable[[Progress], None] | None = None,
    is_cancelled: Callable[[], bool] | None = None,
    stage: str = "search",
) -> SearchOutcome:
    """Maximise the sum of the terms over all motions, or over a prior's window, with a proof.

    Parameters
    ----------
    terms : sequence of Term
        At least one with points.
    settings : SearchSettings
        Gap to prove, and budgets. A search that runs out of one ends with the gap still open, and
        says so.
    prior : PriorWindow
        Search only there; without one, every motion at which anything can overlap.
    clock : callable
        Seconds, monotonic; needed for ``max_seconds``.
    progress, is_cancelled : callable
        Called every few thousand boxes.
    """
    settings = settings or SearchSettings()
    problem = Problem(terms, is_source_centred=prior is None)
    if prior is not None:
        if not (prior.half_width_m > 0.0 and prior.half_width_rad > 0.0):
            raise InvalidInputError(
                f"prior half widths are {prior.half_width_m} m and {prior.half_width_rad} rad, "
                "expected > 0"
            )
        problem.window[:3] = problem.from_pose(prior.T_target_source)
        problem.window[3] = min(prior.half_width_rad, math.pi)
        problem.window[4:] = prior.half_width_m
    return _Search(problem, settings, clock).run(progress, is_cancelled, stage)


class _Search:
    """The arrays of one running search."""

    def __init__(
        self, problem: Problem, settings: SearchSettings, clock: Callable[[], float] | None
    ) -> None:
        self._problem = problem
        self._settings = settings
        self._clock = clock
        self._start = clock() if clock else math.nan
        self._max_slots = max(64, int(settings.max_memory_mb * 1e6 / _BOX_BYTES))
        slots = min(8192, self._max_slots)
        self._boxes = np.empty((slots, 7))
        self._keys = np.empty(slots)
        self._heap = np.arange(slots, dtype=np.int32)
        self._counters = np.zeros(5, dtype=np.int64)
        self._found = np.full((1024, 4), -math.inf)
        value, _, _ = problem.value_at(problem.window[:3])
        self._best = np.array([value, *problem.window[:3], 0.0, -math.inf])
        self._boxes[0, :6] = problem.window
        self._boxes[0, 6] = 0
        self._keys[0] = problem.margin + sum(
            float(term.weights.sum()) * term.field.maximum for term in problem.terms
        )
        self._counters[kernels.NUM_OPEN] = 1

    def run(
        self,
        progress: Callable[[Progress], None] | None,
        is_cancelled: Callable[[], bool] | None,
        stage: str,
    ) -> SearchOutcome:
        """Chunks of boxes until the proof is complete or a budget is used up."""
        settings, counters = self._settings, self._counters
        status = None
        while status is None:
            left = settings.max_boxes - int(counters[kernels.NUM_BOXES])
            self._run_chunk(min(_CHUNK, max(left, 0)))
            if counters[kernels.STATUS] == kernels.DONE:
                status = Status.CERTIFIED
            elif counters[kernels.STATUS] == kernels.HEAP_FULL and not self._grow():
                status = Status.MEMORY
            elif counters[kernels.NUM_BOXES] >= settings.max_boxes:
                status = Status.BOXES
            elif self._clock and self._clock() - self._start >= settings.max_seconds:
                status = Status.TIME
            if progress:
                progress(self._progress(stage))
            if status is None and is_cancelled and is_cancelled():
                status = Status.CANCELLED
        return self._outcome(status)

    def _run_chunk(self, max_boxes: int) -> None:
        p, settings = self._problem, self._settings
        kernels.run(
            p.points, p.rows, p.frames, p.levels, p.level_of, p.half_of,
            p.coefficients, p.bounds, p.windows, p.curvatures, p.window,
            p.arm, p.reach, p.margin, p.small, settings.gap, settings.keep, max_boxes,
            self._boxes, self._keys, self._heap, self._counters, self._best, self._found,
        )  # fmt: skip

    def _grow(self) -> bool:
        """Double the room for open boxes, within the memory allowed."""
        slots = len(self._heap)
        wanted = min(2 * slots, self._max_slots)
        if wanted <= slots:
            return False
        extra = wanted - slots
        self._boxes = np.concatenate([self._boxes, np.empty((extra, 7))])
        self._keys = np.concatenate([self._keys, np.empty(extra)])
        self._heap = np.concatenate([self._heap, np.arange(slots, wanted, dtype=np.int32)])
        return True

    def _bounds(self) -> tuple[float, float]:
        lower = float(self._best[0]) - self._problem.margin
        num_open = int(self._counters[kernels.NUM_OPEN])
        upper = float(self._keys[self._heap[0]]) if num_open else float(self._best[0])
        return lower, max(upper, float(self._best[0]) + self._problem.margin)

    def _progress(self, stage: str) -> Progress:
        lower, upper = self._bounds()
        counters = self._counters
        pose = self._problem.to_pose(*self._best[1:4])
        return Progress(
            stage,
            lower,
            upper,
            int(counters[kernels.NUM_BOXES]),
            int(counters[kernels.NUM_OPEN]),
            pose,
        )

    def _outcome(self, status: Status) -> SearchOutcome:
        p, counters = self._problem, self._counters
        value, pose = p.ascend(self._best[1:4])
        if value > self._best[0]:
            self._best[0], self._best[1:4] = value, pose
        lower, upper = self._bounds()
        found = self._found[: min(int(counters[kernels.NUM_FOUND]), len(self._found))]
        found = np.concatenate([self._best[None, :4], found])
        return SearchOutcome(
            T_target_source=p.to_pose(*self._best[1:4]),
            lower_bound=lower,
            upper_bound=upper,
            status=status,
            num_boxes=int(counters[kernels.NUM_BOXES]),
            num_open_boxes=int(counters[kernels.NUM_OPEN]),
            seconds=self._clock() - self._start if self._clock else math.nan,
            optima=self._distinct(found),
        )

    def _distinct(self, found: FloatArray) -> FloatArray:
        """Best first, poses closer than a cell of the field counted once."""
        p = self._problem
        found = found[np.argsort(-found[:, 0], kind="stable")]
        scaled = np.column_stack(
            [p.arm * np.cos(found[:, 1]), p.arm * np.sin(found[:, 1]), found[:, 2], found[:, 3]]
        )
        chosen: list[int] = []
        for k in range(len(found)):
            apart = (
                np.abs(scaled[chosen] - scaled[k]).max(axis=1) if chosen else np.array([math.inf])
            )
            if apart.min() > 0.2 * p.reach and np.isfinite(found[k, 0]):
                chosen.append(k)
        poses = [p.to_pose(*found[k, 1:]) for k in chosen]
        return np.array(
            [[found[k, 0], t.x, t.y, t.yaw] for k, t in zip(chosen, poses, strict=True)]
        )


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
