"""Many submaps of many vehicles, in any order, into one map."""

from uw_dslam_ros2.core.merging.config import MapQueueConfig
from uw_dslam_ros2.core.merging.drawn.ages import last_seen_ns
from uw_dslam_ros2.core.merging.graph.components import LoopError
from uw_dslam_ros2.core.merging.growing_map import GrowingMap, GrowingMapConfig, MapChange
from uw_dslam_ros2.core.merging.queue import MapQueue
from uw_dslam_ros2.core.merging.state import QueueState
from uw_dslam_ros2.core.merging.steering.decisions import (
    Decision,
    DecisionKind,
    DecisionLog,
    DecisionRecord,
)
from uw_dslam_ros2.core.merging.steering.georeference import Fix, Georeference
from uw_dslam_ros2.core.merging.steering.start_poses import StartPoses
from uw_dslam_ros2.core.merging.types import (
    Constraint,
    ConstraintKind,
    MapProvenance,
    MatchRequest,
    SubmapRecord,
    SubmapState,
)

__all__ = [
    "Constraint",
    "ConstraintKind",
    "Decision",
    "DecisionKind",
    "DecisionLog",
    "DecisionRecord",
    "Fix",
    "Georeference",
    "GrowingMap",
    "GrowingMapConfig",
    "LoopError",
    "MapChange",
    "MapProvenance",
    "MapQueue",
    "MapQueueConfig",
    "MatchRequest",
    "QueueState",
    "StartPoses",
    "SubmapRecord",
    "SubmapState",
    "last_seen_ns",
]
