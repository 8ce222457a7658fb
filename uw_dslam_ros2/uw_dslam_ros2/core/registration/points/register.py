"""Registration of two point sets, from points to verdict.

With ``method="likelihood"`` a search proves the best pose for one kernel; its optima are refined
together with noise and number of pairs, and weighed against chance. Where that is not decisive,
lattices with narrower kernels and one more search offer further poses, and all are weighed
together. With ``method="gmrbnb"`` the paper's Algorithms 3 and 4 run: search of the plain sum of
Gaussians, inliers by nearest-neighbour density, search on the inliers. Score and bounds belong to
the first search.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.registration.config import RegistrationConfig
from uw_dslam_ros2.core.registration.points.correlation import lattice_maxima
from uw_dslam_ros2.core.registration.points.design_effect import design_effect
from uw_dslam_ros2.core.registration.points.evidence import EvidenceModel, Outline
from uw_dslam_ros2.core.registration.points.input import Cloud, Pair, cloud_of
from uw_dslam_ros2.core.registration.points.nnde import nnde_inliers
from uw_dslam_ros2.core.registration.points.output import (
    Candidate,
    KernelSearch,
    result_of,
    too_few,
)
from uw_dslam_ros2.core.registration.points.refine import PointModel, evaluate_pose, polish, refine
from uw_dslam_ros2.core.registration.points.refinement import Refinement
from uw_dslam_ros2.core.registration.points.verdict import posterior
from uw_dslam_ros2.core.registration.result import PriorWindow, Progress, RegistrationResult
from uw_dslam_ros2.core.registration.search.branch_and_bound import (
    SearchOutcome,
    SearchSettings,
    Status,
    Term,
    search,
)
from uw_dslam_ros2.core.registration.search.field import likelihood_field, mixture_field
from uw_dslam_ros2.core.se2 import SE2, wrap_angle
from uw_dslam_ros2.core.suppression import first_apart

__all__ = ["register_point_sets"]

FloatArray = NDArray[np.float64]

# Kernels, in mean spacings of the target points: that of the search with the proof, those of the
# lattices where it is not decisive, and that of a last search for the few that match exactly.
_FIRST, _LATTICES, _LAST = 0.75, (1.2, 0.75, 0.5, 0.25, 0.1), 0.1
_LAST_BOXES = 30_000  # the last search only has to offer candidates, not a proof
_NUM_LATTICE = 100  # candidates of each lattice
_LATTICE_ADDITIONS = 1.5e9  # points times nodes that a lattice may cost: about a second
_MAX_CANDIDATES = 48
_ALIAS = (
    0.85  # a pose that explains the points as well as a decisive one scores at least this much
)
_MAX_SIGMA = 1.2  # most noise that is believed in, in spacings: beyond, partners are guesswork
_DECISIVE = 1e-4  # probability of chance below which nothing further need be tried
_INDEPENDENT = 0.3  # kernel, in spacings, that the points' independence is judged with
_CONTRAST = 10.0  # and the density on a target over that of clutter
_RIVAL_FACTOR = 0.95  # of the best score, down to which other poses are excluded with a proof
_RIVAL_BOXES = 0.25  # boxes for that, as a share of those that the best took


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
    first = cloud_of("source", source, source_weights, source_sigma_m)
    second = cloud_of("target", target, target_weights, target_sigma_m)
    start = clock() if clock else math.nan
    if min(len(first.points), len(second.points)) < config.min_points:
        return too_few(first, second, config, math.nan if clock is None else clock() - start)
    return _Match(first, second, config, prior, clock, progress, is_cancelled).result(start)


class _Match:
    """One match on its way from points to result."""

    def __init__(
        self,
        source: Cloud,
        target: Cloud,
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
        is_swapped = prior is None and len(source.points) > len(target.points)
        self._source, self._target = (target, source) if is_swapped else (source, target)
        self._prior = self._centred_prior(prior)
        self._pair = Pair(self._source, self._target, is_swapped)
        points, others = self._source.points, self._target.points
        outline = Outline.of(others)
        self._area_m2 = outline.area_m2
        self._spacing_m = math.sqrt(self._area_m2 / len(others))
        centred = points - points.mean(axis=0)
        self._arm_m = max(math.sqrt(float((centred**2).sum(axis=1).mean())), 1e-12)
        extent = float(np.ptp(others, axis=0).max()) + self._arm_m
        self._model = PointModel.of(
            points, others, self._area_m2, 1e-6 * extent, _MAX_SIGMA * self._spacing_m,
            self._source.weights, self._target.weights,
        )  # fmt: skip
        self._evidence = EvidenceModel(
            points, others, Outline.of(points), outline, self._searched_volume(), self._arm_m,
            self._spacing_m, _MAX_SIGMA * self._spacing_m, prior is not None,
        )  # fmt: skip

        self._judged: Refinement | None = None  # the pose that repetition was looked at last

    def _centred_prior(self, prior: PriorWindow | None) -> PriorWindow | None:
        if prior is None:
            return None
        # The source keeps its frame, for the window is about that frame's origin.
        source = self._source
        self._source = replace(source, points=source.original(), center=np.zeros(2))
        guess = prior.T_target_source
        cx, cy = self._target.center
        return replace(prior, T_target_source=SE2(guess.x - cx, guess.y - cy, guess.yaw))

    def _searched_volume(self) -> float:
        """Volume of (theta, x, y) in which the sets could overlap."""
        if self._prior is not None:
            half = self._prior.half_width_m
            return 2.0 * min(self._prior.half_width_rad, math.pi) * 4.0 * half * half
        sides = np.ptp(self._target.points, axis=0) + 2.0 * self._arm_m
        return 2.0 * math.pi * float(np.prod(sides))

    def result(self, start: float) -> RegistrationResult:
        """Search, refine, decide."""
        if self._config.method == "likelihood":
            searches, candidates = self._likelihood()
        else:
            searches, candidates = self._gmrbnb()
        candidates = self._best_first(candidates)
        candidates[0] = self._polished(candidates[0])
        return result_of(
            self._pair, searches[0], candidates, self._config,
            evidence=self._evidence,
            num_boxes=sum(found.outcome.num_boxes for found in searches),
            seconds=self._clock() - start if self._clock else math.nan,
        )  # fmt: skip

    def _best_first(self, candidates: list[Candidate]) -> list[Candidate]:
        """The pose to report in front.

        Where points repeat each other, how much is only known roughly: enough to judge one pose
        with the full amount, which is the careful side, but between poses the geometric mean of
        all and nothing is in error least.
        """
        repetition = math.sqrt(self._evidence.repetition)
        if repetition == 1.0:
            return candidates
        best = max(candidates, key=lambda pair: self._evidence.of(pair[1], repetition))
        return [best, *(pair for pair in candidates if pair is not best)]

    def _likelihood(self) -> tuple[list[KernelSearch], list[Candidate]]:
        """Searches and all candidates, until these are decisive."""
        searches = [self._searched(self._first_sigma_m(), self._config.max_boxes)]
        candidates = self._reweighed(searches[0].candidates)
        if self._is_over(searches[-1], candidates) or self._has_own_sigma():
            return searches, candidates
        if self._prior is None:
            candidates = self._reweighed([*candidates, *self._from_lattices()])
            if self._is_over(searches[-1], candidates):
                return searches, candidates
        searches.append(self._searched(_LAST * self._spacing_m, _LAST_BOXES))
        return searches, self._reweighed([*candidates, *searches[-1].candidates])

    def _is_over(self, found: KernelSearch, candidates: list[Candidate]) -> bool:
        is_stopped = found.outcome.status in (Status.TIME, Status.CANCELLED)
        return is_stopped or self._is_decisive(candidates)

    def _has_own_sigma(self) -> bool:
        own = self._source.sigmas_m, self._target.sigmas_m
        return self._config.sigma > 0.0 or any(sigmas_m is not None for sigmas_m in own)

    def _first_sigma_m(self) -> float | None:
        """Kernel of a pair in the first search; None where points have their own."""
        if self._source.sigmas_m is not None or self._target.sigmas_m is not None:
            return None
        if self._config.sigma > 0.0:
            return math.sqrt(2.0) * self._config.sigma
        return _FIRST * self._spacing_m

    def _reweighed(self, found: Iterable[Candidate]) -> list[Candidate]:
        """Evidence with the repetition seen at the best pose; never less than seen before."""
        candidates = self._distinct(found)
        if self._judged is candidates[0][1]:
            return candidates
        best = self._judged = candidates[0][1]
        theta, x, y = best.parameters
        turned = SE2(0.0, 0.0, float(theta)).apply(self._source.points)
        repetition = design_effect(
            turned, self._target.points, self._evidence.target_outline, np.array([x, y]),
            max(best.sigma_m, _INDEPENDENT * self._spacing_m), _CONTRAST,
        )  # fmt: skip
        if repetition <= self._evidence.repetition:
            return candidates
        self._evidence = replace(self._evidence, repetition=repetition)
        return self._distinct((self._evidence.of(r), r) for _, r in candidates)

    def _settings(self, max_boxes: int) -> SearchSettings:
        config = self._config
        max_boxes = min(max_boxes, config.max_boxes)
        left = math.inf
        if config.max_seconds > 0.0 and self._clock:
            left = max(config.max_seconds - (self._clock() - self._start), 0.0)
        return SearchSettings(
            config.gap, max_boxes, left, config.max_memory_mb, _RIVAL_FACTOR, _RIVAL_BOXES
        )

    def _searched(self, sigma_m: float | None, max_boxes: int) -> KernelSearch:
        """Search with one kernel (None: each point its own) and refine what was met."""
        terms = []
        for points, weights, sigmas_m in self._classes(sigma_m, self._source, self._target):
            width = float(np.sqrt(np.mean(sigmas_m**2)))
            contrast = self._contrast(width)
            field = likelihood_field(
                self._target.points, self._target.weights * (width / sigmas_m) ** 2, sigmas_m,
                contrast, max_nodes=self._max_nodes(),
            )  # fmt: skip
            terms.append(Term(points, weights * math.log1p(contrast), field))
        unit = sum(float(term.weights.sum()) for term in terms)
        outcome = self._search(terms, "search", max_boxes)
        start = sigma_m if sigma_m is not None else width
        return KernelSearch(start, terms, outcome, unit, 0.0, self._refined(outcome, start))

    def _contrast(self, sigma_m: float) -> float:
        """Density of a source point on top of a target over that of clutter."""
        share = 1.0 - self._config.clutter_share
        density = self._area_m2 / (len(self._target.points) * 2.0 * math.pi * sigma_m**2)
        return share / (1.0 - share) * density

    def _classes(
        self, sigma_m: float | None, source: Cloud, target: Cloud
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

    def _refined(self, outcome: SearchOutcome, sigma_m: float) -> list[Candidate]:
        """Refined optima with their evidence, best first, each pose once."""
        found: list[Candidate] = []
        for value, x, y, theta in outcome.optima[:_MAX_CANDIDATES]:
            if value < _ALIAS * outcome.optima[0, 0] and found and self._is_decisive(found):
                break
            found += self._climbed([(theta, x, y)], 0.5 * sigma_m)
        if not found:
            refinement = evaluate_pose(self._model, outcome.T_target_source, sigma_m)
            found = [(self._evidence.of(refinement), refinement)]
        return self._distinct(found)

    def _from_lattices(self) -> list[Candidate]:
        """Candidates of each kernel whose lattice is affordable, wide to narrow."""
        found: list[Candidate] = []
        for factor in _LATTICES:
            sigma_m = factor * self._spacing_m
            poses = lattice_maxima(
                self._source.points, self._target.points, sigma_m, self._contrast(sigma_m),
                _NUM_LATTICE, _LATTICE_ADDITIONS,
            )  # fmt: skip
            found += self._climbed(poses, sigma_m)
        return found

    def _climbed(self, poses: Iterable[Iterable[float]], sigma_m: float) -> list[Candidate]:
        """Refined poses that stay within the prior's window."""
        found = []
        for pose in poses:
            start = np.array(pose, dtype=np.float64)
            candidate = refine(self._model, self._evidence, start, sigma_m)
            if not self._is_outside(candidate[1].pose()):
                found.append(candidate)
        return found

    def _is_decisive(self, found: list[Candidate]) -> bool:
        return posterior([max(evidence for evidence, _ in found)]) > 1.0 - _DECISIVE

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

    def _distinct(self, found: Iterable[Candidate]) -> list[Candidate]:
        """Best first, each pose once."""
        ordered = sorted(found, key=lambda pair: -pair[0])
        poses = np.array([refinement.parameters for _, refinement in ordered])

        def is_near(k: int) -> NDArray[np.bool_]:
            turn = np.abs(wrap_angle(poses[:, 0] - poses[k, 0]))
            shift = np.hypot(poses[:, 1] - poses[k, 1], poses[:, 2] - poses[k, 2])
            return np.asarray(shift + turn * self._arm_m <= 0.5 * self._spacing_m)

        return [ordered[k] for k in first_apart(len(ordered), is_near)]

    def _polished(self, candidate: Candidate) -> Candidate:
        refinement = polish(self._model, candidate[1])
        if self._is_outside(refinement.pose()):
            return candidate
        evidence = self._evidence.of(refinement)
        return (evidence, refinement) if evidence >= candidate[0] - 1.0 else candidate

    def _gmrbnb(self) -> tuple[list[KernelSearch], list[Candidate]]:
        """The paper's two passes."""
        own = self._config.sigma or 0.5 * self._spacing_m / math.sqrt(2.0)
        first = self._first_sigma_m()
        sigma_m = None if first is None else math.sqrt(2.0) * own
        found = self._mixture_search(sigma_m, self._source, self._target, "search")
        moved = found.outcome.T_target_source.apply(self._source.points)
        config = self._config
        is_near = [
            nnde_inliers(a, b, config.nnde_neighbors, config.nnde_threshold, own)
            for a, b in ((moved, self._target.points), (self._target.points, moved))
        ]
        if min(int(mask.sum()) for mask in is_near) < self._config.min_points:
            return [found], self._reweighed(found.candidates)
        source, target = self._source.subset(is_near[0]), self._target.subset(is_near[1])
        again = self._mixture_search(sigma_m, source, target, "inliers")
        return [found, again], self._reweighed([*found.candidates, *again.candidates])

    def _mixture_search(
        self, sigma_m: float | None, source: Cloud, target: Cloud, stage: str
    ) -> KernelSearch:
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
        return KernelSearch(width, terms, outcome, unit, error, self._refined(outcome, width))
