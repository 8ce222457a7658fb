"""Registration of two point sets, from points to verdict.

With ``method="likelihood"`` a ladder of kernels is searched, wide to narrow. Every promising
optimum of a rung is refined together with its noise and clutter share, and weighed against chance;
the ladder ends as soon as the evidence is decisive. With ``method="gmrbnb"`` the paper's
Algorithms 3 and 4 run: search of the plain sum of Gaussians, inliers by nearest-neighbour density,
search on the inliers. Score and bounds belong to the search that found the pose.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.registration.branch_and_bound import (
    Problem,
    SearchOutcome,
    SearchSettings,
    Status,
    Term,
    as_points,
    objective_at,
    search,
)
from uw_dslam_ros2.core.registration.config import RegistrationConfig
from uw_dslam_ros2.core.registration.field import likelihood_field, mixture_field
from uw_dslam_ros2.core.registration.nnde import nnde_inliers
from uw_dslam_ros2.core.registration.point_verdict import PoseHypothesis, decide_points, posterior
from uw_dslam_ros2.core.registration.refine import (
    PointModel,
    Refinement,
    evaluate_pose,
    polish,
    pose_evidence,
    refine,
)
from uw_dslam_ros2.core.registration.result import (
    PriorWindow,
    Progress,
    RegistrationResult,
    Rival,
    Verdict,
)
from uw_dslam_ros2.core.se2 import SE2, wrap_angle

__all__ = ["register_point_sets"]

FloatArray = NDArray[np.float64]

_LADDER = (0.75, 0.3, 0.1)  # kernels, in mean spacings of the target points
_LATER_BOXES = 100_000  # a narrower kernel only has to offer candidates, not a proof
_MAX_CANDIDATES = 48
_TWIN = 0.7  # a pose that explains the points as well as a decisive one scores at least this much
_USUAL_SIGMA = 0.25  # noise that is nothing special, in mean spacings of the target points
_DECISIVE = 1e-6  # probability of chance below which narrower kernels need not be tried


@dataclass(frozen=True, slots=True, eq=False)
class _Cloud:
    """One side: points about their own centre."""

    points: FloatArray
    weights: FloatArray
    sigmas_m: FloatArray | None
    center: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Rung:
    """One search and the refined poses it led to, best evidence first."""

    sigma_m: float
    terms: list[Term]
    outcome: SearchOutcome
    unit: float  # what a perfect match of all source weight scores
    error: float  # between the field and its formula, for all source weight
    candidates: list[tuple[float, Refinement]]


def register_point_sets(
    source: ArrayLike,
    target: ArrayLike,
    config: RegistrationConfig | None = None,
    *,
    source_weights: ArrayLike | None = None,
    target_weights: ArrayLike | None = None,
    source_sigma_m: ArrayLike | None = None,
    target_sigma_m: ArrayLike | None = None,
    prior: PriorWindow | None = None,
    clock: Callable[[], float] | None = None,
    progress: Callable[[Progress], None] | None = None,
    is_cancelled: Callable[[], bool] | None = None,
) -> RegistrationResult:
    """Align two sets of points of the plane, without a guess at their poses, and prove it.

    Parameters
    ----------
    source, target : (m, 2), (n, 2)
        Points [m], in any frames; large offsets (UTM) do no harm.
    config : RegistrationConfig
        Method, kernel, gap and budgets.
    source_weights, target_weights : (m,), (n,)
        Mixture weights > 0; equal without.
    source_sigma_m, target_sigma_m : (m,), (n,)
        Standard deviation of each point [m], > 0; ``config.sigma`` without.
    prior : PriorWindow
        Search only there.
    clock : callable
        Seconds, monotonic; without it there is no time limit and ``seconds`` is NaN.
    progress, is_cancelled : callable
        Called every few thousand boxes with both bounds; a true answer stops the search.
    """
    config = config or RegistrationConfig()
    first = _cloud("source", source, source_weights, source_sigma_m)
    second = _cloud("target", target, target_weights, target_sigma_m)
    start = clock() if clock else math.nan
    if min(len(first.points), len(second.points)) < config.min_points:
        return _too_few(first, second, config, math.nan if clock is None else clock() - start)
    match = _Match(first, second, config, prior, clock, progress, is_cancelled)
    return match.result(start)


class _Match:
    """One match on its way from points to result."""

    def __init__(
        self,
        source: _Cloud,
        target: _Cloud,
        config: RegistrationConfig,
        prior: PriorWindow | None,
        clock: Callable[[], float] | None,
        progress: Callable[[Progress], None] | None,
        is_cancelled: Callable[[], bool] | None,
    ) -> None:
        self._config = config
        self._clock = clock
        self._progress = progress
        self._is_cancelled = is_cancelled
        self._start = clock() if clock else math.nan
        # The search costs as many look-ups per box as there are source points: take the smaller
        # set.
        self._is_swapped = prior is None and len(source.points) > len(target.points)
        self._source, self._target = (target, source) if self._is_swapped else (source, target)
        self._prior = self._centred_prior(prior)
        points = self._target.points
        self._area_m2 = _area(points)
        self._spacing_m = math.sqrt(self._area_m2 / len(points))
        self._arm_m = max(float(np.sqrt((self._source.points**2).sum(axis=1).mean())), 1e-12)
        extent = float(np.ptp(points, axis=0).max()) + self._arm_m
        self._model = PointModel.of(
            self._source.points, points, self._area_m2, 1e-6 * extent, 2.0 * self._spacing_m,
            self._source.weights, self._target.weights,
        )  # fmt: skip
        self._volume = self._searched_volume(points)
        self._usual_m = _USUAL_SIGMA * self._spacing_m

    def _centred_prior(self, prior: PriorWindow | None) -> PriorWindow | None:
        if prior is None:
            return None
        # The source keeps its frame, for the window is about that frame's origin.
        source = self._source
        self._source = replace(source, points=source.points + source.center, center=np.zeros(2))
        guess = prior.T_target_source
        cx, cy = self._target.center
        return replace(prior, T_target_source=SE2(guess.x - cx, guess.y - cy, guess.yaw))

    def _searched_volume(self, points: FloatArray) -> float:
        """Volume of (theta, x, y) in which the sets could overlap by half."""
        if self._prior is not None:
            half = self._prior.half_width_m
            return 2.0 * min(self._prior.half_width_rad, math.pi) * 4.0 * half * half
        return 2.0 * math.pi * float(np.prod(np.ptp(points, axis=0) + 2.0 * self._arm_m))

    def result(self, start: float) -> RegistrationResult:
        """Search, refine, decide."""
        rungs = self._likelihood() if self._config.method == "likelihood" else self._gmrbnb()
        hypotheses = self._merged(rungs)
        hypotheses[0] = self._polished(hypotheses[0])
        if posterior([hypotheses[0][0]]) < self._config.min_probability:
            hypotheses = self._distinct_from(self._guess(rungs), hypotheses)
        return self._packed(rungs[0], hypotheses, sum(r.outcome.num_boxes for r in rungs), start)

    def _guess(self, rungs: list[_Rung]) -> tuple[float, Refinement]:
        """Where nothing is certain: the optimum that stands out most among those of its kernel."""
        margins = [self._margin(rung) for rung in rungs]
        rung = rungs[int(np.argmax(margins))]
        pose = rung.outcome.T_target_source
        refinement = evaluate_pose(self._model, pose, rung.sigma_m)
        return min(self._evidence(refinement), 0.0), refinement

    def _margin(self, rung: _Rung) -> float:
        best, *others = rung.outcome.optima
        top = rung.outcome.T_target_source
        for value, x, y, theta in others:
            if self._is_apart(top, SE2(x, y, theta)):
                return float(best[0] - value)
        return float(best[0])

    def _distinct_from(
        self, first: tuple[float, Refinement], others: list[tuple[float, Refinement]]
    ) -> list[tuple[float, Refinement]]:
        pose = first[1].pose()
        return [first, *(pair for pair in others if self._is_apart(pose, pair[1].pose()))]

    def _likelihood(self) -> list[_Rung]:
        """Rungs of the ladder, until one is decisive."""
        rungs: list[_Rung] = []
        for sigma_m in self._ladder():
            limit = _LATER_BOXES if rungs else self._config.max_boxes
            rungs.append(self._rung(sigma_m, limit))
            if rungs[-1].outcome.status in (Status.TIME, Status.CANCELLED):
                break
            if self._is_decisive([r.candidates[0] for r in rungs]):
                break
        return rungs

    def _ladder(self) -> Sequence[float | None]:
        if self._source.sigmas_m is not None or self._target.sigmas_m is not None:
            return (None,)
        if self._config.sigma > 0.0:
            return (math.sqrt(2.0) * self._config.sigma,)
        return tuple(step * self._spacing_m for step in _LADDER)

    def _settings(self, max_boxes: int) -> SearchSettings:
        config = self._config
        max_boxes = min(max_boxes, config.max_boxes)
        left = math.inf
        if config.max_seconds > 0.0 and self._clock:
            left = max(config.max_seconds - (self._clock() - self._start), 0.0)
        return SearchSettings(config.gap, max_boxes, left, config.max_memory_mb)

    def _rung(self, sigma_m: float | None, max_boxes: int) -> _Rung:
        """Search with one kernel (None: each point its own) and refine what was met."""
        share = 1.0 - self._config.clutter_share
        n = len(self._target.points)
        terms = []
        for points, weights, sigmas_m in self._classes(sigma_m, self._source, self._target):
            width = float(np.sqrt(np.mean(sigmas_m**2)))
            contrast = share / (1.0 - share) * self._area_m2 / (n * 2.0 * math.pi * width**2)
            field = likelihood_field(
                self._target.points, self._target.weights * (width / sigmas_m) ** 2, sigmas_m,
                contrast, max_nodes=self._max_nodes(),
            )  # fmt: skip
            terms.append(Term(points, weights * math.log1p(contrast), field))
        unit = sum(float(term.weights.sum()) for term in terms)
        outcome = self._search(terms, "search", max_boxes)
        start = sigma_m if sigma_m is not None else width
        return _Rung(start, terms, outcome, unit, 0.0, self._refined(outcome, start))

    def _classes(
        self, sigma_m: float | None, source: _Cloud, target: _Cloud
    ) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
        """Source points of equal standard deviation, with that of their pairs (n,)."""
        n = len(target.points)
        if sigma_m is not None:
            return [(source.points, source.weights, np.full(n, sigma_m))]
        own = self._config.sigma or 0.5 * self._spacing_m / math.sqrt(2.0)
        first = (
            source.sigmas_m if source.sigmas_m is not None else np.full(len(source.points), own)
        )
        second = target.sigmas_m if target.sigmas_m is not None else np.full(n, own)
        return [
            (source.points[first == s], source.weights[first == s], np.sqrt(s * s + second**2))
            for s in np.unique(first)
        ]

    def _max_nodes(self) -> int:
        return max(10_000, int(self._config.max_memory_mb * 1e6 / 2.0 / 40.0))

    def _search(self, terms: list[Term], stage: str, max_boxes: int) -> SearchOutcome:
        return search(
            terms, self._settings(max_boxes), prior=self._prior, clock=self._clock,
            progress=self._progress, is_cancelled=self._is_cancelled, stage=stage,
        )  # fmt: skip

    def _refined(self, outcome: SearchOutcome, sigma_m: float) -> list[tuple[float, Refinement]]:
        """Refined optima with their evidence, best first, each pose once."""
        found: list[tuple[float, Refinement]] = []
        for value, x, y, theta in outcome.optima[:_MAX_CANDIDATES]:
            if value < _TWIN * outcome.optima[0, 0] and found and self._is_decisive(found):
                break
            refinement = refine(
                self._model, np.array([theta, x, y]), sigma_m, self._volume, self._usual_m
            )
            if self._is_outside(refinement.pose()):
                continue
            found.append((self._evidence(refinement), refinement))
        if not found:
            pose = outcome.T_target_source
            refinement = evaluate_pose(self._model, pose, sigma_m)
            found = [(self._evidence(refinement), refinement)]
        return self._distinct(found)

    @staticmethod
    def _is_decisive(found: list[tuple[float, Refinement]]) -> bool:
        return posterior([max(evidence for evidence, _ in found)]) > 1.0 - _DECISIVE

    def _evidence(self, refinement: Refinement) -> float:
        return pose_evidence(refinement, self._volume, self._usual_m)

    def _is_outside(self, pose: SE2) -> bool:
        if self._prior is None:
            return False
        guess, slack = self._prior.T_target_source, 1.0 + 1e-9
        limit = self._prior.half_width_m * slack
        turn = abs(wrap_angle(pose.yaw - guess.yaw))
        return (
            max(abs(pose.x - guess.x), abs(pose.y - guess.y)) > limit
            or turn > self._prior.half_width_rad * slack
        )

    def _distinct(self, found: list[tuple[float, Refinement]]) -> list[tuple[float, Refinement]]:
        found = sorted(found, key=lambda pair: -pair[0])
        kept: list[tuple[float, Refinement]] = []
        for pair in found:
            if all(self._is_apart(pair[1].pose(), other.pose()) for _, other in kept):
                kept.append(pair)
        return kept

    def _is_apart(self, a: SE2, b: SE2) -> bool:
        translation, rotation = a.distance_to(b)
        return translation + rotation * self._arm_m > 0.5 * self._spacing_m

    def _polished(self, pair: tuple[float, Refinement]) -> tuple[float, Refinement]:
        refinement = polish(self._model, pair[1])
        if self._is_outside(refinement.pose()):
            return pair
        evidence = self._evidence(refinement)
        return (evidence, refinement) if evidence >= pair[0] - 1.0 else pair

    def _merged(self, rungs: list[_Rung]) -> list[tuple[float, Refinement]]:
        return self._distinct([pair for rung in rungs for pair in rung.candidates])

    def _gmrbnb(self) -> list[_Rung]:
        """The paper's two passes."""
        own = self._config.sigma or 0.5 * self._spacing_m / math.sqrt(2.0)
        sigma_m = None if self._ladder() == (None,) else math.sqrt(2.0) * own
        rung = self._mixture_rung(sigma_m, self._source, self._target, "search")
        moved = rung.outcome.T_target_source.apply(self._source.points)
        config = self._config
        is_near = [
            nnde_inliers(a, b, config.nnde_neighbors, config.nnde_threshold, own)
            for a, b in ((moved, self._target.points), (self._target.points, moved))
        ]
        if min(int(mask.sum()) for mask in is_near) < self._config.min_points:
            return [rung]
        source, target = (
            _subset(cloud, mask)
            for cloud, mask in zip((self._source, self._target), is_near, strict=True)
        )
        again = self._mixture_rung(sigma_m, source, target, "inliers")
        return [replace(rung, candidates=self._merged([rung, again]))]

    def _mixture_rung(
        self, sigma_m: float | None, source: _Cloud, target: _Cloud, stage: str
    ) -> _Rung:
        terms, error = [], 0.0
        for points, weights, sigmas_m in self._classes(sigma_m, source, target):
            field = mixture_field(
                target.points, target.weights, sigmas_m, max_nodes=self._max_nodes()
            )
            terms.append(Term(points, weights, field))
            error += float(weights.sum()) * field.error
        unit = sum(float(term.weights.sum()) for term in terms) * float(target.weights.max())
        outcome = self._search(terms, stage, self._config.max_boxes)
        width = sigma_m if sigma_m is not None else float(np.sqrt(np.mean(sigmas_m**2)))
        return _Rung(width, terms, outcome, unit, error, self._refined(outcome, width))

    def _packed(
        self,
        rung: _Rung,
        hypotheses: list[tuple[float, Refinement]],
        num_boxes: int,
        start: float,
    ) -> RegistrationResult:
        outcome, best = rung.outcome, hypotheses[0][1]
        lower = (outcome.lower_bound - rung.error) / rung.unit
        upper = (outcome.upper_bound + rung.error) / rung.unit
        gap = max(0.0, 1.0 - lower / upper) if upper > 0.0 else 0.0
        verdict, reason, probability = decide_points(
            [PoseHypothesis(e, _covariance(r)) for e, r in hypotheses],
            is_complete=outcome.status is Status.CERTIFIED,
            gap=gap,
            spacing_m=self._spacing_m,
            arm_m=self._arm_m,
            min_probability=self._config.min_probability,
        )
        pose = self._full_pose(best.pose())
        source, target = self._source, self._target
        source_points, target_points = source.points + source.center, target.points + target.center
        if self._is_swapped:
            source_points, target_points = target_points, source_points
        is_inlier = _has_partner(pose.apply(source_points), target_points, best, self._spacing_m)
        return RegistrationResult(
            verdict=verdict,
            reason=reason,
            T_target_source=pose,
            covariance=self._full_covariance(best, pose),
            probability=probability,
            score=min(objective_at(rung.terms, best.pose()) / rung.unit, upper),
            lower_bound=lower,
            upper_bound=upper,
            is_certified=outcome.status is Status.CERTIFIED,
            num_boxes=num_boxes,
            seconds=self._clock() - start if self._clock else math.nan,
            overlap=math.nan,
            conflict_ratio=math.nan,
            inlier_ratio=float(is_inlier.mean()),
            num_source_points=len(source_points),
            num_target_points=len(target_points),
            rivals=self._rivals(rung, hypotheses),
            source_points=source_points,
            target_points=target_points,
            is_inlier=is_inlier,
        )

    def _rivals(
        self, rung: _Rung, hypotheses: list[tuple[float, Refinement]]
    ) -> tuple[Rival, ...]:
        """The other poses, scored as shares of the best one's objective."""
        problem = Problem(rung.terms)
        values = [problem.value_at(problem.from_pose(r.pose()))[0] for _, r in hypotheses]
        best = max(values[0], 1e-300)
        chosen = list(zip(hypotheses, values, strict=True))[1 : 1 + self._config.max_rivals]
        return tuple(
            Rival(
                self._full_pose(r.pose()), max(value, 0.0) / best, rung.outcome.upper_bound / best
            )
            for (_, r), value in chosen
        )

    def _full_pose(self, pose: SE2) -> SE2:
        """``T_target_source`` between the frames the points came in."""
        sx, sy = self._source.center
        tx, ty = self._target.center
        moved = SE2(pose.x + tx, pose.y + ty, pose.yaw) @ SE2(-sx, -sy, 0.0)
        return moved.inverse() if self._is_swapped else moved

    def _full_covariance(self, best: Refinement, pose: SE2) -> FloatArray:
        """Covariance (3, 3) of x, y, yaw of the full pose."""
        theta = best.parameters[0]
        order = np.array([1, 2, 0])
        covariance = _covariance(best)[np.ix_(order, order)]
        if not np.isfinite(covariance).all():
            return covariance
        turned = SE2(0.0, 0.0, float(theta)).apply(self._source.center)
        jacobian = np.eye(3)
        # Turning about the source's centre shifts its origin.
        jacobian[0, 2], jacobian[1, 2] = turned[1], -turned[0]
        covariance = jacobian @ covariance @ jacobian.T
        if self._is_swapped:
            rotation = pose.rotation()
            jacobian = np.eye(3)
            jacobian[:2, :2] = -rotation
            jacobian[:2, 2] = (pose.y, -pose.x)
            jacobian[2, 2] = -1.0
            covariance = jacobian @ covariance @ jacobian.T
        return 0.5 * (covariance + covariance.T)


def _cloud(
    name: str, points: ArrayLike, weights: ArrayLike | None, sigmas_m: ArrayLike | None
) -> _Cloud:
    array = as_points(points, name)
    checked: dict[str, FloatArray | None] = {}
    for field, values in (("weights", weights), ("sigma_m", sigmas_m)):
        checked[field] = None
        if values is None:
            continue
        numbers = np.asarray(values, dtype=np.float64)
        if numbers.shape != (len(array),):
            raise InvalidInputError(
                f"{name}_{field} has shape {numbers.shape}, expected ({len(array)},)"
            )
        if not (np.isfinite(numbers).all() and (numbers > 0.0).all()):
            bad = numbers[~(np.isfinite(numbers) & (numbers > 0.0))][0]
            raise InvalidInputError(f"{name}_{field} holds {bad}, expected positive numbers")
        checked[field] = numbers
    center = np.zeros(2)
    if len(array):
        center = 0.5 * (array.min(axis=0) + array.max(axis=0))
        center = center + (array - center).mean(axis=0)
    plain = checked["weights"]
    mixture = np.ones(len(array)) if plain is None else plain / plain.mean()
    return _Cloud(array - center, mixture, checked["sigma_m"], center)


def _subset(cloud: _Cloud, mask: NDArray[np.bool_]) -> _Cloud:
    sigmas_m = None if cloud.sigmas_m is None else cloud.sigmas_m[mask]
    return _Cloud(cloud.points[mask], cloud.weights[mask], sigmas_m, cloud.center)


def _area(points: FloatArray) -> float:
    """Area [m^2] that points spread over: of the box along their main axes; never quite zero."""
    spread = points - points.mean(axis=0)
    _, axes = np.linalg.eigh(spread.T @ spread)
    long, short = sorted(np.ptp(spread @ axes, axis=0), reverse=True)
    long = max(float(long), 1e-9)
    return long * max(float(short), long / max(len(points), 4))


def _covariance(refinement: Refinement) -> FloatArray:
    """Inverse information (3, 3) of theta, x, y; inf where it is singular."""
    if not refinement.information.any():
        return np.full((3, 3), math.inf)
    scale = np.sqrt(np.maximum(np.diag(refinement.information), 1e-300))
    normed = refinement.information / np.outer(scale, scale)
    if np.linalg.eigvalsh(normed)[0] < 1e-9:
        return np.full((3, 3), math.inf)
    # The pose took three of the pairs' degrees of freedom from the estimate of the noise.
    num_numbers = 2.0 * max(refinement.num_pairs, 3.0)
    inflation = num_numbers / (num_numbers - 3.0)
    return inflation * np.linalg.inv(normed) / np.outer(scale, scale)


def _has_partner(
    moved: FloatArray, target: FloatArray, best: Refinement, spacing_m: float
) -> NDArray[np.bool_]:
    """Source points with a target within three standard deviations of a pair."""
    reach = max(3.0 * best.sigma_m, 1e-3 * spacing_m)
    distances, _ = cKDTree(target).query(moved)
    return np.asarray(distances <= reach)


def _too_few(
    source: _Cloud, target: _Cloud, config: RegistrationConfig, seconds: float
) -> RegistrationResult:
    m, n = len(source.points), len(target.points)
    reason = f"{m} source and {n} target points, at least {config.min_points} of each needed"
    return RegistrationResult(
        verdict=Verdict.TOO_FEW_FEATURES,
        reason=reason,
        T_target_source=SE2(*(target.center - source.center)) if m and n else SE2(),
        covariance=np.full((3, 3), math.inf),
        probability=0.0,
        score=0.0,
        lower_bound=0.0,
        upper_bound=1.0,
        is_certified=False,
        num_boxes=0,
        seconds=seconds,
        overlap=math.nan,
        conflict_ratio=math.nan,
        inlier_ratio=0.0,
        num_source_points=m,
        num_target_points=n,
        source_points=source.points + source.center,
        target_points=target.points + target.center,
        is_inlier=np.zeros(m, dtype=np.bool_),
    )
