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

Where one field is asked over all motions, a *sweep* (`sweep`) bounds all boxes of equal size
together first, and the best-first search starts from the few that it leaves.

With ``SearchSettings.keep`` below 1 the search then goes on to the rivals: every box that could
hold ``keep`` times the best value is followed until it is excluded or lies in the neighbourhood of
an optimum that was met. So the optima listed in ``SearchOutcome.rivals`` come with a proven bound
of their surroundings, and ``upper_elsewhere`` bounds all other poses.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.registration.result import PriorWindow, Progress
from uw_dslam_ros2.core.registration.search import kernels
from uw_dslam_ros2.core.registration.search.outcome import SearchOutcome, SearchSettings, Status
from uw_dslam_ros2.core.registration.search.problem import Problem, Term, as_points
from uw_dslam_ros2.core.registration.search.rivals import Neighborhoods
from uw_dslam_ros2.core.registration.search.sweep import Sweep
from uw_dslam_ros2.core.se2 import SE2

__all__ = [
    "Problem",
    "SearchOutcome",
    "SearchSettings",
    "Status",
    "Term",
    "as_points",
    "objective_at",
    "search",
]

FloatArray = NDArray[np.float64]

_BOX_BYTES = 7 * 8 + 8 + 4
_CHUNK = 2048  # boxes between two looks at the clock
_MAX_OPTIMA = 512  # local optima remembered
_CELLS_PER_BOX = 32  # cells of a sweep that cost as much as a box
_NUM_CENTRES = 24  # cells of each of its levels whose centres are looked at
_NUM_CLIMBS = 4  # and of these, climbed from


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
    return _Search(problem, settings, clock, prior is None).run(progress, is_cancelled, stage)


class _Search:
    """The arrays of one running search."""

    def __init__(
        self,
        problem: Problem,
        settings: SearchSettings,
        clock: Callable[[], float] | None,
        is_swept: bool,
    ) -> None:
        self._problem = problem
        self._settings = settings
        self._clock = clock
        self._start = clock() if clock else math.nan
        self._is_swept = is_swept
        self._num_cells = 0
        self._max_slots = max(64, int(settings.max_memory_mb * 1e6 / _BOX_BYTES))
        slots = min(8192, self._max_slots)
        self._boxes = np.empty((slots, 7))
        self._keys = np.empty(slots)
        self._heap = np.arange(slots, dtype=np.int32)
        self._counters = np.zeros(5, dtype=np.int64)
        self._found = np.full((_MAX_OPTIMA, 5), -math.inf)
        self._worth = np.ones(32)  # of the bound by curvature, by size of a box
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
        """Chunks of boxes until the proof is complete or a budget is used up; then the rivals."""
        max_boxes = self._settings.max_boxes
        self._sweep(progress, is_cancelled, stage)
        status = self._chunks(0.0, max_boxes, progress, is_cancelled, stage)
        lower, upper = self._bounds()
        has_all_rivals = self._settings.keep >= 1.0
        if status is Status.CERTIFIED and not has_all_rivals:
            spent = int(self._counters[kernels.NUM_BOXES])
            max_boxes = min(max_boxes, spent + int(self._settings.rival_share * spent))
            ended = self._chunks(
                self._problem.radius, max_boxes, progress, is_cancelled, f"{stage}, rivals"
            )
            has_all_rivals = ended is Status.CERTIFIED
        return self._outcome(status, lower, upper, has_all_rivals)

    def _sweep(
        self,
        progress: Callable[[Progress], None] | None,
        is_cancelled: Callable[[], bool] | None,
        stage: str,
    ) -> None:
        """Put the boxes that a sweep leaves in place of the first one, if it fits the budgets."""
        p, settings = self._problem, self._settings
        if not (self._is_swept and Sweep.suits(p)):
            return
        max_cells = min(self._max_slots - 2, _CELLS_PER_BOX * settings.max_boxes // 4)
        sweep = Sweep(p, max_cells, settings.max_memory_mb * 1e6 / 4.0)
        while sweep.advance(self._floor() - p.margin, lambda: self._is_over(is_cancelled)):
            kernels.climb(
                p.points, p.rows, p.frames, p.coefficients, p.window, p.arm, p.reach,
                sweep.highest(_NUM_CENTRES), _NUM_CLIMBS, self._best, self._found, self._counters,
            )  # fmt: skip
        self._num_cells = sweep.num_cells
        if not sweep.num_cells:
            return
        boxes, uppers = sweep.boxes(self._floor() - p.margin)
        count = len(boxes)
        while len(self._heap) < count + 2:
            self._grow()
        # From the highest down, which is a heap.
        self._boxes[:count, :6] = boxes
        self._boxes[:count, 6] = kernels.UNSEEN
        self._keys[:count] = np.minimum(uppers + p.margin, self._keys[0])
        self._counters[kernels.NUM_OPEN] = count
        self._counters[kernels.NUM_BOXES] = sweep.num_cells // _CELLS_PER_BOX
        if progress:
            progress(self._progress(stage))

    def _is_over(self, is_cancelled: Callable[[], bool] | None) -> bool:
        return self._is_late() or bool(is_cancelled and is_cancelled())

    def _is_late(self) -> bool:
        clock = self._clock
        return clock is not None and clock() - self._start >= self._settings.max_seconds

    def _floor(self) -> float:
        """Bound below which nothing is of interest any more."""
        return min(float(self._best[0]), self._settings.keep * float(self._best[0]))

    def _chunks(
        self,
        apart: float,
        max_boxes: int,
        progress: Callable[[Progress], None] | None,
        is_cancelled: Callable[[], bool] | None,
        stage: str,
    ) -> Status:
        """One phase: the proof with ``apart`` = 0, or that of the rivals."""
        counters = self._counters
        while True:
            left = max_boxes - int(counters[kernels.NUM_BOXES])
            self._run_chunk(min(_CHUNK, max(left, 0)), apart)
            status = None
            if counters[kernels.STATUS] == kernels.DONE:
                status = Status.CERTIFIED
            elif counters[kernels.STATUS] == kernels.FOUND_FULL or (
                counters[kernels.STATUS] == kernels.HEAP_FULL and not self._grow()
            ):
                status = Status.MEMORY
            elif counters[kernels.NUM_BOXES] >= max_boxes:
                status = Status.BOXES
            elif self._is_late():
                status = Status.TIME
            if progress:
                progress(self._progress(stage))
            if status is None and is_cancelled and is_cancelled():
                status = Status.CANCELLED
            if status is not None:
                return status

    def _run_chunk(self, max_boxes: int, apart: float) -> None:
        p, settings = self._problem, self._settings
        kernels.run(
            p.points, p.rows, p.frames, p.levels, p.level_of, p.half_of,
            p.coefficients, p.bounds, p.windows, p.curvatures, p.window,
            p.arm, p.reach, p.margin, p.small, settings.gap, settings.keep, apart, max_boxes,
            self._boxes, self._keys, self._heap, self._counters, self._best, self._found,
            self._worth,
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
        return lower, max(self._top(), float(self._best[0]) + self._problem.margin)

    def _top(self) -> float:
        """Largest bound of an open box."""
        num_open = int(self._counters[kernels.NUM_OPEN])
        return float(self._keys[self._heap[0]]) if num_open else -math.inf

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

    def _outcome(
        self, status: Status, lower: float, upper: float, has_all_rivals: bool
    ) -> SearchOutcome:
        p, counters = self._problem, self._counters
        value, pose = p.ascend(self._best[1:4])
        if value > self._best[0]:
            self._best[0], self._best[1:4] = value, pose
        lower = float(self._best[0]) - p.margin
        upper = max(upper, float(self._best[0]) + p.margin)
        found = self._found[: int(counters[kernels.NUM_FOUND])]
        found = np.vstack([[*self._best[:4], -math.inf], found])
        found = found[np.argsort(-found[:, 0], kind="stable")]
        neighborhoods = Neighborhoods.of(
            p, found, max(self._top(), self._floor()), float(self._best[5])
        )
        distinct = found[neighborhoods.apart_from_better(0.2 * p.reach)]
        poses = [p.to_pose(*row[1:4]) for row in distinct]
        return SearchOutcome(
            T_target_source=p.to_pose(*self._best[1:4]),
            lower_bound=lower,
            upper_bound=upper,
            status=status,
            num_boxes=int(counters[kernels.NUM_BOXES]),
            num_cells=self._num_cells,
            num_open_boxes=int(counters[kernels.NUM_OPEN]),
            seconds=self._clock() - self._start if self._clock else math.nan,
            optima=np.array(
                [[v, t.x, t.y, t.yaw] for v, t in zip(distinct[:, 0], poses, strict=True)]
            ),
            rivals=neighborhoods.rivals(self._settings.keep * lower),
            upper_elsewhere=min(upper, neighborhoods.upper_elsewhere),
            has_all_rivals=has_all_rivals,
            neighborhoods=neighborhoods,
        )
