"""Pose graphs on SE(2): sparse least squares, robust against false edges, with covariances.

Covariances are (3, 3) of x [m], y [m], yaw [rad], each in the frame that its motion leads to.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from uw_dslam_ros2.core.se2 import SE2, wrap_angle

__all__ = [
    "Edge",
    "Marginals",
    "Solution",
    "chained_covariance",
    "chi2_threshold",
    "compose_covariance",
    "compose_covariances",
    "invert_covariance",
    "mahalanobis",
    "residual",
    "solve_graph",
]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# A millimetre: keeps covariances of zero invertible.
_FLOOR = np.diag([1e-3, 1e-3, 1e-4]) ** 2
_MAX_STEPS = 100
_LEAST_STEP = 1e-9  # metres and radians
_LEAST_WEIGHT = 1e-9
_ROUNDING = 1e-12
_GROWTH = 1.4  # of the convexity, from one step of the graduation to the next (Yang et al. 2020)
_MAX_STAGES = 100


@dataclass(frozen=True, eq=False)  # with slots a generic class's aliases make no instances
class Edge[KeyT: Hashable]:
    """``T_target_source`` between two poses; covariance (3, 3) in the target's frame."""

    source: KeyT
    target: KeyT
    T_target_source: SE2
    covariance: FloatArray

    def reversed(self) -> Edge[KeyT]:
        """The same from the other side."""
        motion = self.T_target_source
        covariance = invert_covariance(self.covariance, motion)
        return Edge(self.target, self.source, motion.inverse(), covariance)


@dataclass(frozen=True, slots=True, eq=False)
class Solution[KeyT: Hashable]:
    """Poses in the anchor's frame, and for each loose edge whether it agrees."""

    T_anchor_pose: dict[KeyT, SE2]
    is_inlier: NDArray[np.bool_]


@functools.cache
def chi2_threshold(probability: float) -> float:
    """Squared Mahalanobis distance that a share of true motions stays below."""
    # scipy.stats has it too, but loads slowly.
    return float(scipy.special.chdtri(3, 1.0 - probability))


def chained_covariance(
    T_a_b: SE2, covariance_b: FloatArray, T_b_c: SE2, covariance_c: FloatArray
) -> FloatArray:
    """Covariance of ``T_a_b @ T_b_c`` of two motions that err independently."""
    first = compose_covariance(covariance_b, SE2(), T_a_b, T_b_c)
    return first + compose_covariance(covariance_c, T_a_b, T_b_c, SE2())


def compose_covariance(covariance: FloatArray, left: SE2, middle: SE2, right: SE2) -> FloatArray:
    """Covariance of ``left @ middle @ right`` when that of `middle` is given."""
    # Written out: products of such small matrices are mostly the making of them.
    cos, sin = math.cos(middle.yaw), math.sin(middle.yaw)
    x, y = cos * right.x - sin * right.y, sin * right.x + cos * right.y
    cos, sin = math.cos(left.yaw), math.sin(left.yaw)
    jacobian = np.array(
        [[cos, -sin, -cos * y - sin * x], [sin, cos, -sin * y + cos * x], [0.0, 0.0, 1.0]]
    )
    return jacobian @ covariance @ jacobian.T


def compose_covariances(
    covariance: FloatArray, left: FloatArray, middle: FloatArray, right: FloatArray
) -> FloatArray:
    """`compose_covariance` of many: covariances (N, 3, 3), motions (N, 3) [x, y, yaw]."""
    cos, sin = np.cos(middle[:, 2]), np.sin(middle[:, 2])
    x = cos * right[:, 0] - sin * right[:, 1]
    y = sin * right[:, 0] + cos * right[:, 1]
    cos, sin = np.cos(left[:, 2]), np.sin(left[:, 2])
    jacobian = np.zeros((len(left), 3, 3))
    jacobian[:, 0, 0], jacobian[:, 0, 1], jacobian[:, 0, 2] = cos, -sin, -cos * y - sin * x
    jacobian[:, 1, 0], jacobian[:, 1, 1], jacobian[:, 1, 2] = sin, cos, -sin * y + cos * x
    jacobian[:, 2, 2] = 1.0
    return jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)


def invert_covariance(covariance: FloatArray, motion: SE2) -> FloatArray:
    """Covariance of ``motion.inverse()`` when that of `motion` is given."""
    back = motion.inverse()
    cos, sin = math.cos(back.yaw), math.sin(back.yaw)
    x, y = -motion.y, motion.x
    jacobian = np.array(
        [[-cos, sin, cos * x - sin * y], [-sin, -cos, sin * x + cos * y], [0.0, 0.0, -1.0]]
    )
    return jacobian @ covariance @ jacobian.T


def mahalanobis(differences: FloatArray, covariances: FloatArray) -> FloatArray:
    """Squared distances (N,) of motions (N, 3) from none, in units of covariances (N, 3, 3)."""
    regular = 0.5 * (covariances + np.swapaxes(covariances, 1, 2)) + _FLOOR
    solved = np.linalg.solve(regular, differences[:, :, None])[:, :, 0]
    return np.asarray(np.sum(differences * solved, axis=1))


def residual[KeyT: Hashable](
    edge: Edge[KeyT], T_anchor_pose: Mapping[KeyT, SE2]
) -> tuple[float, float]:
    """Distance [m] and angle [rad] between an edge's motion and the poses'; NaN without poses."""
    source, target = T_anchor_pose.get(edge.source), T_anchor_pose.get(edge.target)
    if source is None or target is None:
        return math.nan, math.nan
    return (target.inverse() @ source).distance_to(edge.T_target_source)


def solve_graph[KeyT: Hashable](
    anchor: KeyT,
    firm: Sequence[Edge[KeyT]],
    loose: Sequence[Edge[KeyT]],
    initial: Mapping[KeyT, SE2],
    inlier_probability: float,
) -> Solution[KeyT]:
    """Most likely poses of all keys in `initial`, which must hang together.

    Parameters
    ----------
    anchor
        Stays where it is.
    firm
        Edges that are true (odometry).
    loose
        Edges that may be false; if least squares over all of them leaves one that fails the
        chi-square test, graduated non-convexity on truncated least squares finds which (Yang et
        al. 2020).
    initial
        First guess of all poses, in the order in which they are numbered.
    inlier_probability
        Share of true edges that the chi-square test lets pass.
    """
    if len(initial) == 1:
        return Solution(dict(initial), np.ones(len(loose), dtype=np.bool_))
    system = _System(anchor, [*firm, *loose], initial)
    first, limit = len(firm), chi2_threshold(inlier_probability)
    weight = np.ones(len(firm) + len(loose))
    start = np.array([motion.as_array() for motion in initial.values()])
    poses = system.minimum([start], weight)
    errors = system.squared_distances(poses)[first:]
    if (errors > limit).any():
        # They do not all agree. The convex start is far above all errors, the end far below.
        convexity = limit / (2.0 * errors.max() - limit)
        for _ in range(_MAX_STAGES):
            weight[first:] = _truncated_weights(errors, limit, convexity)
            poses = system.minimum([start, poses], weight)
            errors = system.squared_distances(poses)[first:]
            if np.isin(weight, (0.0, 1.0)).all():
                break
            convexity *= _GROWTH
    # Far below any accuracy, far above what the order of summation may change.
    rounded = np.column_stack([np.round(poses[:, :2], 7), np.round(poses[:, 2], 9)])
    found = {key: SE2.from_array(row) for key, row in zip(initial, rounded, strict=True)}
    return Solution(found, errors <= limit)


def _truncated_weights(errors: FloatArray, limit: float, convexity: float) -> FloatArray:
    """Weights (L,) of squared distances: 1 if small, 0 if large (Yang et al. 2020, eq. 14)."""
    scaled = math.sqrt(convexity * (convexity + 1.0) * limit) / np.sqrt(np.maximum(errors, 1e-12))
    return np.clip(scaled - convexity, 0.0, 1.0)


class Marginals[KeyT: Hashable]:
    """Covariances of poses at a solution, relative to its anchor, whose own is zero."""

    def __init__(
        self, anchor: KeyT, edges: Sequence[Edge[KeyT]], poses: Mapping[KeyT, SE2]
    ) -> None:
        self._system = _System(anchor, edges, poses)
        self._poses = np.array([motion.as_array() for motion in poses.values()])
        hessian, _ = self._system.normal_equations(self._poses, np.ones(len(edges)))
        self._factor = _factorized(hessian)

    def covariance(self, target: KeyT, source: KeyT) -> FloatArray:
        """Covariance (3, 3) of ``T_target_source`` in the target's frame."""
        number = self._system.number
        ends = np.array([[number[target], number[source]]])
        _, by_target, by_source = _linearized(self._poses, ends, np.zeros((1, 3)))
        place = self._system.place
        moved = np.zeros((place.max() + 1, 3))
        moved[place[ends[0, 0]]] += by_target[0].T
        moved[place[ends[0, 1]]] += by_source[0].T
        moved = moved[:-1]
        covariance = moved.T @ self._factor.solve(moved)
        return np.asarray(0.5 * (covariance + covariance.T))


class _System[KeyT: Hashable]:
    """Edges as arrays, and where each of their blocks lands in the sparse normal equations."""

    def __init__(
        self, anchor: KeyT, edges: Sequence[Edge[KeyT]], poses: Mapping[KeyT, SE2]
    ) -> None:
        self.number = {key: index for index, key in enumerate(poses)}
        ends = [(self.number[edge.target], self.number[edge.source]) for edge in edges]
        self._ends = np.array(ends, dtype=np.int64).reshape(-1, 2)
        self._measured = np.array([e.T_target_source.as_array() for e in edges]).reshape(-1, 3)
        covariance = np.array([_regular(edge.covariance) for edge in edges]).reshape(-1, 3, 3)
        self._information = np.linalg.inv(covariance)
        # Coordinates in the order of the poses, less those of the anchor; all of those are last.
        size = 3 * (len(poses) - 1)
        self.place = np.full((len(poses), 3), size)
        self.place[np.arange(len(poses)) != self.number[anchor]] = np.arange(size).reshape(-1, 3)
        self._places = self.place[self._ends].reshape(-1, 6)
        rows, cols = np.repeat(self._places, 6), np.tile(self._places, 6).ravel()
        cells, self._slots = np.unique(cols * (size + 1) + rows, return_inverse=True)
        self._row, self._col = cells % (size + 1), cells // (size + 1)
        self._is_free = (self._row < size) & (self._col < size)
        self._starts = np.searchsorted(self._col[self._is_free], np.arange(size + 1))

    def squared_distances(self, poses: FloatArray) -> FloatArray:
        """Squared Mahalanobis distance (E,) of each edge from the poses (N, 3)."""
        errors, _, _ = _linearized(poses, self._ends, self._measured)
        return np.asarray(np.einsum("ei,eij,ej->e", errors, self._information, errors))

    def normal_equations(
        self, poses: FloatArray, weight: FloatArray
    ) -> tuple[scipy.sparse.csc_array, FloatArray]:
        """Hessian (F, F) over the coordinates that are free, and gradient (F,)."""
        errors, by_target, by_source = _linearized(poses, self._ends, self._measured)
        jacobian = np.concatenate([by_target, by_source], axis=2)
        weighted = weight[:, None, None] * (self._information @ jacobian)
        blocks = np.swapaxes(jacobian, 1, 2) @ weighted
        values = np.bincount(self._slots, blocks.ravel())[self._is_free]
        size = len(self._starts) - 1
        hessian = scipy.sparse.csc_array(
            (values, self._row[self._is_free].astype(np.int32), self._starts.astype(np.int32)),
            (size, size),
        )
        pulls = np.einsum("eij,ei->ej", weighted, errors)
        return hessian, np.bincount(self._places.ravel(), pulls.ravel(), size + 1)[:size]

    def minimum(self, starts: Sequence[FloatArray], weight: FloatArray) -> FloatArray:
        """Poses (N, 3) of least weighted squared distance, by Levenberg and Marquardt.

        It begins at the best of `starts`.
        """
        # Edges that count for nothing still hold what nothing else holds.
        weight = np.maximum(weight, _LEAST_WEIGHT)
        costs = [float(weight @ self.squared_distances(poses)) for poses in starts]
        cost, poses = min(costs), starts[int(np.argmin(costs))]
        damping = 0.0
        for _ in range(_MAX_STEPS):
            hessian, gradient = self.normal_equations(poses, weight)
            diagonal = hessian.diagonal()
            while True:
                hessian.setdiag((1.0 + damping) * diagonal)
                step = np.append(-_factorized(hessian).solve(gradient), 0.0)[self.place]
                moved = poses + step
                moved[:, 2] = wrap_angle(moved[:, 2])
                reached = float(weight @ self.squared_distances(moved))
                if reached <= cost * (1.0 + _ROUNDING):
                    break
                damping = max(4.0 * damping, 1e-4)
            is_done = np.abs(step).max() < _LEAST_STEP or cost - reached <= _ROUNDING * cost
            cost, poses, damping = reached, moved, 0.25 * damping if damping > 1e-6 else 0.0
            if is_done:
                break
        return poses


def _linearized(
    poses: FloatArray, ends: IntArray, measured: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Errors (E, 3) in the targets' frames, their derivatives (E, 3, 3) by target and source."""
    target, source = poses[ends[:, 0]], poses[ends[:, 1]]
    cos, sin = np.cos(target[:, 2]), np.sin(target[:, 2])
    x, y = source[:, 0] - target[:, 0], source[:, 1] - target[:, 1]
    predicted = np.column_stack(
        [cos * x + sin * y, -sin * x + cos * y, source[:, 2] - target[:, 2]]
    )
    errors = predicted - measured
    errors[:, 2] = wrap_angle(errors[:, 2])
    by_source = np.zeros((len(ends), 3, 3))
    by_source[:, 0, 0], by_source[:, 0, 1] = cos, sin
    by_source[:, 1, 0], by_source[:, 1, 1] = -sin, cos
    by_source[:, 2, 2] = 1.0
    by_target = -by_source
    by_target[:, 0, 2], by_target[:, 1, 2] = predicted[:, 1], -predicted[:, 0]
    return errors, by_target, by_source


def _factorized(hessian: scipy.sparse.csc_array) -> scipy.sparse.linalg.SuperLU:
    """Sparse factors of a symmetric, positive matrix."""
    return scipy.sparse.linalg.splu(
        hessian,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


def _regular(covariance: FloatArray) -> FloatArray:
    return 0.5 * (covariance + covariance.T) + _FLOOR
