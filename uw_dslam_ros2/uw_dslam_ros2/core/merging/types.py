"""What goes in and out of the map queue."""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core import pose_graph
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging.graph.answers import QueryKey
from uw_dslam_ros2.core.registration.result import PriorWindow
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sparse_cells import SparseCells
from uw_dslam_ros2.core.submap import Submap, SubmapId

__all__ = [
    "Constraint",
    "ConstraintKind",
    "Edge",
    "MapProvenance",
    "MatchRequest",
    "SubmapRecord",
    "SubmapState",
]

FloatArray = NDArray[np.float64]

Edge = pose_graph.Edge[SubmapId]
"""Edge of the pose graph between two submaps."""


class SubmapState(enum.IntEnum):
    """Where a submap is; the numbers are those of ``uw_dslam_msgs/SubmapInfo``."""

    WAITING = 1
    MERGED = 2
    WITHDRAWN = 3
    SET_ASIDE = 4


class ConstraintKind(enum.IntEnum):
    """What an edge comes from; the numbers are those of ``uw_dslam_msgs/Constraint``."""

    ODOMETRY = 1
    REGISTRATION = 2
    CONFIRMED = 3
    """A person says so."""


@dataclass(frozen=True, slots=True, eq=False)
class MatchRequest:
    """One registration that the queue asks for; answer it through ``MapQueue.add_result``.

    The maps are fused from the submaps named in ``source_ids`` and ``target_ids``; each map's
    frame is that of its ``*_reference`` submap.
    """

    request_id: int
    source: OccupancyMap
    target: OccupancyMap
    prior: PriorWindow | None
    source_ids: tuple[SubmapId, ...]
    target_ids: tuple[SubmapId, ...]
    source_reference: SubmapId
    target_reference: SubmapId
    key: QueryKey
    """What makes two requests the same question; see `MapQueue.correct_answer`."""


@dataclass(frozen=True, slots=True, eq=False)
class SubmapRecord:
    """What the queue knows of one submap; as in ``uw_dslam_msgs/SubmapInfo``."""

    submap: Submap
    state: SubmapState
    component: int  # submaps with the same number share one frame; 0 is the global map's
    T_component_submap: SE2  # in "map" for component 0
    num_tries: int
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Constraint:
    """One edge of the pose graph; as in ``uw_dslam_msgs/Constraint``.

    ``covariance`` (3, 3) of x [m], y [m], yaw [rad] in the target's frame. The residuals compare
    the measured with the optimised motion; they are NaN while the two submaps share no frame.
    """

    kind: ConstraintKind
    source: SubmapId
    target: SubmapId
    T_target_source: SE2
    covariance: FloatArray
    residual_m: float
    residual_rad: float
    is_inlier: bool
    is_unsure: bool = False
    """A registration that was refused by itself; believed because others agree with it."""


@dataclass(frozen=True, slots=True, eq=False)
class MapProvenance:
    """Which submaps each cell of the global map comes from, and where they disagree.

    Parameters
    ----------
    spec
        Place of the cells in frame "map"; that of the global map.
    contradictions
        uint16: how many submaps say the opposite of the cell's majority (free, occupied).
    owners
        uint32: index of the cell's set of submaps in `contributors`; 0, the empty set,
        where nothing was seen.
    contributors
        Sets of submaps, each sorted.
    """

    spec: GridSpec
    contradictions: SparseCells
    owners: SparseCells
    contributors: tuple[tuple[SubmapId, ...], ...]

    def of_cell(self, row: int, col: int) -> tuple[SubmapId, ...]:
        """Submaps that saw a cell."""
        return self.contributors[self.owners.at(row, col)]
