"""What the points allow, were noise and overlap known: the engine's evidence with these given.

Candidates are the highest maxima of two lattices whose kernels are the true noise and a little
more; each climbs in the pose alone, and the one with the most evidence is the answer. What fails
here is not for want of candidates or of knowing the noise: wrong poses explain the points better.
"""

from __future__ import annotations

import math

import numpy as np

from uw_dslam_ros2.core.registration.points.correlation import lattice_maxima
from uw_dslam_ros2.core.registration.points.evidence import EvidenceModel, Outline
from uw_dslam_ros2.core.registration.points.input import Pair, cloud_of
from uw_dslam_ros2.core.registration.points.refine import PointModel, fit_known
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.maps.point_sets import PointSetProblem

__all__ = ["best_with_known_noise"]

_KERNELS = (1.0, 1.6)  # times the noise
_NUM_STARTS = 300  # from each lattice
_MIN_NOISE_M = 0.005  # without noise every kernel will do
_MAX_ADDITIONS = 2e10


def best_with_known_noise(problem: PointSetProblem) -> SE2:
    """Pose of the most evidence, with the true noise and number of pairs (at least one)."""
    pair = Pair(
        cloud_of("source", problem.source, None, None),
        cloud_of("target", problem.target, None, None),
        is_swapped=False,
    )
    source, target = pair.source.points, pair.target.points
    noise_m = max(problem.noise_m, _MIN_NOISE_M)
    outlines = Outline.of(source), Outline.of(target)
    area_m2 = outlines[1].area_m2
    spacing_m = math.sqrt(area_m2 / len(target))
    arm_m = math.sqrt(float((source**2).sum(axis=1).mean()))
    model = PointModel.of(source, target, area_m2, noise_m, noise_m)
    volume = 2.0 * math.pi * float(np.prod(np.ptp(target, axis=0) + 2.0 * arm_m))
    evidence = EvidenceModel(
        source, target, *outlines, volume, arm_m, spacing_m, noise_m, has_prior=False
    )
    num_pairs = float(len(problem.source_index))
    share = min(num_pairs / len(source), 0.98)
    best, best_evidence = SE2(), -math.inf
    for factor in _KERNELS:
        kernel_m = factor * noise_m
        contrast = share / (1.0 - share) * area_m2 / (len(target) * 2.0 * math.pi * kernel_m**2)
        starts = lattice_maxima(source, target, kernel_m, contrast, _NUM_STARTS, _MAX_ADDITIONS)
        for start in starts:
            found = fit_known(model, start, noise_m, num_pairs)
            value = evidence.of(found)
            if value > best_evidence:
                best, best_evidence = found.pose(), value
    return pair.full_pose(best)
