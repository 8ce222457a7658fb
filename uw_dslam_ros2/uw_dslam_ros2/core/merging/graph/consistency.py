"""Which registrations agree with each other.

Two registrations between the same two maps close a cycle through the maps' own relative poses; the
largest set in which every pair closes (Mangelson et al. 2018) is taken for true.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.merging.types import Edge
from uw_dslam_ros2.core.pose_graph import (
    chi2_threshold,
    compose_covariances,
    invert_covariance,
    mahalanobis,
)
from uw_dslam_ros2.core.se2 import SE2, compose_poses, invert_poses
from uw_dslam_ros2.core.submap import SubmapId

__all__ = ["Side", "consistent_set", "cycles_of"]

FloatArray = NDArray[np.float64]

_MAX_CLIQUE_EDGES = 60


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    """Submaps placed in one frame, and how sure their relative poses are.

    ``covariances(targets, sources)`` (N, 3, 3) are those of ``T_target_source``. Sides of equal
    keys are equal; None: nobody asks for the same one again.
    """

    T_frame_submap: Mapping[SubmapId, SE2]
    covariances: Callable[[Sequence[SubmapId], Sequence[SubmapId]], FloatArray]
    key: bytes | None = None

    def covariance(self, target: SubmapId, source: SubmapId) -> FloatArray:
        """Covariance (3, 3) of ``T_target_source`` of two members."""
        (found,) = self.covariances([target], [source])
        return found

    def between(self, target: SubmapId, source: SubmapId) -> SE2:
        """``T_target_source`` of two members."""
        return self.T_frame_submap[target].inverse() @ self.T_frame_submap[source]


def cycles_of(
    edges: Sequence[Edge], pairs: Sequence[tuple[int, int]], source: Side, target: Side
) -> tuple[FloatArray, FloatArray]:
    """By how much pairs of edges fail to close.

    Parameters
    ----------
    edges
        All from `source` to `target`.
    pairs
        Indices of P times two edges.
    source, target
        The two maps.

    Returns
    -------
    tuple
        Motions (P, 3) [x, y, yaw], and their covariances (P, 3, 3).
    """
    if not pairs:
        return np.zeros((0, 3)), np.zeros((0, 3, 3))
    first, second = np.array(pairs).T
    motion = np.array([edge.T_target_source.as_array() for edge in edges])
    covariance = np.array([edge.covariance for edge in edges])
    T_source = np.array([source.T_frame_submap[edge.source].as_array() for edge in edges])
    T_target = np.array([target.T_frame_submap[edge.target].as_array() for edge in edges])
    motions = [
        motion[first],
        compose_poses(invert_poses(T_source[first]), T_source[second]),
        invert_poses(motion)[second],
        compose_poses(invert_poses(T_target[second]), T_target[first]),
    ]
    back = np.array([invert_covariance(e.covariance, e.T_target_source) for e in edges])
    covariances = [
        covariance[first],
        source.covariances(
            [edges[i].source for i, _ in pairs], [edges[j].source for _, j in pairs]
        ),
        back[second],
        target.covariances(
            [edges[j].target for _, j in pairs], [edges[i].target for i, _ in pairs]
        ),
    ]
    none = np.zeros((len(pairs), 3))
    last = compose_poses(motions[2], motions[3])
    rights = [compose_poses(motions[1], last), last, motions[3], none]
    left, total = none, np.zeros((len(pairs), 3, 3))
    for step, right, own in zip(motions, rights, covariances, strict=True):
        total += compose_covariances(own, left, step, right)
        left = compose_poses(left, step)
    return left, total


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
    import networkx as nx  # large, and not every node that starts has something to compare

    threshold = chi2_threshold(inlier_probability)
    graph = nx.Graph()
    # A clique finder takes exponential time in the worst case.
    order = sorted(range(len(edges)), key=lambda i: (-weights[i], i))[:_MAX_CLIQUE_EDGES]
    for i in sorted(order):
        graph.add_node(i, weight=1 + round(1000 * weights[i]))
    pairs = list(itertools.combinations(sorted(order), 2))
    distances = mahalanobis(*cycles_of(edges, pairs, source, target))
    graph.add_edges_from(
        pair for pair, agrees in zip(pairs, distances <= threshold, strict=True) if agrees
    )
    clique, _ = nx.max_weight_clique(graph, weight="weight")
    return sorted(clique)
