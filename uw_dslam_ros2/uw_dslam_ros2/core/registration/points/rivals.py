"""Whether the points can tell two poses apart that both explain them.

Two sets that are samples of one symmetric shape (a ring, a corridor, a room of equal halves) fit
in several poses about equally well; by how much one of them wins is then a matter of where the
samples fell. The likelihoods of two models, neither of which holds the other, are compared by
Vuong's test: the sum of the points' log-ratios against the scatter of these log-ratios.
"""

from __future__ import annotations

import math

import numpy as np
import scipy
from numpy.typing import NDArray

from uw_dslam_ros2.core.registration.points.refinement import Refinement

__all__ = ["log_contributions", "log_odds"]

FloatArray = NDArray[np.float64]

_NEIGHBORS = 8  # targets that can be a point's partner


def log_contributions(
    source: FloatArray, target: FloatArray, refinement: Refinement, area_m2: float
) -> FloatArray:
    """Log-likelihood ratio to clutter (m,) of each source point (m, 2) at a pose [nats].

    With the targets (n, 2), noise and number of pairs of the refinement, without regard to whom
    other points are paired with; `area_m2` is what clutter is spread over.
    """
    m, n = len(source), len(target)
    distances, _ = scipy.spatial.cKDTree(target).query(
        refinement.pose().apply(source), k=list(range(1, min(_NEIGHBORS, n) + 1))
    )
    pairs, variance = refinement.num_pairs, refinement.sigma_m**2
    odds = pairs / ((m - pairs) * max(n - pairs, 1e-9))
    activity = odds * area_m2 / (2.0 * math.pi * variance) * np.exp(-0.5 * distances**2 / variance)
    return np.asarray(np.log1p(activity.sum(axis=1)))


def log_odds(best: FloatArray, rival: FloatArray, repetition: float) -> float:
    """Log of the odds for a rival against the best, from the contributions (m,) of the points.

    Vuong (1989). `repetition` points count as one. At most 0: even odds.
    """
    ratio = best - rival
    scatter = math.sqrt(repetition * float(((ratio - ratio.mean()) ** 2).sum()))
    total = max(float(ratio.sum()), 0.0)
    if scatter <= 1e-12 * total:
        return -math.inf if total > 0.0 else 0.0
    return float(
        scipy.special.log_ndtr(-total / scatter) - scipy.special.log_ndtr(total / scatter)
    )
