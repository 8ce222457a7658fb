"""Which registrations agree with each other.

Two registrations between the same two maps close a cycle through the maps' own relative poses; the
largest set in which every pair closes (Mangelson et al. 2018) is taken for true.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.merging.types import Edge
from uw_dslam_ros2.core.pose_graph import (
    chi2_threshold,
    compose_covariance,
    invert_covariance,
    mahalanobis,
)
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId

__all__ = ["Side", "consistent_set", "cycle_distance", "cycle_of"]

FloatArray = NDArray[np.float64]

_MAX_CLIQUE_EDGES = 60


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    """Submaps placed in one frame, and how sure their relative poses are.

    ``covariance(target, source)`` (3, 3) is that of ``T_target_source``.
    """

    T_frame_submap: Mapping[SubmapId, SE2]
    covariance: Callable[[SubmapId, SubmapId], FloatArray]

    def between(self, target: SubmapId, source: SubmapId) -> SE2:
        """``T_target_source`` of two members."""
        return self.T_frame_submap[target].inverse() @ self.T_frame_submap[source]


def cycle_of(first: Edge, second: Edge, source: Side, target: Side) -> tuple[SE2, FloatArray]:
    """By how much two edges from `source` to `target` fail to close, and covariance (3, 3)."""
    forth, back = first.T_target_source, second.T_target_source.inverse()
    motions = [
        forth,
        source.between(first.source, second.source),
        back,
        target.between(second.target, first.target),
    ]
    covariances = [
        first.covariance,
        source.covariance(first.source, second.source),
        invert_covariance(second.covariance, second.T_target_source),
        target.covariance(second.target, first.target),
    ]
    total = np.zeros((3, 3))
    left = SE2()
    rights = [motions[1] @ motions[2] @ motions[3], motions[2] @ motions[3], motions[3], SE2()]
    for motion, right, covariance in zip(motions, rights, covariances, strict=True):
        total += compose_covariance(covariance, left, motion, right)
        left = left @ motion
    return left, total


def cycle_distance(first: Edge, second: Edge, source: Side, target: Side) -> float:
    """Squared Mahalanobis distance by which two edges fail to close; see `cycle_of`."""
    return mahalanobis(*cycle_of(first, second, source, target))


def consistent_set(
    edges: Sequence[Edge],
    weights: Sequence[float],
    source: Side,
    target: Side,
    inlier_probability: float,
) -> list[int]:
    """Indices, rising, of the heaviest set of edges that agree pairwise.

    Parameters
    ----------
    edges
        All from `source` to `target`.
    weights
        What each is worth, in [0, 1], such as the probability that it is right.
    source, target
        The two maps.
    inlier_probability
        Share of true pairs that the chi-square test lets pass.
    """
    threshold = chi2_threshold(inlier_probability)
    graph = nx.Graph()
    # A clique finder takes exponential time in the worst case.
    order = sorted(range(len(edges)), key=lambda i: (-weights[i], i))[:_MAX_CLIQUE_EDGES]
    for i in sorted(order):
        graph.add_node(i, weight=1 + round(1000 * weights[i]))
    for i in graph:
        for j in graph:
            if i < j and cycle_distance(edges[i], edges[j], source, target) <= threshold:
                graph.add_edge(i, j)
    clique, _ = nx.max_weight_clique(graph, weight="weight")
    return sorted(clique)
