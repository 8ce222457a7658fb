"""Registration of two occupancy maps: search, certificate, refinement, verdict."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.features.grid_filter import CellEvidence, clean_cells, coarsen
from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.registration.grid_config import GridRegistrationConfig
from uw_dslam_ros2.core.registration.grid_landscape import distinct, scan_landscape
from uw_dslam_ros2.core.registration.grid_problem import GridProblem, PoseWindow, build_problem
from uw_dslam_ros2.core.registration.grid_search import (
    SearchLimits,
    SearchOutcome,
    search_poses,
    whole_plane,
)
from uw_dslam_ros2.core.registration.paper_grids import register_grids_by_points
from uw_dslam_ros2.core.registration.refine_grids import (
    WallMap,
    measure_agreement,
    pose_covariance,
    slide_share,
)
from uw_dslam_ros2.core.registration.result import (
    PriorWindow,
    Progress,
    RegistrationResult,
    Rival,
    Verdict,
)
from uw_dslam_ros2.core.registration.verdict import MatchEvidence, decide
from uw_dslam_ros2.core.se2 import SE2, wrap_angle

__all__ = ["GridRegistrationConfig", "match_evidence", "register_grids"]

FloatArray = NDArray[np.float64]
Clock = Callable[[], float]

_NUM_CANDIDATES = 24
_NUM_REFINED = 8
_FINE_POINTS = 1200
_FINE_SIGMA_CELLS = 2.0
_LEAST_SIDE_CELLS = 4
_NUM_BOXES_OF_REFUSED = 20_000
_RIVAL_SHARE = 0.5
_SLIDE_CELLS = 10.0
# Errors of neighbouring wall cells go together: bends, and one wall seen from one place.
_CELLS_PER_PAIR = 40.0
_RESIDUAL_CELLS = 0.95


def register_grids(
    source: OccupancyMap,
    target: OccupancyMap,
    config: GridRegistrationConfig | None = None,
    *,
    prior: PriorWindow | None = None,
    clock: Clock | None = None,
    progress: Callable[[Progress], None] | None = None,
    is_cancelled: Callable[[], bool] | None = None,
) -> RegistrationResult:
    """Find the motion that lays the source map on the target map.

    Parameters
    ----------
    source, target
        Maps of any sizes, resolutions and origins, rotated ones included.
    config
        Settings; the defaults where None.
    prior
        Search only there; all of SE(2) where None.
    clock
        Seconds from any start; without it there is no time limit and `RegistrationResult.seconds`
        is NaN.
    progress, is_cancelled
        Called some times a second from this thread; a cancelled search answers BUDGET_EXHAUSTED.

    Returns
    -------
    RegistrationResult
        ``T_target_source`` takes metres in the source grid's frame to metres in the target grid's
        frame.

    Raises
    ------
    InvalidInputError
        Where a prior's widths are not positive.
    """
    config = config or GridRegistrationConfig()
    if config.method == "paper":
        return register_grids_by_points(
            source, target, config,
            prior=prior, clock=clock, progress=progress, is_cancelled=is_cancelled,
        )  # fmt: skip
    match = _GridMatch(source, target, config, prior, clock)
    return match.run(progress, is_cancelled)


def match_evidence(
    source: OccupancyMap, target: OccupancyMap, config: GridRegistrationConfig | None = None
) -> tuple[MatchEvidence, SE2] | None:
    """What `register_grids` would judge by, and its best pose, without the proof; for studies.

    None where a map holds too little to be matched.
    """
    match = _GridMatch(source, target, config or GridRegistrationConfig(), None, None)
    return match.collect()


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    pose: FloatArray
    score: float


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    # What the evidence refuses anyway gets a short search, which may find better.

    refined: list[_Candidate]
    shares: tuple[float, ...]
    evidence: MatchEvidence


class _GridMatch:
    """One registration; the steps of the recipe in `run`."""

    def __init__(
        self,
        source: OccupancyMap,
        target: OccupancyMap,
        config: GridRegistrationConfig,
        prior: PriorWindow | None,
        clock: Clock | None,
    ) -> None:
        if prior is not None and not (prior.half_width_m > 0.0 and prior.half_width_rad > 0.0):
            raise InvalidInputError(
                f"the prior's half-widths are {prior.half_width_m} m and "
                f"{prior.half_width_rad} rad, expected positive numbers"
            )
        self._source, self._target = source, target
        self._config, self._prior, self._clock = config, prior, clock
        self._start_s = clock() if clock is not None else math.nan

    def run(
        self,
        progress: Callable[[Progress], None] | None,
        is_cancelled: Callable[[], bool] | None,
    ) -> RegistrationResult:
        """The recipe."""
        for name, occupancy in (("source", self._source), ("target", self._target)):
            if max(occupancy.spec.shape) > self._config.max_side_cells:
                rows, cols = occupancy.spec.shape
                return self._refused(
                    Verdict.BUDGET_EXHAUSTED,
                    f"the {name} map has {rows} x {cols} cells, more than the limit of "
                    f"{self._config.max_side_cells} on a side",
                )
        resolution_m = self._finest_resolution()
        sides = []
        for name, occupancy in (("source", self._source), ("target", self._target)):
            cells = clean_cells(occupancy)
            if (fault := _too_little(name, occupancy, cells, self._config)) is not None:
                return self._refused(Verdict.TOO_FEW_FEATURES, fault)
            sides.append(coarsen(cells, resolution_m))
        levels = self._levels(sides[0], sides[1])
        window = self._window(levels[0])
        candidates, surprise = self._scan(levels[0], window)
        found = self._weigh(sides, levels, self._refine(levels, candidates), surprise)
        verdict, _, _ = decide(found.evidence, self._config)
        # A match that the evidence refuses anyway gets a short search, in case it finds a better
        # one.
        num_boxes = self._config.max_boxes
        if verdict is not Verdict.ACCEPTED:
            num_boxes = min(num_boxes, _NUM_BOXES_OF_REFUSED)
        outcome = self._certify(
            levels[0], window, candidates[0].pose, num_boxes, progress, is_cancelled
        )
        if outcome.lower_bound > candidates[0].score * (1.0 + 1e-6):
            candidates = _merge_best(levels[0], candidates, outcome)
            found = self._weigh(sides, levels, self._refine(levels, candidates), surprise)
        return self._answer(levels, outcome, found)

    def collect(self) -> tuple[MatchEvidence, SE2] | None:
        """Evidence for the best pose, and the pose; None where a map holds too little."""
        resolution_m = self._finest_resolution()
        sides = []
        for name, occupancy in (("source", self._source), ("target", self._target)):
            cells = clean_cells(occupancy)
            if _too_little(name, occupancy, cells, self._config) is not None:
                return None
            sides.append(coarsen(cells, resolution_m))
        levels = self._levels(sides[0], sides[1])
        candidates, surprise = self._scan(levels[0], self._window(levels[0]))
        found = self._weigh(sides, levels, self._refine(levels, candidates), surprise)
        return found.evidence, self._to_frame(levels[-1].to_motion(found.refined[0].pose))

    def _scan(self, problem: GridProblem, window: PoseWindow) -> tuple[list[_Candidate], float]:
        """Candidates of the whole window, best first, and how far the best stands out."""
        landscape = scan_landscape(problem, _NUM_CANDIDATES, window)
        candidates = _climb(problem, landscape.poses)
        candidates = [c for c in candidates if _is_inside(window, c.pose)]
        if not candidates:
            candidates = [_Candidate(window.middle, problem.value(window.middle))]
        return candidates, _surprise(candidates, problem.radius)

    def _finest_resolution(self) -> float:
        specs = (self._source.spec, self._target.spec)
        longest_m = max(max(spec.shape) * spec.resolution_m for spec in specs)
        coarser = max(spec.resolution_m for spec in specs)
        # A whole multiple, whose sums are quick.
        return coarser * math.ceil(longest_m / coarser / self._config.finest_cells - 1e-9)

    def _levels(self, source: CellEvidence, target: CellEvidence) -> list[GridProblem]:
        """Problems from the searched lattice to the finest one."""
        longest = max(*source.shape, *target.shape)
        stride = max(1, math.ceil(longest / self._config.working_cells))
        strides = [stride]
        while strides[-1] > 1:
            strides.append(max(1, strides[-1] // 2))
        levels = []
        for stride in strides:
            is_search = stride == strides[0]
            levels.append(
                build_problem(
                    source,
                    target,
                    stride=stride,
                    sigma_cells=self._config.sigma_cells if stride > 1 else _FINE_SIGMA_CELLS,
                    free_penalty=self._config.free_penalty,
                    max_points=self._config.max_points if is_search else _FINE_POINTS,
                )
            )
        return levels

    def _window(self, problem: GridProblem) -> PoseWindow:
        """Poses that a prior allows, or all."""
        plane = whole_plane(problem)
        if self._prior is None:
            return plane
        middle = problem.to_pose(self._to_grid(self._prior.T_target_source))
        half_rad = min(self._prior.half_width_rad, math.pi)
        # The prior speaks of where the source's frame lands, the pose of where its centre does.
        T_grid_frame = self._source.spec.T_frame_grid.inverse()
        origin = np.array([T_grid_frame.x, T_grid_frame.y]) / problem.resolution_m - 0.5
        arm = float(np.hypot(*(problem.center - origin)))
        yaw = self._target.spec.T_frame_grid.yaw
        spread = (abs(math.cos(yaw)) + abs(math.sin(yaw))) * self._prior.half_width_m
        half = spread / problem.resolution_m + 2.0 * arm * math.sin(0.5 * half_rad)
        low = np.maximum(middle[1:] - half, plane.middle[1:] - plane.half[1:])
        high = np.minimum(middle[1:] + half, plane.middle[1:] + plane.half[1:])
        high = np.maximum(high, low + 1.0)
        return PoseWindow(
            np.array([middle[0], *(0.5 * (low + high))]),
            np.array([half_rad, *(0.5 * (high - low))]),
        )

    def _to_grid(self, T_target_source: SE2) -> SE2:
        """Motion between frames to motion between the grids' own axes."""
        target, source = self._target.spec.T_frame_grid, self._source.spec.T_frame_grid
        return target.inverse() @ T_target_source @ source

    def _to_frame(self, T_grids: SE2) -> SE2:
        target, source = self._target.spec.T_frame_grid, self._source.spec.T_frame_grid
        return target @ T_grids @ source.inverse()

    def _certify(
        self,
        problem: GridProblem,
        window: PoseWindow,
        start: FloatArray,
        num_boxes: int,
        progress: Callable[[Progress], None] | None,
        is_cancelled: Callable[[], bool] | None,
    ) -> SearchOutcome:
        def should_stop() -> bool:
            if is_cancelled is not None and is_cancelled():
                return True
            clock = self._clock
            return clock is not None and clock() - self._start_s > self._config.max_seconds

        def report(
            pose: FloatArray, lower: float, upper: float, num_boxes: int, num_open: int
        ) -> None:
            if progress is not None:
                motion = self._to_frame(problem.to_motion(pose))
                progress(Progress("search", lower, upper, num_boxes, num_open, motion))

        limits = SearchLimits(self._config.gap, num_boxes, should_stop)
        return search_poses(problem, window, start, limits, report)

    def _refine(self, levels: list[GridProblem], candidates: list[_Candidate]) -> list[_Candidate]:
        """The candidates' maxima on the finest level, best first, apart from each other."""
        refined = candidates[:_NUM_REFINED]
        for coarse, fine in itertools.pairwise(levels):
            poses = [fine.to_pose(coarse.to_motion(c.pose)) for c in refined]
            refined = _climb(fine, np.array(poses))
        return refined

    def _weigh(
        self,
        sides: list[CellEvidence],
        levels: list[GridProblem],
        refined: list[_Candidate],
        surprise: float,
    ) -> _Found:
        """Evidence for the best of refined candidates."""
        finest, best = levels[-1], refined[0]
        T_grids = finest.to_motion(best.pose)
        scale = 1.0 / finest.resolution_m
        T_cells = SE2(T_grids.x * scale, T_grids.y * scale, T_grids.yaw)
        agreement = measure_agreement(WallMap(sides[0]), WallMap(sides[1]), T_cells)
        shares = [c.score / best.score if best.score > 0.0 else 1.0 for c in refined[1:]]
        evidence = MatchEvidence(
            agreement=agreement,
            score=best.score,
            surprise=surprise,
            rival_share=max(shares, default=0.0),
            slide_share=slide_share(finest, best.pose, _SLIDE_CELLS),
        )
        return _Found(refined, tuple(shares), evidence)

    def _answer(
        self, levels: list[GridProblem], outcome: SearchOutcome, found: _Found
    ) -> RegistrationResult:
        work, finest = levels[0], levels[-1]
        pose, agreement = found.refined[0].pose, found.evidence.agreement
        verdict, reason, probability = decide(found.evidence, self._config)
        if outcome.is_stopped or (verdict is Verdict.ACCEPTED and not outcome.is_complete):
            verdict = Verdict.BUDGET_EXHAUSTED
            reason = (
                f"stopped after {outcome.num_boxes} boxes with a gap of "
                f"{1.0 - outcome.lower_bound / max(outcome.upper_bound, 1e-12):.0%}, "
                f"expected {self._config.gap:.0%}"
            )
        motion = self._to_frame(finest.to_motion(pose))
        bound = outcome.upper_bound / max(outcome.lower_bound, 1e-12)
        rivals = tuple(
            Rival(self._to_frame(finest.to_motion(c.pose)), share, bound)
            for c, share in zip(found.refined[1:], found.shares, strict=True)
            if share > _RIVAL_SHARE
        )
        source_points = work.source_points + work.center
        return RegistrationResult(
            verdict=verdict,
            reason=reason,
            T_target_source=motion,
            covariance=self._covariance(finest, pose, found.evidence, motion),
            probability=probability,
            score=outcome.lower_bound,
            lower_bound=outcome.lower_bound,
            upper_bound=outcome.upper_bound,
            is_certified=outcome.is_complete,
            num_boxes=outcome.num_boxes,
            seconds=self._elapsed(),
            overlap=agreement.overlap,
            conflict_ratio=agreement.conflict,
            inlier_ratio=agreement.inlier_ratio,
            num_source_points=len(work.source_points),
            num_target_points=len(work.target_points),
            rivals=rivals,
            source_points=self._points(source_points, work.resolution_m, self._source),
            target_points=self._points(work.target_points, work.resolution_m, self._target),
        )

    def _covariance(
        self, problem: GridProblem, pose: FloatArray, evidence: MatchEvidence, motion: SE2
    ) -> FloatArray:
        """Covariance of ``T_target_source`` [m, m, rad] from that of the pose."""
        agreement = evidence.agreement
        # Bent maps leave larger residuals, and their errors are common to whole walls: on
        # simulated pairs the variance grows with the fourth power of the residual
        # .
        growth = max((agreement.residual_cells / _RESIDUAL_CELLS) ** 4, 0.05)
        num_pairs = max(agreement.num_walls, 1) / (_CELLS_PER_PAIR * growth)
        covariance = pose_covariance(
            problem, pose, num_pairs, _FINE_SIGMA_CELLS, evidence.slide_share
        )
        rotation = self._target.spec.T_frame_grid.rotation()
        center = self._points(problem.center[None, :], problem.resolution_m, self._source)[0]
        arm = motion.rotation() @ center
        jacobian = np.zeros((3, 3))
        jacobian[:2, 1:] = rotation * problem.resolution_m
        jacobian[:2, 0] = (arm[1], -arm[0])  # d(t - R c) / d theta
        jacobian[2, 0] = 1.0
        return jacobian @ covariance @ jacobian.T

    @staticmethod
    def _points(cells: FloatArray, resolution_m: float, occupancy: OccupancyMap) -> FloatArray:
        return occupancy.spec.T_frame_grid.apply((cells + 0.5) * resolution_m)

    def _elapsed(self) -> float:
        return self._clock() - self._start_s if self._clock is not None else math.nan

    def _refused(self, verdict: Verdict, reason: str) -> RegistrationResult:
        """An answer without a search; the guess is the prior, or lays centre on centre."""
        if self._prior is not None:
            motion = self._prior.T_target_source
        else:
            source, target = (m.spec.corners().mean(axis=0) for m in (self._source, self._target))
            motion = SE2(float(target[0] - source[0]), float(target[1] - source[1]), 0.0)
        return RegistrationResult(
            verdict=verdict,
            reason=reason,
            T_target_source=motion,
            covariance=np.diag([1e6, 1e6, math.pi**2]),
            probability=0.0,
            score=0.0,
            lower_bound=0.0,
            upper_bound=1.0,
            is_certified=False,
            num_boxes=0,
            seconds=self._elapsed(),
            overlap=math.nan,
            conflict_ratio=math.nan,
            inlier_ratio=0.0,
            num_source_points=0,
            num_target_points=0,
        )


def _too_little(
    name: str, occupancy: OccupancyMap, cells: CellEvidence, config: GridRegistrationConfig
) -> str | None:
    """What a map lacks for matching, as a sentence, or None."""
    rows, cols = occupancy.spec.shape
    if min(rows, cols) < _LEAST_SIDE_CELLS:
        return f"the {name} map has {rows} x {cols} cells, expected at least {_LEAST_SIDE_CELLS}"
    if not occupancy.known.any():
        return f"the {name} map is unknown everywhere"
    num_walls = int((cells.wall > 0.25).sum())
    share = float((occupancy.values >= 60).mean())
    if share > 0.6:
        return f"the {name} map is occupied in {share:.0%} of its cells, so it shows no surface"
    if num_walls < config.min_wall_cells:
        return (
            f"the {name} map has {num_walls} wall cells after filtering, "
            f"expected at least {config.min_wall_cells}"
        )
    return None


def _climb(problem: GridProblem, poses: FloatArray) -> list[_Candidate]:
    """Local maxima from poses (K, 3), best first, apart from each other."""
    climbed = [_Candidate(*problem.ascend(pose)) for pose in poses]
    climbed.sort(key=lambda c: -c.score)
    if not climbed:
        return []
    stacked = np.array([c.pose for c in climbed])
    return [climbed[k] for k in distinct(stacked, problem.radius, 4.0, len(climbed))]


def _is_inside(window: PoseWindow, pose: FloatArray) -> bool:
    offset = pose - window.middle
    offset[0] = wrap_angle(float(offset[0]))
    return bool((np.abs(offset) <= window.half + 1e-9).all())


def _merge_best(
    problem: GridProblem, candidates: list[_Candidate], outcome: SearchOutcome
) -> list[_Candidate]:
    merged = [_Candidate(outcome.pose, outcome.lower_bound), *candidates]
    stacked = np.array([c.pose for c in merged])
    return [merged[k] for k in distinct(stacked, problem.radius, 1.0, len(merged))]


def _surprise(candidates: list[_Candidate], radius: float) -> float:
    """How far the best candidate lies above those elsewhere, in their standard deviations.

    The others are the best that chance reaches at other poses of these two maps.
    """
    best = candidates[0]
    others = [
        c.score
        for c in candidates[1:]
        if abs(wrap_angle(float(c.pose[0] - best.pose[0]))) * radius > 4.0
        or np.hypot(*(c.pose[1:] - best.pose[1:])) > 4.0
    ]
    if len(others) < 4:
        return 0.0
    spread = max(float(np.std(others)), 0.02 * best.score, 1e-9)
    return float((best.score - np.mean(others)) / spread)
