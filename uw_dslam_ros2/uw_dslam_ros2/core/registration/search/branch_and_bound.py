"""Certified global maximum of a sum of fields over all rigid motions of the plane.

The objective is a list of *terms*, each a set of weighted points and the `Field` they are scored
in::

    f(T) = sum over terms, sum over their points: weight * field(T p)        forward: source
    points, target field
                                                  weight * field(T^-1 p)     inverse: target
                                                  points, source field

with ``T = T_target_source``. Weights are not negative; the fields may have any sign. Point sets
are one forward term, or one for each kernel; two maps, with walls positive and free space
negative, are two::

    terms = [
        Term(source_walls, source_weights, target_field),
        Term(target_walls, target_weights, source_field, is_inverse=True),
    ]
    outcome = search(terms, SearchSettings(gap=0.01, max_seconds=2.0), clock=time.monotonic)
    outcome.T_target_source, outcome.lower_bound, outcome.upper_bound, outcome.status

Points are in metres in their own map's frame, the field of a forward term lies in the target's
frame, that of an inverse term in the source's. Offsets (UTM) are taken out inside.
``objective_at`` evaluates the same sum at any pose.

A *sweep* (`sweep`) first bounds all boxes of (theta, x, y) of equal size together, level by level.
The search then goes on best first with the few boxes that it leaves. A box is bounded twice: each
point's reachable rectangle against the field's range maxima, and, where boxes are small, by value,
summed gradient and bounded curvature at the centre (Consolini et al., arXiv 1901.09641), which
alone closes the gap. Local ascent from promising centres gives the lower bound (GOGMA, arXiv
1603.00150) and does not touch the proof.

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
from uw_dslam_ros2.core.registration.search.tile_kernels import SIDE
from uw_dslam_ros2.core.se2 import SE2

__all__ = [
    "Problem",
    "SearchOutcome",
    "SearchSettings",
    "Status",
    "Term",
    "as_points",
    "maximise",
    "objective_at",
    "search",
]

FloatArray = NDArray[np.float64]

_BOX_BYTES = 7 * 8 + 8 + 4
_CHUNK = 2048  # boxes between two looks at the clock
_MAX_OPTIMA = 512  # local optima remembered
_TILE_BYTES = 8 * SIDE**2 + 100
_NUM_OPEN_POSES = 64
_NUM_CENTRES = 24  # cells of each of its levels whose centres are looked at
_NUM_CLIMBS = 4  # and of these, climbed from


def objective_at(terms: Sequence[Term], T_target_source: SE2) -> float:
    """The sum that `search` maximises, at a pose."""
    problem = Problem(terms)
    return problem.value_at(problem.pose_of(T_target_source))[0]


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
    if prior is None:
        problem = Problem(terms)
    else:
        problem = Problem(terms, source_center=np.zeros(2))
        if not (prior.half_width_m > 0.0 and prior.half_width_rad > 0.0):
            raise InvalidInputError(
                f"prior half widths are {prior.half_width_m} m and {prior.half_width_rad} rad, "
                "expected > 0"
            )
        problem.window[:3] = problem.pose_of(prior.T_target_source)
        problem.window[3] = min(prior.half_width_rad, math.pi)
        problem.window[4:] = prior.half_width_m
    return maximise(
        problem, settings, clock=clock, progress=progress, is_cancelled=is_cancelled, stage=stage
    )


def maximise(
    problem: Problem,
    settings: SearchSettings | None = None,
    *,
    start: FloatArray | None = None,
    clock: Callable[[], float] | None = None,
    progress: Callable[[Progress], None] | None = None,
    is_cancelled: Callable[[], bool] | None = None,
    stage: str = "search",
) -> SearchOutcome:
    """The same as `search` for a `Problem`, over its window.

    ``start`` is a pose (theta, x, y) of the window to beat, its middle where None.
    """
    settings = settings or SearchSettings()
    return _Search(problem, settings, start, clock, progress, is_cancelled, stage).run()


class _Search:
    """One running search."""

    def __init__(
        self,
        problem: Problem,
        settings: SearchSettings,
        start: FloatArray | None,
        clock: Callable[[], float] | None,
        progress: Callable[[Progress], None] | None,
        is_cancelled: Callable[[], bool] | None,
        stage: str,
    ) -> None:
        self._problem, self._settings, self._clock = problem, settings, clock
        self._progress, self._is_cancelled, self._stage = progress, is_cancelled, stage
        self._start_s = clock() if clock else math.nan
        self._num_cells = 0
        self._dropped = -math.inf  # no box that a sweep excluded exceeds it
        self._max_slots = max(64, int(settings.max_memory_mb * 1e6 / _BOX_BYTES))
        slots = min(8192, self._max_slots)
        pose = problem.window[:3] if start is None else start
        self._state = kernels.State(
            boxes=np.empty((slots, 7)),
            keys=np.empty(slots),
            heap=np.arange(slots, dtype=np.int32),
            counters=np.zeros(3, dtype=np.int64),
            best=np.array([problem.value_at(pose)[0], *pose, 0.0, -math.inf]),
            found=np.full((_MAX_OPTIMA, 5), -math.inf),
            worth=np.ones(32),
        )
        weights = np.array([term.weights.sum() for term in problem.terms])
        most = problem.margin + float(weights @ problem.frames[:, 4])
        self._open(problem.window[None, :], np.array([most]), 0)

    def run(self) -> SearchOutcome:
        """The recipe."""
        self._sweep()
        status = self._prove()
        lower, upper = self._bounds()
        has_all_rivals = self._settings.keep >= 1.0
        if status is Status.CERTIFIED and not has_all_rivals:
            has_all_rivals = self._follow_rivals() is Status.CERTIFIED
        return self._outcome(status, lower, upper, has_all_rivals)

    def _sweep(self) -> None:
        """Put the boxes that a sweep leaves in place of the first one, if it fits the budgets."""
        p, settings, state = self._problem, self._settings, self._state
        max_tiles = int(settings.max_memory_mb * 1e6 / 4.0 / _TILE_BYTES)
        sweep = Sweep(p, min(max_tiles, settings.max_boxes, self._max_slots // SIDE**2))
        while sweep.advance(self._floor(), self._is_over):
            kernels.climb(p.sum, state, sweep.highest(_NUM_CENTRES), _NUM_CLIMBS)
            self._dropped = min(self._floor() + p.margin, float(state.keys[0]))
        if sweep.num_tiles:
            boxes, uppers = sweep.boxes(self._floor())
            self._num_cells = sweep.num_cells
            state.counters[kernels.NUM_BOXES] = sweep.num_tiles // 2  # what they cost
            self._open(boxes, np.minimum(uppers + p.margin, state.keys[0]), kernels.UNSEEN)
            self._tell()

    def _floor(self) -> float:
        """Sum below which nothing is of interest any more."""
        best, settings = float(self._state.best[0]), self._settings
        share = settings.keep if settings.keep < 1.0 else 1.0 / (1.0 - settings.gap)
        return (share * best if best > 0.0 else best) - self._problem.margin

    def _open(self, boxes: FloatArray, keys: FloatArray, axis: int) -> None:
        """Begin with these boxes (K, 6), which have their bounds in falling order."""
        while len(self._state.heap) < len(boxes) + 2:
            self._grow()
        state, count = self._state, len(boxes)
        state.boxes[:count, :6], state.boxes[:count, 6] = boxes, axis
        state.keys[:count] = keys  # from the highest down, which is a heap
        state.counters[kernels.NUM_OPEN] = count

    def _prove(self) -> Status:
        """Split the best box until the gap is closed."""
        p, gap, keep = self._problem, self._settings.gap, self._settings.keep
        return self._in_chunks(
            lambda count: kernels.prove(p.sum, p.bounds, self._state, gap, keep, count),
            self._settings.max_boxes,
        )

    def _follow_rivals(self) -> Status:
        """Follow every box that could hold a rival."""
        p, settings = self._problem, self._settings
        spent = int(self._state.counters[kernels.NUM_BOXES])
        self._stage = f"{self._stage}, rivals"
        return self._in_chunks(
            lambda count: kernels.follow_rivals(
                p.sum, p.bounds, self._state, settings.gap, settings.keep, p.radius, count
            ),
            min(settings.max_boxes, spent + int(settings.rival_share * spent)),
        )

    def _in_chunks(self, advance: Callable[[int], int], max_boxes: int) -> Status:
        """Go on until it is done or a budget is used up."""
        while True:
            left = max_boxes - int(self._state.counters[kernels.NUM_BOXES])
            stopped_for = advance(min(_CHUNK, max(left, 0)))
            status = None
            if stopped_for == kernels.DONE:
                status = Status.CERTIFIED
            elif stopped_for == kernels.FOUND_FULL or (
                stopped_for == kernels.HEAP_FULL and not self._grow()
            ):
                status = Status.MEMORY
            elif self._state.counters[kernels.NUM_BOXES] >= max_boxes:
                status = Status.BOXES
            elif self._is_late():
                status = Status.TIME
            self._tell()
            if status is None and self._is_cancelled and self._is_cancelled():
                status = Status.CANCELLED
            if status is not None:
                return status

    def _is_over(self) -> bool:
        return self._is_late() or bool(self._is_cancelled and self._is_cancelled())

    def _is_late(self) -> bool:
        clock = self._clock
        return clock is not None and clock() - self._start_s >= self._settings.max_seconds

    def _grow(self) -> bool:
        """Double the room for open boxes, within the memory allowed."""
        state, slots = self._state, len(self._state.heap)
        wanted = min(2 * slots, self._max_slots)
        if wanted <= slots:
            return False
        extra = wanted - slots
        self._state = state._replace(
            boxes=np.concatenate([state.boxes, np.empty((extra, 7))]),
            keys=np.concatenate([state.keys, np.empty(extra)]),
            heap=np.concatenate([state.heap, np.arange(slots, wanted, dtype=np.int32)]),
        )
        return True

    def _bounds(self) -> tuple[float, float]:
        best, margin = float(self._state.best[0]), self._problem.margin
        return best - margin, max(self._top(), self._dropped, best + margin)

    def _top(self) -> float:
        """Largest bound of an open box."""
        state = self._state
        is_open = state.counters[kernels.NUM_OPEN] > 0
        return float(state.keys[state.heap[0]]) if is_open else -math.inf

    def _tell(self) -> None:
        if self._progress:
            num_open, num_boxes, _ = self._state.counters.tolist()
            pose = self._problem.motion_of(*self._state.best[1:4])
            self._progress(Progress(self._stage, *self._bounds(), num_boxes, num_open, pose))

    def _outcome(
        self, status: Status, lower: float, upper: float, has_all_rivals: bool
    ) -> SearchOutcome:
        p, (_, _, _, _, best, found, _) = self._problem, self._state
        num_open, num_boxes, num_found = self._state.counters.tolist()
        value, pose = p.ascend(best[1:4])
        if value > best[0]:
            best[0], best[1:4] = value, pose
        lower = float(best[0]) - p.margin
        upper = max(upper, float(best[0]) + p.margin)
        found = np.vstack([[*best[:4], -math.inf], found[:num_found]])
        found = found[np.argsort(-found[:, 0], kind="stable")]
        undecided = max(self._top(), self._floor() + p.margin, self._dropped)
        neighborhoods = Neighborhoods.of(p, found, undecided, float(best[5]))
        distinct = found[neighborhoods.apart_from_better(0.2 * p.reach)]
        poses = [p.motion_of(*row[1:4]) for row in distinct]
        return SearchOutcome(
            T_target_source=p.motion_of(*best[1:4]),
            pose=best[1:4].copy(),
            lower_bound=lower,
            upper_bound=upper,
            status=status,
            num_boxes=num_boxes,
            num_cells=self._num_cells,
            num_open_boxes=num_open,
            seconds=self._clock() - self._start_s if self._clock else math.nan,
            optima=np.array(
                [[v, t.x, t.y, t.yaw] for v, t in zip(distinct[:, 0], poses, strict=True)]
            ),
            rivals=neighborhoods.rivals(self._settings.keep * lower),
            upper_elsewhere=min(upper, neighborhoods.upper_elsewhere),
            has_all_rivals=has_all_rivals,
            neighborhoods=neighborhoods,
            open_poses=self._open_poses() if status is not Status.CERTIFIED else np.empty((0, 3)),
        )

    def _open_poses(self) -> FloatArray:
        """Middles of the most promising open boxes."""
        state = self._state
        slots = state.heap[: int(state.counters[kernels.NUM_OPEN])]
        order = np.argsort(-state.keys[slots], kind="stable")[:_NUM_OPEN_POSES]
        return state.boxes[slots[order], :3]
