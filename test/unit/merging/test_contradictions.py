"""A vehicle whose map does not lie where the graph has put it is set aside, and comes back."""

import dataclasses

import pytest
from unit.merging.fleet import map_bytes

from uw_dslam_ros2.core.merging import MapQueue, SubmapState
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId
from uw_dslam_ros2.sim.maps.fleets import (
    Fleet,
    KnowingMatcher,
    answer_all,
    lawnmower_fleet,
    line_of_poses,
    make_walls,
)

HONEST = ("auv_1", "auv_2", "auv_3")
LIAR, RUN = "liar", 66


def fleet_of(num_vehicles, num_submaps, seed):
    """Parallel lines that overlap, and a further vehicle that crosses them."""
    fleet = Fleet(make_walls(140.0, 0.5, seed))
    for index, name in enumerate(HONEST[:num_vehicles]):
        poses = line_of_poses(SE2(30.0, 40.0 + 11.0 * index), num_submaps, 8.0)
        fleet.add_vehicle(name, poses, seed + index, run_id=10 + index)
    fleet.add_vehicle(
        LIAR, line_of_poses(SE2(32.0, 46.0, 0.05), num_submaps, 8.0), seed + 50, run_id=RUN
    )
    return fleet


def with_false_odometry(fleet):
    """Right submaps, and a way from each to the next that was never driven."""
    for submap_id in [i for i in fleet.submaps if i.vehicle_id == LIAR]:
        submap, n = fleet.submaps[submap_id], submap_id.sequence
        motion = SE2(0.0, 6.0 * (-1) ** n, 0.5 * (-1) ** n)
        fleet.submaps[submap_id] = dataclasses.replace(
            submap, T_odom_submap=submap.T_odom_submap @ motion
        )


def with_half_a_copy(fleet, num_submaps):
    """Its first half is a copy of auv_2's; its own second half is said to follow on that.

    Returns what it would have said of that half if it had told the truth.
    """
    half = num_submaps // 2
    copies = line_of_poses(SE2(30.0, 51.0), half, 8.0)
    own = [SE2(60.0 + 8.0 * k, 75.0, 0.2) for k in range(num_submaps - half)]
    fleet.add_vehicle(LIAR, [*copies, *own], 99, run_id=RUN)
    honest = [fleet.submaps[SubmapId(LIAR, RUN, n)] for n in range(half, num_submaps)]
    last, first = (fleet.submaps[SubmapId(LIAR, RUN, k)] for k in (half - 1, half))
    shift = last.T_odom_submap @ SE2(8.0, 0.0) @ first.T_odom_submap.inverse()
    for n in range(half, num_submaps):
        submap = fleet.submaps[SubmapId(LIAR, RUN, n)]
        fleet.submaps[submap.submap_id] = dataclasses.replace(
            submap, T_odom_submap=shift @ submap.T_odom_submap
        )
    return honest


def merged(submaps, fleet, **matcher):
    queue = MapQueue()
    for submap in submaps:
        queue.add_submap(submap)
    answer_all(queue, KnowingMatcher(fleet, **matcher))
    return queue


def states(queue):
    found = {}
    for record in queue.submaps():
        found.setdefault(record.submap.vehicle_id, set()).add(record.state)
    return found


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("num_submaps", [8, 12])
@pytest.mark.parametrize("lie", ["odometry", "copy"])
def test_a_half_true_vehicle_is_set_aside_as_a_whole_and_the_others_stay(lie, num_submaps, seed):
    fleet = fleet_of(3, num_submaps, seed)
    if lie == "odometry":
        with_false_odometry(fleet)
    else:
        with_half_a_copy(fleet, num_submaps)
    queue = merged(fleet.submaps.values(), fleet)
    found = states(queue)
    assert found[LIAR] in ({SubmapState.SET_ASIDE}, {SubmapState.WAITING})
    assert set.union(*(found[name] for name in HONEST)) == {SubmapState.MERGED}
    assert fleet.position_rmse_m(queue) < 0.3
    reasons = {r.reason for r in queue.submaps() if r.state is SubmapState.SET_ASIDE}
    assert all("which contradicts the others' maps" in reason for reason in reasons)
    backwards = merged([*fleet.submaps.values()][::-1], fleet)
    assert states(backwards) == found
    assert map_bytes(backwards) == map_bytes(queue)


def test_the_reason_counts_what_contradicts():
    fleet = fleet_of(3, 8, 0)
    with_half_a_copy(fleet, 8)
    queue = merged(fleet.submaps.values(), fleet)
    (reason,) = {r.reason for r in queue.submaps() if r.submap.vehicle_id == LIAR}
    assert "4 of its 7 submaps that others have seen too have their walls in free water" in reason


def test_it_comes_back_when_its_submaps_are_mended():
    fleet = fleet_of(3, 8, 0)
    honest = with_half_a_copy(fleet, 8)
    queue = merged(fleet.submaps.values(), fleet)
    assert states(queue)[LIAR] == {SubmapState.SET_ASIDE}
    for submap in honest:
        queue.add_submap(dataclasses.replace(submap, revision=1))
    answer_all(queue, KnowingMatcher(fleet))
    assert set.union(*states(queue).values()) == {SubmapState.MERGED}


@pytest.mark.parametrize("seed", range(4))
def test_nobody_is_set_aside_for_wrong_matches_alone(seed):
    fleet = fleet_of(3, 8, seed)
    queue = merged(fleet.submaps.values(), fleet, seed=seed, wrong_share=0.2)
    assert SubmapState.SET_ASIDE not in set.union(*states(queue).values())


def test_of_two_vehicles_nobody_knows_which_one_is_wrong():
    fleet = fleet_of(1, 8, 0)
    with_half_a_copy(fleet, 8)
    found = states(merged(fleet.submaps.values(), fleet))
    assert SubmapState.SET_ASIDE not in set.union(*found.values())


@pytest.mark.parametrize("seed", range(3))
def test_nobody_is_set_aside_for_the_drift_of_long_lanes(seed):
    """On half-metre cells, poses are held to a metre: walls that lie closer contradict nobody."""
    fleet = lawnmower_fleet(3, 50, seed)
    queue = merged(fleet.submaps.values(), fleet)
    assert set.union(*states(queue).values()) == {SubmapState.MERGED}


def test_lanes_that_share_little_are_tied_where_they_have_drifted_apart():
    fleet = lawnmower_fleet(4, 20, 0)
    queue = merged(fleet.submaps.values(), fleet)
    poses = {r.submap.submap_id: r.T_component_submap for r in queue.submaps()}
    truth = fleet.T_world_submap
    errors = [
        (poses[a].inverse() @ poses[b]).distance_to(truth[a].inverse() @ truth[b])[0]
        for a in poses
        for b in poses
        if a.vehicle_id < b.vehicle_id and truth[a].distance_to(truth[b])[0] < 12.5
    ]
    assert len(errors) == 60
    assert max(errors) < 1.0, "two cells"
