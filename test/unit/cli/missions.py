"""A hand-made outcome of three vehicles, one of them not merged, whose numbers are known."""

import math

import numpy as np

from uw_dslam_ros2.cli.reporting.outcome import Outcome, outcome_of
from uw_dslam_ros2.cli.reporting.scoring import Truth
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging import MapQueue, MatchRequest
from uw_dslam_ros2.core.registration import RegistrationResult, Verdict
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap

SECOND = 1_000_000_000
WAY = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.5, 0.2], [3.0, 1.0, 0.3]])
STAMPS = np.array([10, 11, 12, 13]) * SECOND
T_WORLD_ODOM = {
    "auv_1": SE2(3.0, -2.0, 0.4),
    "auv_2": SE2(10.0, 4.0, -1.1),
    "auv_3": SE2(60.0, 0.0, 0.0),
}


def room(num_cells: int = 60, resolution_m: float = 0.2) -> OccupancyMap:
    """A room with a door and a pillar, seen from its middle."""
    values = np.full((num_cells, num_cells), -1, dtype=np.int8)
    values[10:-10, 8:-8] = 0
    values[10, 8:-8] = values[-11, 8:-20] = 100
    values[10:-10, 8] = values[14:-10, -9] = 100
    values[30:33, 20:22] = 100
    origin = SE2(-0.5 * num_cells * resolution_m, -0.5 * num_cells * resolution_m)
    return OccupancyMap(GridSpec(resolution_m, num_cells, num_cells, origin), values)


def submap(vehicle_id: str) -> Submap:
    """The one submap of a vehicle; its frame is the vehicle's odom."""
    return Submap(
        vehicle_id,
        0,
        0,
        True,
        int(STAMPS[-1]),
        SE2(),
        np.zeros((3, 3)),
        room(),
        trajectory=WAY,
        trajectory_stamp_ns=STAMPS,
    )


def answer(request: MatchRequest) -> RegistrationResult:
    """Tell the truth about auv_1 and auv_2; refuse what auv_3 has a part in."""
    source, target = request.source_reference[0], request.target_reference[0]
    is_known = "auv_3" not in (source, target)
    return RegistrationResult(
        verdict=Verdict.ACCEPTED if is_known else Verdict.NOT_ENOUGH_OVERLAP,
        reason="as planted" if is_known else "the maps share 2% of <their> area",
        T_target_source=T_WORLD_ODOM[target].inverse() @ T_WORLD_ODOM[source],
        covariance=np.diag([1e-4, 1e-4, 1e-6]),
        probability=0.99 if is_known else 0.1,
        score=0.5,
        lower_bound=0.5,
        upper_bound=0.52,
        is_certified=True,
        num_boxes=1234,
        seconds=math.nan,
        overlap=0.6 if is_known else 0.02,
        conflict_ratio=0.01,
        inlier_ratio=0.7,
        num_source_points=100,
        num_target_points=120,
    )


def settled_queue(vehicles: tuple[str, ...] = ("auv_1", "auv_2", "auv_3")) -> MapQueue:
    """A queue that has had all its answers."""
    queue = MapQueue()
    for vehicle_id in vehicles:
        queue.add_submap(submap(vehicle_id))
    while requests := queue.next_requests(3):
        for request in requests:
            queue.add_result(request.request_id, answer(request))
    return queue


def outcome(vehicles: tuple[str, ...] = ("auv_1", "auv_2", "auv_3")) -> Outcome:
    """What came out of it."""
    return outcome_of(settled_queue(vehicles))


def truth() -> Truth:
    """Where all three were."""
    poses = {
        name: np.array([(motion @ SE2.from_array(pose)).as_array() for pose in WAY])
        for name, motion in T_WORLD_ODOM.items()
    }
    return Truth({name: (STAMPS, pose) for name, pose in poses.items()}, None)
