"""Refinement of a candidate pose: who is paired with whom, and the noise, are estimated with it.

Some source points have a partner among the targets, at a Gaussian distance; the others of both
sets are uniform clutter. No point has two partners. The likelihood of a pose is the sum over all
sets of pairs (Green and Mardia's alignment with a hidden matching), by belief propagation.
Expectation and maximisation alternate: the pairs' probabilities, then pose by weighted Procrustes,
noise and number of pairs. The noise falls by itself as the pose improves, so a start from a wide
kernel ends at the accuracy of the data.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.registration.points import refine_kernels
from uw_dslam_ros2.core.registration.points.evidence import EvidenceModel
from uw_dslam_ros2.core.registration.points.refinement import Refinement
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["PointModel", "evaluate_pose", "fit_known", "polish", "refine"]

FloatArray = NDArray[np.float64]

_START_SHARE = 0.4  # of the points that a climb takes for paired at first
_SWEEPS = 8  # of belief propagation; it has settled by then, or need not for a climb


@dataclass(frozen=True, slots=True, eq=False)
class PointModel:
    """Two centred point sets, ready for `refine`: the targets sorted along x."""

    source: FloatArray  # (m, 2)
    source_weights: FloatArray  # (m,), mean 1
    target: FloatArray  # (n, 2), ascending x
    target_weights: FloatArray  # (n,), mean 1
    area_m2: float  # that clutter is spread over
    min_sigma_m: float
    max_sigma_m: float

    @classmethod
    def of(
        cls,
        source: FloatArray,
        target: FloatArray,
        area_m2: float,
        min_sigma_m: float,
        max_sigma_m: float,
        source_weights: FloatArray | None = None,
        target_weights: FloatArray | None = None,
    ) -> PointModel:
        """Sort, and scale the weights to a mean of one."""
        order = np.argsort(target[:, 0], kind="stable")
        ones_m, ones_n = np.ones(len(source)), np.ones(len(target))
        weights_m = ones_m if source_weights is None else source_weights / source_weights.mean()
        weights_n = ones_n if target_weights is None else target_weights / target_weights.mean()
        return cls(
            np.ascontiguousarray(source), weights_m,
            np.ascontiguousarray(target[order]), weights_n[order],
            area_m2, min_sigma_m, max_sigma_m,
        )  # fmt: skip


def refine(
    model: PointModel,
    evidence: EvidenceModel,
    parameters: FloatArray,
    sigma_m: float,
    num_halvings: int = 1,
) -> tuple[float, Refinement]:
    """Climb the likelihood in pose, noise and number of pairs from a start (theta, x, y).

    A wide kernel among clutter is a local optimum of its own, so the noise is also capped at half,
    a quarter and so on of `sigma_m` in turn, each from where the last one ended; the one with the
    highest evidence wins. Returns that evidence, and where it was found.
    """
    num_pairs = _START_SHARE * min(len(model.source), len(model.target))
    last = best = _climb(model, parameters, sigma_m, num_pairs, model.max_sigma_m, 25)
    best_evidence = evidence.of(best)
    for halving in range(1, num_halvings + 1):
        cap = sigma_m * 0.5**halving
        if cap >= last.sigma_m:
            continue
        if cap <= model.min_sigma_m:
            break
        last = _climb(model, last.parameters, cap, last.num_pairs, cap, 25)
        found = evidence.of(last)
        if found > best_evidence:
            best, best_evidence = last, found
    return best_evidence, best


def polish(model: PointModel, refinement: Refinement) -> Refinement:
    """Iterate to full precision from where `refine` ended."""
    start = refinement.parameters, refinement.sigma_m, refinement.num_pairs, model.max_sigma_m
    return _climb(model, *start, 100, 1e-9, 30)


def evaluate_pose(model: PointModel, pose: SE2, sigma_m: float) -> Refinement:
    """What the points say about a pose as it is."""
    num_pairs = _START_SHARE * min(len(model.source), len(model.target))
    return _climb(model, pose.as_array()[[2, 0, 1]], sigma_m, num_pairs, model.max_sigma_m, 0)


def fit_known(
    model: PointModel, parameters: FloatArray, sigma_m: float, num_pairs: float
) -> Refinement:
    """Climb in the pose (theta, x, y) alone: noise and number of pairs are known.

    The model's smallest and largest noise have to be `sigma_m`. The climb estimates the number of
    pairs; what it ends at is then evaluated with the known one.
    """
    num_pairs = min(num_pairs, 0.98 * min(len(model.source), len(model.target)))
    pose = _climb(model, parameters, sigma_m, num_pairs, sigma_m, 60, 1e-4).parameters
    return _climb(model, pose, sigma_m, num_pairs, sigma_m, 0)


def _climb(
    model: PointModel,
    parameters: FloatArray,
    sigma_m: float,
    num_pairs: float,
    max_sigma_m: float,
    max_steps: int,
    tolerance: float = 1e-3,
    max_sweeps: int = _SWEEPS,
) -> Refinement:
    state = np.array([*parameters, sigma_m, num_pairs], dtype=np.float64)
    information = np.zeros((3, 3))
    value = refine_kernels.expectation_maximisation(
        model.source, model.source_weights, model.target, model.target_weights, model.area_m2,
        model.min_sigma_m, max_sigma_m, state, max_steps, tolerance, max_sweeps, information,
    )  # fmt: skip
    return Refinement(state[:3], float(state[3]), float(state[4]), float(value), information)
