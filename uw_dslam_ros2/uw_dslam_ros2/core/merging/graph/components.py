"""Groups of submaps that hang together, and what joins them."""

from __future__ import annotations

from dataclasses import dataclass

from uw_dslam_ros2.core.merging.graph.answers import QueryKey
from uw_dslam_ros2.core.merging.types import Edge
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId

__all__ = ["Component", "Constraint", "LoopError"]

Component = dict[SubmapId, SE2]
"""``T_component_submap``."""


@dataclass(frozen=True, slots=True, eq=False)
class Constraint:
    """An accepted registration in the graph."""

    key: QueryKey
    edge: Edge
    probability: float
    is_inlier: bool = True
    is_unsure: bool = False
    """Refused by itself; believed because others agree with it."""


@dataclass(frozen=True, slots=True)
class LoopError:
    """By how much a cycle of edges fails to close: as measured, nothing optimised."""

    submaps: tuple[SubmapId, ...]
    error_m: float
    error_rad: float
