"""A fleet of three vehicles, and decisions about it."""

from unit.merging.fleet import three_vehicles

from uw_dslam_ros2.core.merging import (
    Decision,
    DecisionKind,
    MapQueue,
    SubmapState,
)
from uw_dslam_ros2.core.submap import SubmapId
from uw_dslam_ros2.sim.maps.fleets import KnowingMatcher, answer_all

FLEET = three_vehicles()
IDS = sorted(FLEET.submaps)
KNOWING = KnowingMatcher(FLEET)
ANN = {"who": "Ann", "stamp_ns": 5}
TRUTH = FLEET.T_world_submap


def id_of(number, sequence):
    return SubmapId(f"auv_{number}", 0, sequence)


def filled(ids=None, config=None):
    queue = MapQueue(config)
    for submap_id in ids or IDS:
        queue.add_submap(FLEET.submaps[submap_id])
    return queue


def settled(matcher=KNOWING, config=None):
    queue = filled(config=config)
    answer_all(queue, matcher)
    return queue


def true_pose(source, target):
    return TRUTH[target].inverse() @ TRUTH[source]


def confirm(source, target, motion=None, **rest):
    sigmas = {"sigma_m": 0.1, "sigma_rad": 0.01} | ANN | rest
    motion = motion or true_pose(source, target)
    return Decision(
        DecisionKind.CONFIRM, source=source, target=target, T_target_source=motion, **sigmas
    )


def about(kind, source, target=None, **rest):
    return Decision(kind, source=source, target=target, **ANN, **rest)


def undo(number):
    return Decision(DecisionKind.UNDO, undone=number, **ANN)


def groups(queue):
    """Which vehicles share a frame."""
    found = {}
    for record in queue.submaps():
        if record.state is not SubmapState.WITHDRAWN:
            found.setdefault(record.component, set()).add(record.submap.vehicle_id)
    return sorted(map(sorted, found.values()))


def remark_of(queue, number):
    return queue.decisions()[number - 1].remark
