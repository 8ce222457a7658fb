"""Trials of many methods on the same synthetic problems."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.cli.studies._ceiling import best_with_known_noise
from uw_dslam_ros2.cli.studies._common import is_success, progress, summary
from uw_dslam_ros2.core.registration import (
    PriorWindow,
    RegistrationConfig,
    register_point_sets,
)
from uw_dslam_ros2.core.registration.baselines import icp, point_baselines, procrustes
from uw_dslam_ros2.core.registration.search.branch_and_bound import SearchSettings, Term, search
from uw_dslam_ros2.core.registration.search.field import mixture_field
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.maps.point_sets import PointSetProblem, outlier_problem, overlap_problem

__all__ = [
    "CEILING",
    "ENGINE",
    "ORACLE",
    "PAPER",
    "TRUTH",
    "Cell",
    "Trial",
    "method_names",
    "run_cell",
    "search_mixture",
    "summarise",
]

FloatArray = NDArray[np.float64]

_MAX_BOXES = 300_000

ENGINE = "engine"
PAPER = "engine, paper's method"
ORACLE = "true pairs"  # Procrustes on the true correspondences: the limit
TRUTH = "ICP from the truth"  # whether the points alone hold the pose in place
CEILING = "told noise and overlap"  # the engine's evidence, given what nobody knows


@dataclass(frozen=True, slots=True)
class Cell:
    """One kind of problem: outliers in the target, or only a share in common (`common_share`)."""

    num_points: int
    outlier_share: float = 0.0
    noise_m: float = 0.0
    common_share: float | None = None

    def problem(self, seed: int) -> PointSetProblem:
        """Draw one problem."""
        if self.common_share is not None:
            return overlap_problem(self.num_points, self.common_share, self.noise_m, seed=seed)
        return outlier_problem(self.num_points, self.outlier_share, self.noise_m, seed=seed)

    def __str__(self) -> str:
        if self.common_share is not None:
            kind = f"{self.common_share:.0%} in common"
        else:
            kind = f"outliers {self.outlier_share:.0%}"
        return f"m = {self.num_points}, {kind}, noise {self.noise_m:g}"


@dataclass(frozen=True, slots=True)
class Trial:
    """What one method made of one problem."""

    cell: Cell
    method: str
    seed: int
    is_success: bool
    is_refused: bool
    error_rad: float
    error_m: float
    cpu_s: float

    def as_row(self) -> dict[str, Any]:
        """One row of the CSV."""
        return {
            "points": self.cell.num_points,
            "outliers": self.cell.outlier_share,
            "common": "" if self.cell.common_share is None else self.cell.common_share,
            "noise_m": self.cell.noise_m,
            "method": self.method,
            "seed": self.seed,
            "success": int(self.is_success),
            "refused": int(self.is_refused),
            "error_deg": math.degrees(self.error_rad),
            "error_m": self.error_m,
            "cpu_s": self.cpu_s,
        }


Outcome = tuple[SE2 | None, bool]  # the motion, and whether the method itself refused it
Method = Callable[[PointSetProblem], Outcome]


def method_names() -> list[str]:
    """Every method that can be tried here, ours first."""
    return [ENGINE, PAPER, ORACLE, TRUTH, CEILING, *point_baselines()]


def run_cell(
    cell: Cell, methods: Sequence[str], seeds: Iterable[int], *, text: str = ""
) -> list[Trial]:
    """Try each method on each problem; every method sees the same problems."""
    table = _methods(cell)
    trials = []
    for name in methods:
        table[name](cell.problem(0))  # machine code and caches
    for seed in progress(list(seeds), text=text or str(cell)):
        problem = cell.problem(seed)
        for name in methods:
            start = time.process_time()
            T_found, is_refused = table[name](problem)
            cpu_s = time.process_time() - start
            T_true = problem.T_target_source
            error_m, error_rad = (
                (math.nan, math.nan) if T_found is None else T_found.distance_to(T_true)
            )
            good = is_success(T_found, T_true)
            trials.append(Trial(cell, name, seed, good, is_refused, error_rad, error_m, cpu_s))
    return trials


def search_mixture(
    source: FloatArray, target: FloatArray, sigma_m: float, prior: PriorWindow | None = None
) -> SE2:
    """Optimum of the paper's objective, all components with the same `sigma_m`, nothing refined.

    A kernel far below the spacing has countless equal peaks: the search stops at a number of
    boxes that others never need, with the best pose so far.
    """
    field = mixture_field(
        target, np.ones(len(target)), np.full(len(target), math.sqrt(2.0) * sigma_m)
    )
    found = search(
        [Term(source, np.ones(len(source)), field)],
        SearchSettings(max_boxes=_MAX_BOXES),
        prior=prior,
    )
    return found.T_target_source


def summarise(trials: Iterable[Trial]) -> list[dict[str, Any]]:
    """One row for each cell and method: success, errors of successes, CPU time."""
    groups: dict[tuple[Cell, str], list[Trial]] = {}
    for trial in trials:
        groups.setdefault((trial.cell, trial.method), []).append(trial)
    rows = []
    for (cell, method), group in groups.items():
        good = [trial for trial in group if trial.is_success]
        cpu = summary([trial.cpu_s for trial in group])
        rows.append(
            {
                "points": cell.num_points,
                "outliers": cell.outlier_share,
                "common": "" if cell.common_share is None else cell.common_share,
                "noise_m": cell.noise_m,
                "method": method,
                "trials": len(group),
                "success": len(good) / len(group),
                "wrong_but_accepted": float(
                    np.mean([not t.is_success and not t.is_refused for t in group])
                ),
                "right_but_refused": float(
                    np.mean([t.is_success and t.is_refused for t in group])
                ),
                "median_deg": math.degrees(summary([t.error_rad for t in good])[0]),
                "median_m": summary([t.error_m for t in good])[0],
                "median_cpu_s": cpu[0],
                "p95_cpu_s": cpu[1],
            }
        )
    return rows


def _methods(cell: Cell) -> dict[str, Method]:
    share = 1.0 if cell.common_share is None else cell.common_share
    methods: dict[str, Method] = {
        ENGINE: _engine(RegistrationConfig()),
        PAPER: _engine(RegistrationConfig(method="gmrbnb", sigma=0.1)),
        ORACLE: _oracle,
        TRUTH: _from_truth,
        CEILING: lambda problem: (best_with_known_noise(problem), False),
    }
    for name, matcher in point_baselines(cell.noise_m, share).items():
        methods[name] = _baseline(matcher)
    return methods


def _engine(config: RegistrationConfig) -> Method:
    def run(problem: PointSetProblem) -> Outcome:
        result = register_point_sets(problem.source, problem.target, config)
        return result.T_target_source, not result.is_accepted

    return run


def _baseline(matcher: Callable[..., Any]) -> Method:
    def run(problem: PointSetProblem) -> Outcome:
        T_target_source = matcher(problem.source, problem.target).T_target_source
        return T_target_source, T_target_source is None

    return run


def _oracle(problem: PointSetProblem) -> Outcome:
    pairs = problem.source[problem.source_index], problem.target[problem.target_index]
    return procrustes(*pairs), False


def _from_truth(problem: PointSetProblem) -> Outcome:
    cutoff_m = max(0.05, 2.5 * problem.noise_m)
    found = icp(
        problem.source,
        problem.target,
        T_initial=problem.T_target_source,
        first_cutoff_m=cutoff_m,
        last_cutoff_m=cutoff_m,
    )
    return found.T_target_source, False
