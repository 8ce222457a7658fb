"""Everything that a map queue has to remember."""

from __future__ import annotations

from dataclasses import dataclass

from uw_dslam_ros2.core.grid import GridSpec
from uw_dslam_ros2.core.merging.graph.answers import Answer, QueryKey
from uw_dslam_ros2.core.merging.steering.decisions import Decision
from uw_dslam_ros2.core.merging.steering.georeference import Fix
from uw_dslam_ros2.core.submap import Submap, SubmapId, Track

__all__ = ["QueueState"]


@dataclass(frozen=True, slots=True, eq=False)
class QueueState:
    """What came in and what others decided; the map follows from it.

    Requests in flight are not part of it: after a restart they are asked again.
    """

    submaps: tuple[Submap, ...]
    """Newest revision of each, by vehicle, run and sequence."""
    decisions: tuple[Decision, ...]
    """What people decided, in order."""
    answers: tuple[Answer, ...]
    anchor: SubmapId | None
    """Submap that pins the global frame."""
    lattice: GridSpec | None
    """Its cells, as the lattice of the global map."""
    tracks: tuple[Track, ...]
    """In order of first arrival."""
    next_request_id: int
    standing: frozenset[QueryKey]
    """Answers that hold in the graph."""
    is_pinned: bool = False
    """Whether the global frame stays where it is, whatever comes."""
    fixes: tuple[Fix, ...] = ()
    """What instruments say of where submaps lie on earth."""
