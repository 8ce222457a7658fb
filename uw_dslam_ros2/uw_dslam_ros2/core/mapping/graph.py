"""The pose graph over one vehicle's submaps."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.se2 import SE2

__all__ = ["Between", "SubmapGraph"]

FloatArray = NDArray[np.float64]
_TINY_SIGMA = 1e-3
_BELIEVED = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Between:
    """``T_target_source`` between two submaps.

    `information` (3, 3) is in the source frame, which is gtsam's tangent.
    """

    target: int
    source: int
    T_target_source: SE2
    information: FloatArray


class SubmapGraph:
    """Submaps as poses, odometry and loops as edges; GNC weighs the loops, which may be wrong."""

    def __init__(self) -> None:
        self._odometry: list[Between] = []
        self._loops: list[Between] = []
        self._anchor = np.eye(3) * _TINY_SIGMA**2
        self._poses: list[SE2] = []
        self.loop_weights: FloatArray = np.empty(0)

    @property
    def poses(self) -> list[SE2]:
        """``T_odom_submap`` of every submap."""
        return list(self._poses)

    @property
    def loops(self) -> list[Between]:
        """All loops, believed or not."""
        return list(self._loops)

    @property
    def num_loops(self) -> int:
        """Loops, believed or not."""
        return len(self._loops)

    @property
    def num_loops_believed(self) -> int:
        """Loops that act on the poses."""
        return int((self.loop_weights > _BELIEVED).sum())

    def add_first(self, T_odom_submap: SE2, covariance: FloatArray) -> None:
        """Begin with the first submap, which stays where it is; covariance (3, 3) in odom."""
        self._poses = [T_odom_submap]
        rotation = np.eye(3)
        rotation[:2, :2] = T_odom_submap.rotation().T
        self._anchor = rotation @ covariance @ rotation.T + np.eye(3) * _TINY_SIGMA**2

    def covariance(self) -> FloatArray:
        """Covariance (3, 3) of the newest submap's pose in odom, order x, y, yaw."""
        graph, values = self._factors(is_weighted=True)
        newest = len(self._poses) - 1
        rotation = np.eye(3)
        rotation[:2, :2] = self._poses[newest].rotation()
        own = gtsam.Marginals(graph, values).marginalCovariance(newest)
        return np.asarray(rotation @ own @ rotation.T)

    def add_next(self, T_previous_new: SE2, covariance: FloatArray) -> None:
        """Append a submap by odometry; covariance (3, 3) in the previous submap's frame."""
        target = len(self._poses) - 1
        information = _rotated_inverse(covariance, T_previous_new)
        self._odometry.append(Between(target, target + 1, T_previous_new, information))
        self._poses.append(self._poses[-1] @ T_previous_new)

    def add_loop(
        self, target: int, source: int, T_target_source: SE2, information: FloatArray
    ) -> None:
        """A match between two submaps; information (3, 3) in the target frame."""
        self._loops = [
            loop for loop in self._loops if (loop.target, loop.source) != (target, source)
        ]
        rotated = _rotate_information(information, T_target_source)
        self._loops.append(Between(target, source, T_target_source, rotated))

    def relative(self, target: int, source: int) -> tuple[SE2, FloatArray]:
        """``T_target_source`` now and its covariance (3, 3) in the target frame."""
        graph, values = self._factors(is_weighted=True)
        marginals = gtsam.Marginals(graph, values)
        keys = gtsam.KeyVector([target, source])
        joint = marginals.jointMarginalCovariance(keys)
        T_target_source = self._poses[target].inverse() @ self._poses[source]
        # between = target^-1 source: its tangent (source frame) moves by d_source - Ad(T^-1)
        # d_target.
        adjoint = _adjoint(T_target_source.inverse())
        aa, ab, bb = joint.at(target, target), joint.at(target, source), joint.at(source, source)
        covariance = bb + adjoint @ aa @ adjoint.T - adjoint @ ab - (adjoint @ ab).T
        rotation = np.eye(3)
        rotation[:2, :2] = T_target_source.rotation()
        covariance = rotation @ covariance @ rotation.T
        return T_target_source, 0.5 * (covariance + covariance.T)

    def optimize(self) -> bool:
        """Solve; True if any submap moved by more than a hundredth of a metre or milliradian."""
        graph, values = self._factors(is_weighted=False)
        num_known = graph.size() - len(self._loops)
        if self._loops:
            parameters = gtsam.GncLMParams()
            parameters.setKnownInliers(list(range(num_known)))
            parameters.setLossType(gtsam.GncLossType.GM)
            optimizer = gtsam.GncLMOptimizer(graph, values, parameters)
            result = optimizer.optimize()
            self.loop_weights = np.asarray(optimizer.getWeights())[num_known:]
        else:
            result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        poses = [result.atPose2(i) for i in range(len(self._poses))]
        new = [SE2(p.x(), p.y(), p.theta()) for p in poses]
        moved = any(
            max(a.distance_to(b)[0] / 0.01, a.distance_to(b)[1] / 0.001) > 1.0
            for a, b in zip(new, self._poses, strict=True)
        )
        self._poses = new
        return moved

    def _factors(self, is_weighted: bool) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Graph and present poses; weighted: the loops as the last solution believed them."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for i, pose in enumerate(self._poses):
            values.insert(i, gtsam.Pose2(pose.x, pose.y, pose.yaw))
        anchor = self._poses[0]
        graph.add(
            gtsam.PriorFactorPose2(
                0,
                gtsam.Pose2(anchor.x, anchor.y, anchor.yaw),
                gtsam.noiseModel.Gaussian.Covariance(self._anchor),
            )
        )
        weights = [1.0] * len(self._loops)
        if is_weighted:
            known = min(len(self.loop_weights), len(weights))
            weights[:known] = self.loop_weights[:known].tolist()
        edges = [(edge, 1.0) for edge in self._odometry]
        for edge, weight in edges + list(zip(self._loops, weights, strict=True)):
            T = edge.T_target_source
            information = weight * edge.information + 1e-9 * np.eye(3)
            graph.add(
                gtsam.BetweenFactorPose2(
                    edge.target,
                    edge.source,
                    gtsam.Pose2(T.x, T.y, T.yaw),
                    gtsam.noiseModel.Gaussian.Information(information),
                )
            )
        return graph, values


def _adjoint(T: SE2) -> FloatArray:
    result = np.eye(3)
    result[:2, :2] = T.rotation()
    result[0, 2], result[1, 2] = T.y, -T.x
    return result


def _rotate_information(information: FloatArray, T_target_source: SE2) -> FloatArray:
    """From the target's axes to the source's; never quite singular, so that it can be factored."""
    rotation = np.eye(3)
    rotation[:2, :2] = T_target_source.rotation()
    rotated = rotation.T @ information @ rotation
    return 0.5 * (rotated + rotated.T) + 1e-9 * np.eye(3)


def _rotated_inverse(covariance: FloatArray, T_target_source: SE2) -> FloatArray:
    floor = np.diag([1e-6, 1e-6, 1e-8])
    return _rotate_information(np.linalg.inv(covariance + floor), T_target_source)
