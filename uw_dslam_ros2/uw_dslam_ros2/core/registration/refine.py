"""Refinement of a candidate pose: noise and clutter share are estimated along with it.

Each source point either has a partner among the targets, at a Gaussian distance, or is clutter,
uniform over the target's area. Expectation and maximisation alternate (Myronenko and Song's
coherent point drift, rigid, in the plane): who belongs to whom, then pose by weighted Procrustes,
noise and share. The noise falls by itself as the pose improves, so a start from a wide kernel ends
at the accuracy of the data.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.registration import refine_kernels
from uw_dslam_ros2.core.se2 import SE2

__all__ = [
    "PointModel",
    "Refinement",
    "evaluate_pose",
    "polish",
    "pose_evidence",
    "procrustes",
    "refine",
]

FloatArray = NDArray[np.float64]

_FITTED = 4.0  # nats that choosing the best noise and share, and the best of many climbs, may win


@dataclass(frozen=True, slots=True, eq=False)
class PointModel:
    """Two centred point sets, ready for `refine`: the targets sorted along x."""

    source: FloatArray  # (m, 2)
    source_weights: FloatArray  # (m,)
    target: FloatArray  # (n, 2), ascending x
    target_weights: FloatArray  # (n,), sum n
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


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """A refined pose and what the points say about it."""

    parameters: FloatArray  # (3,): theta, x, y
    sigma_m: float  # estimated standard deviation of a pair along one axis
    share: float  # estimated share of source points with a partner
    num_pairs: float  # the same, counted
    log_likelihood: float  # ratio to "everything is clutter", in nats
    information: FloatArray  # (3, 3), of theta, x, y

    def pose(self) -> SE2:
        """The same as a motion."""
        theta, x, y = self.parameters
        return SE2(float(x), float(y), float(theta))


def refine(
    model: PointModel,
    parameters: FloatArray,
    sigma_m: float,
    volume: float,
    usual_sigma_m: float,
    share: float = 0.5,
    num_halvings: int = 5,
) -> Refinement:
    """Climb the likelihood in pose, noise and share from a start (theta, x, y).

    A wide kernel among clutter is a local optimum of its own, so the noise is also capped at half,
    a quarter and so on of `sigma_m` in turn, each from where the last one ended; the one with the
    highest evidence, in the searched `volume`, wins.
    """
    best = _climb(model, parameters, sigma_m, model.max_sigma_m, share, 30)
    best_evidence = pose_evidence(best, volume, usual_sigma_m)
    last = best
    for halving in range(1, num_halvings + 1):
        cap = sigma_m * 0.5**halving
        if cap >= last.sigma_m:
            continue
        if cap <= model.min_sigma_m:
            break
        last = _climb(model, last.parameters, cap, cap, last.share, 15)
        evidence = pose_evidence(last, volume, usual_sigma_m)
        if evidence > best_evidence:
            best, best_evidence = last, evidence
    return best


def polish(model: PointModel, refinement: Refinement) -> Refinement:
    """Iterate to full precision from where `refine` ended."""
    start = refinement.parameters, refinement.sigma_m, model.max_sigma_m, refinement.share
    return _climb(model, *start, 100, 1e-9)


def _climb(
    model: PointModel,
    parameters: FloatArray,
    sigma_m: float,
    max_sigma_m: float,
    share: float,
    max_steps: int,
    tolerance: float = 1e-3,
) -> Refinement:
    state = np.array([*parameters, sigma_m, share], dtype=np.float64)
    information = np.zeros((3, 3))
    value = refine_kernels.expectation_maximisation(
        model.source, model.source_weights, model.target, model.target_weights,
        model.area_m2, model.min_sigma_m, max_sigma_m, state, max_steps, tolerance, information,
    )  # fmt: skip
    return Refinement(
        state[:3],
        float(state[3]),
        float(state[4]),
        float(state[4]) * len(model.source),
        float(value),
        information,
    )


def evaluate_pose(model: PointModel, pose: SE2, sigma_m: float, share: float = 0.5) -> Refinement:
    """What the points say about a pose as it is."""
    return _climb(model, pose.as_array()[[2, 0, 1]], sigma_m, model.max_sigma_m, share, 0)


def pose_evidence(refinement: Refinement, volume: float, usual_sigma_m: float) -> float:
    """Log of the Bayes factor of "there is a common pose" against chance, by Laplace's method.

    The likelihood ratio, times the volume (theta, x, y) that the posterior fills, over the volume
    searched. Noise much below `usual_sigma_m` has to be proven too, for a few points always agree
    very well somewhere: its prior falls with the third power. Under chance the result exceeds x
    with a probability of about exp(-x), whatever the number of points and the kernel.
    """
    eigenvalues = np.linalg.eigvalsh(refinement.information)
    if eigenvalues[0] <= 1e-12 * eigenvalues[-1]:
        return -math.inf
    log_width = 1.5 * math.log(2.0 * math.pi) - 0.5 * float(np.log(eigenvalues).sum())
    log_prior = min(3.0 * math.log(refinement.sigma_m / usual_sigma_m), 0.0)
    log_share = min(log_width - math.log(volume), 0.0)
    return refinement.log_likelihood + log_share + log_prior - _FITTED


def procrustes(source: FloatArray, target: FloatArray, weights: FloatArray) -> SE2:
    """Motion that minimises the weighted squared distances of pairs (k, 2), (k, 2)."""
    total = float(weights.sum())
    a = (weights[:, None] * source).sum(axis=0) / total
    b = (weights[:, None] * target).sum(axis=0) / total
    cross = ((source - a) * weights[:, None]).T @ (target - b)
    theta = math.atan2(cross[0, 1] - cross[1, 0], cross[0, 0] + cross[1, 1])
    turned = SE2(0.0, 0.0, theta).apply(a)
    return SE2(float(b[0] - turned[0]), float(b[1] - turned[1]), theta)
