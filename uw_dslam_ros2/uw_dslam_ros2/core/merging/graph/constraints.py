"""From an answer to an edge of the pose graph."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.merging.graph.answers import Answer
from uw_dslam_ros2.core.merging.graph.components import Constraint
from uw_dslam_ros2.core.merging.graph.library import Library
from uw_dslam_ros2.core.merging.graph.submap_groups import SubmapGroup
from uw_dslam_ros2.core.merging.types import Edge
from uw_dslam_ros2.core.pose_graph import compose_covariance
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId

__all__ = ["constraint_of"]

FloatArray = NDArray[np.float64]

_EDGE_SIGMA_CELLS = 0.25
"""Least standard deviation believed of a registration: walls are drawn into cells, which no
residual shows.
"""


def constraint_of(library: Library, answer: Answer) -> Constraint:
    """The edge of an answer, between the two submaps that share most; worked out once.

    Parameters
    ----------
    library
        All submaps.
    answer
        With a transform that means something.
    """
    query = answer.query
    states = library.state_of(query.source), library.state_of(query.target)
    key = "constraint", query.key, answer.T_target_source, answer.probability, states
    return library.remember(key, functools.partial(_constraint_of, library, answer))


def _constraint_of(library: Library, answer: Answer) -> Constraint:
    source, target = answer.query.source, answer.query.target
    T_target_source = answer.T_target_source
    assert T_target_source is not None
    ends = _ends(library, source, target, T_target_source)
    left = target.T_reference_submap[ends[1]].inverse()
    right = source.T_reference_submap[ends[0]]
    edge = Edge(
        *ends,
        left @ T_target_source @ right,
        compose_covariance(answer.covariance, left, T_target_source, right),
    )
    covariance = edge.covariance + _distrust(library, source, target, edge)
    edge = Edge(edge.source, edge.target, edge.T_target_source, covariance)
    return Constraint(answer.query.key, edge, answer.probability, is_unsure=not answer.is_accepted)


def _ends(
    library: Library, source: SubmapGroup, target: SubmapGroup, T_target_source: SE2
) -> tuple[SubmapId, SubmapId]:
    best = (-1.0, source.reference, target.reference)
    for source_id, T_source in source.T_reference_submap.items():
        T_target = T_target_source @ T_source
        for target_id, T_other in target.T_reference_submap.items():
            T_between = T_other.inverse() @ T_target
            area = library.shared_area_m2(source_id, target_id, T_between)
            if area > best[0]:
                best = area, source_id, target_id
    return best[1], best[2]


def _distrust(
    library: Library, source: SubmapGroup, target: SubmapGroup, edge: Edge
) -> FloatArray:
    """Covariance (3, 3) that a registration cannot know of: the cells, and bent maps."""
    cell_m = _EDGE_SIGMA_CELLS * library.submaps[edge.target].submap.grid.spec.resolution_m
    radius_m = min(library.submaps[i].radius_m for i in (edge.source, edge.target))
    cell_rad = cell_m / max(radius_m, cell_m)
    floor = np.diag([cell_m**2, cell_m**2, cell_rad**2])
    bent_source = library.odometry.spread(edge.source, source.ids)
    bent_target = library.odometry.spread(edge.target, target.ids)
    motion = edge.T_target_source
    return floor + bent_target + compose_covariance(bent_source, motion, SE2(), SE2())
