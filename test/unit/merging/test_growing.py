"""While maps grow little is asked; in the end the map is the same."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from unit.merging.fleet import map_bytes, three_vehicles

from uw_dslam_ros2.core.merging import MapQueue, MapQueueConfig
from uw_dslam_ros2.core.merging.checks.verification import _prior_around
from uw_dslam_ros2.core.registration.result import PriorWindow
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.maps.fleets import KnowingMatcher, answer_all, lawnmower_fleet, refuse


def in_turn(fleet):
    """Submaps as vehicles that set out together send them."""
    return [
        fleet.submaps[i] for i in sorted(fleet.submaps, key=lambda i: (i.sequence, i.vehicle_id))
    ]


def fed(fleet, matcher, *, is_growing):
    """All answered after every submap; and how many questions that took."""
    queue = MapQueue(MapQueueConfig(anchor_vehicle=min(fleet.submaps)[0]))
    count = 0
    for submap in in_turn(fleet):
        queue.is_growing = is_growing
        queue.add_submap(submap)
        count += answer_all(queue, matcher)
    return queue, count


@pytest.mark.parametrize("seed", range(2))
def test_the_map_in_the_end_is_that_of_all_at_once_for_fewer_questions(seed):
    fleet = lawnmower_fleet(3, 6, seed)
    matcher = KnowingMatcher(fleet, seed)
    eager, num_eager = fed(fleet, matcher, is_growing=False)
    queue, num_growing = fed(fleet, matcher, is_growing=True)
    assert {record.component for record in queue.submaps()} == {0}
    queue.is_growing = False
    num_growing += answer_all(queue, matcher)
    whole = MapQueue(MapQueueConfig(anchor_vehicle=min(fleet.submaps)[0]))
    for submap in in_turn(fleet):
        whole.add_submap(submap)
    answer_all(whole, matcher)
    assert map_bytes(queue) == map_bytes(eager) == map_bytes(whole)
    assert num_growing < 0.7 * num_eager


def test_a_refused_pair_is_asked_again_only_when_larger():
    fleet = lawnmower_fleet(2, 9, 0)
    asked = []

    def matcher(request):
        asked.append(len(request.source_ids) * len(request.target_ids))
        return refuse(request)

    fed(fleet, matcher, is_growing=True)
    growth = MapQueueConfig().growth ** 2
    assert all(later >= growth * earlier for earlier, later in itertools.pairwise(asked))
    assert 3 <= len(asked) <= 1 + math.log(81) / math.log(growth)


def test_what_holds_goes_on_to_hold_and_moved_poses_ask_nothing():
    fleet = three_vehicles()
    matcher = KnowingMatcher(fleet)
    queue, _ = fed(fleet, matcher, is_growing=True)
    assert {record.component for record in queue.submaps()} == {0}
    for submap in in_turn(fleet):
        nudge = SE2(0.01 * submap.sequence, 0.0, 0.001)
        moved = dataclasses.replace(submap, revision=1, T_odom_submap=submap.T_odom_submap @ nudge)
        assert queue.add_submap(moved)
        assert answer_all(queue, matcher) == 0
        assert {record.component for record in queue.submaps()} == {0}


def test_a_repeat_is_told_from_a_new_submap():
    fleet = three_vehicles()
    queue = MapQueue()
    submap = fleet.submaps["auv_1", 0, 0]
    assert queue.add_submap(submap)
    assert not queue.add_submap(submap)
    assert queue.add_submap(dataclasses.replace(submap, revision=2))
    assert not queue.add_submap(dataclasses.replace(submap, revision=1))


def test_the_paper_mode_does_not_ask_with_every_submap():
    fleet = lawnmower_fleet(2, 9, 1)
    queue, count = MapQueue(MapQueueConfig(mode="pairwise")), 0
    queue.is_growing = True
    for submap in in_turn(fleet):
        queue.add_submap(submap)
        count += answer_all(queue, refuse)
    assert count <= 8  # one for each doubling of either map, not one for each of 17 submaps
    queue.is_growing = False
    answer_all(queue, KnowingMatcher(fleet))
    assert {record.component for record in queue.submaps()} == {0}


def test_windows_hold_what_was_asked_and_hardly_change_when_it_moves():
    rng = np.random.default_rng(0)
    same = 0
    for _ in range(300):
        guess = SE2.from_array(rng.uniform(-40.0, 40.0, 3) * (1.0, 1.0, 0.07))
        half_m, half_rad = rng.uniform(0.5, 10.0), rng.uniform(0.1, 1.0)
        prior = _prior_around(guess, half_m, half_rad)
        shift = np.abs((guess.as_array() - prior.T_target_source.as_array())[:2]).max()
        turn = abs(SE2(yaw=guess.yaw - prior.T_target_source.yaw).yaw)
        assert shift + half_m <= prior.half_width_m + 1e-3
        assert turn + half_rad <= prior.half_width_rad + 1e-3
        assert prior.half_width_m <= 1.5 * half_m
        nudged = SE2(guess.x + 0.01 * half_m, guess.y, guess.yaw)
        same += _key(_prior_around(nudged, half_m, half_rad)) == _key(prior)
    assert same > 270


def _key(prior: PriorWindow):
    return prior.T_target_source, prior.half_width_m, prior.half_width_rad
