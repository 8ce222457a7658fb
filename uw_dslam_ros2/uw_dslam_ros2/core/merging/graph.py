"""Pose graph of submaps on SE(2): odometry is trusted, registrations have to agree."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from uw_dslam_ros2.core.se2 import SE2, wrap_angle
from uw_dslam_ros2.core.submap import SubmapId

__all__ = [
    "Edge",
    "Solution",
    "chi2_threshold",
    "compose_covariance",
    "invert_covariance",
    "mahalanobis",
    "residual",
    "solve_graph",
]

FloatArray = NDArray[np.float64]

_SIGMA_MIN_M, _SIGMA_MIN_RAD = 1e-3, 1e-4
"""A millimetre: keeps covariances of zero invertible."""


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """``T_target_source`` between two submaps; covariance (3, 3) in the target's frame."""

    source: SubmapId
    target: SubmapId
    T_target_source: SE2
    covariance: FloatArray

    def reversed(self) -> Edge:
        """The same from the other side."""
        motion = self.T_target_source
        covariance = invert_covariance(self.covariance, motion)
        return Edge(self.target, self.source, motion.inverse(), covariance)


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Poses in the anchor's frame, and for each loose edge whether it agrees."""

    T_anchor_submap: dict[SubmapId, SE2]
    is_inlier: NDArray[np.bool_]


def chi2_threshold(probability: float) -> float:
    """Squared Mahalanobis distance that a share of true motions stays below."""
    return float(chdtri(3, 1.0 - probability))  # scipy.stats has it too, but loads slowly


def compose_covariance(covariance: FloatArray, left: SE2, middle: SE2, right: SE2) -> FloatArray:
    """Covariance of ``left @ middle @ right`` when that of `middle` is given.

    All (3, 3) of x, y, yaw, each in the frame that its motion leads to.
    """
    arm = middle.rotation() @ (right.x, right.y)
    jacobian = np.eye(3)
    jacobian[:2, :2] = left.rotation()
    jacobian[:2, 2] = left.rotation() @ (-arm[1], arm[0])
    return jacobian @ covariance @ jacobian.T


def invert_covariance(covariance: FloatArray, motion: SE2) -> FloatArray:
    """Covariance of ``motion.inverse()`` when that of `motion` is given."""
    back = motion.inverse()
    jacobian = -np.eye(3)
    jacobian[:2, :2] = -back.rotation()
    jacobian[:2, 2] = back.rotation() @ (-motion.y, motion.x)
    return jacobian @ covariance @ jacobian.T


def mahalanobis(difference: SE2, covariance: FloatArray) -> float:
    """Squared distance of a motion from none, in units of its covariance."""
    vector = difference.as_array()
    return float(vector @ np.linalg.solve(_regular(covariance), vector))


def solve_graph(
    anchor: SubmapId,
    firm: Sequence[Edge],
    loose: Sequence[Edge],
    initial: Mapping[SubmapId, SE2],
    inlier_probability: float,
) -> Solution:
    """Most likely poses of all submaps in `initial`, which must hang together.

    Parameters
    ----------
    anchor
        Stays at the origin.
    firm
        Edges that are true (odometry).
    loose
        Edges that may be false; graduated non-convexity finds which (Yang et al. 2020).
    initial
        First guess of ``T_anchor_submap``, the anchor's included.
    inlier_probability
        Share of true edges that the chi-square test lets pass.
    """
    if len(initial) == 1:
        return Solution({anchor: SE2()}, np.ones(len(loose), dtype=np.bool_))
    keys = {submap_id: index for index, submap_id in enumerate(sorted(initial))}
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    tight = gtsam.noiseModel.Diagonal.Sigmas(np.array([1e-6, 1e-6, 1e-6]))
    graph.add(gtsam.PriorFactorPose2(keys[anchor], gtsam.Pose2(), tight))
    for edge in (*firm, *loose):
        graph.add(_factor(keys, edge))
    for submap_id, motion in initial.items():
        values.insert(keys[submap_id], gtsam.Pose2(motion.x, motion.y, motion.yaw))
    threshold = chi2_threshold(inlier_probability)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    errors = _loose_errors(graph, result, len(loose))
    if (errors > threshold).any():
        # They do not all agree: find out which, from the beginning.
        result = _gnc(graph, values, 1 + len(firm), inlier_probability)
        errors = _loose_errors(graph, result, len(loose))
    poses: dict[SubmapId, SE2] = {}
    for submap_id, key in keys.items():
        pose = result.atPose2(key)
        # Far below any accuracy, far above what the order of summation may change.
        poses[submap_id] = SE2(round(pose.x(), 7), round(pose.y(), 7), round(pose.theta(), 9))
    return Solution(poses, errors <= threshold)


def _loose_errors(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, num_loose: int
) -> FloatArray:
    """Squared Mahalanobis distances of the last factors."""
    first = graph.size() - num_loose
    return np.array([2.0 * graph.at(first + i).error(values) for i in range(num_loose)])


def _gnc(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, num_firm: int, probability: float
) -> gtsam.Values:
    parameters = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    parameters.setKnownInliers(list(range(num_firm)))
    optimizer = gtsam.GncLMOptimizer(graph, values, parameters)
    optimizer.setInlierCostThresholdsAtProbability(probability)
    return optimizer.optimize()


def _factor(keys: Mapping[SubmapId, int], edge: Edge) -> gtsam.BetweenFactorPose2:
    # gtsam's error lives in the source's axes, our covariance in the target's.
    turn = np.eye(3)
    turn[:2, :2] = edge.T_target_source.rotation().T
    covariance = _regular(turn @ edge.covariance @ turn.T)
    motion = edge.T_target_source
    return gtsam.BetweenFactorPose2(
        keys[edge.target],
        keys[edge.source],
        gtsam.Pose2(motion.x, motion.y, motion.yaw),
        gtsam.noiseModel.Gaussian.Covariance(covariance),
    )


def _regular(covariance: FloatArray) -> FloatArray:
    floor = np.diag([_SIGMA_MIN_M**2, _SIGMA_MIN_M**2, _SIGMA_MIN_RAD**2])
    return 0.5 * (covariance + covariance.T) + floor


def residual(edge: Edge, T_anchor_submap: Mapping[SubmapId, SE2]) -> tuple[float, float]:
    """Distance [m] and angle [rad] between an edge's motion and the poses'; NaN without poses."""
    source, target = T_anchor_submap.get(edge.source), T_anchor_submap.get(edge.target)
    if source is None or target is None:
        return math.nan, math.nan
    predicted = target.inverse() @ source
    measured = edge.T_target_source
    return (
        math.hypot(predicted.x - measured.x, predicted.y - measured.y),
        abs(float(wrap_angle(predicted.yaw - measured.yaw))),
    )
