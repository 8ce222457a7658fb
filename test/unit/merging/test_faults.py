"""A bad network, dying processes and bad vehicles leave the map as it would have been."""

import dataclasses

import numpy as np
import pytest
from unit.merging.fleet import map_bytes, three_vehicles

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.merging import MapQueue, MapQueueConfig, SubmapState
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.sessions.session import load_session, save_session
from uw_dslam_ros2.sim.maps.fleets import KnowingMatcher, answer_all, refuse

FLEET = three_vehicles()
CONFIG = MapQueueConfig(anchor_vehicle="auv_1")
ANCHOR = ("auv_1", 0, 0)


def calm_map() -> bytes:
    queue = MapQueue(CONFIG)
    for submap_id in sorted(FLEET.submaps):
        queue.add_submap(FLEET.submaps[submap_id])
    answer_all(queue, KnowingMatcher(FLEET))
    return map_bytes(queue)


class BadNetwork:
    """Loses, doubles, reorders and delays submaps and answers; kills the manager now and then.

    A killed manager comes back with what its session holds: the state after the last change.
    """

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.queue = MapQueue(CONFIG)
        self.matcher = KnowingMatcher(FLEET)
        self.late: list[tuple[int, object]] = []
        self.num_kills = 0
        self.queue.add_submap(FLEET.submaps[ANCHOR])

    def run(self) -> None:
        """Every submap is sent in some order, several times; some arrive much later."""
        copies = [i for i in FLEET.submaps for _ in range(self.rng.integers(1, 4))]
        for index in self.rng.permutation(len(copies)):
            if self.rng.random() < 0.3:
                continue  # lost; the topic is latched, so it comes again at the end
            self.queue.add_submap(FLEET.submaps[copies[index]])
            self.queue.is_growing = bool(self.rng.random() < 0.7)
            self.serve(int(self.rng.integers(0, 4)))
            if self.rng.random() < 0.15:
                self.kill()
        for submap in FLEET.submaps.values():
            self.queue.add_submap(submap)
        self.queue.is_growing = False
        for request_id, answer in self.late:
            self.queue.add_result(request_id, answer)
        self.queue = MapQueue.from_state(self.queue.to_state(), CONFIG)
        answer_all(self.queue, self.matcher)

    def serve(self, max_requests: int) -> None:
        for request in self.queue.next_requests(max_requests):
            fate, answer = self.rng.random(), self.matcher(request)
            if fate < 0.2:  # its server died
                self.queue.cancel_request(request.request_id)
            elif fate < 0.4:  # minutes late, after it was asked again
                self.queue.cancel_request(request.request_id)
                self.late.append((request.request_id, answer))
            else:
                self.queue.add_result(request.request_id, answer)
                if fate < 0.6:  # twice
                    self.queue.add_result(request.request_id, answer)
        self.rng.shuffle(self.late)

    def kill(self) -> None:
        before = self.queue.num_registrations, {r.submap.submap_id for r in self.queue.submaps()}
        self.queue = MapQueue.from_state(self.queue.to_state(), CONFIG)
        after = self.queue.num_registrations, {r.submap.submap_id for r in self.queue.submaps()}
        assert before == after
        self.num_kills += 1


def test_a_bad_network_and_kills_change_nothing_in_the_end():
    expected, num_kills = calm_map(), 0
    for seed in range(5):
        network = BadNetwork(seed)
        network.run()
        assert map_bytes(network.queue) == expected
        num_kills += network.num_kills
    assert num_kills > 3


def test_a_session_read_after_any_answer_goes_on_to_the_same_map(tmp_path):
    queue = MapQueue(CONFIG)
    for submap_id in sorted(FLEET.submaps):
        queue.add_submap(FLEET.submaps[submap_id])
    matcher = KnowingMatcher(FLEET)
    expected, states = calm_map(), 0
    while requests := queue.next_requests(1):
        queue.add_result(requests[0].request_id, matcher(requests[0]))
        save_session(tmp_path, queue)
        resumed = load_session(tmp_path, CONFIG)
        assert resumed.num_registrations == queue.num_registrations
        assert map_bytes(resumed) == map_bytes(queue)
        answer_all(resumed, matcher)
        assert map_bytes(resumed) == expected
        states += 1
    assert states > 3


def noise(vehicle: str, sequence: int):
    """A submap in good order that shows nothing that is there."""
    model = FLEET.submaps["auv_1", 0, sequence]
    rng = np.random.default_rng([7, sequence])
    values = np.where(model.grid.known, rng.choice([0, 100], model.grid.values.shape), -1)
    grid = OccupancyMap(model.grid.spec, values.astype(np.int8))
    return dataclasses.replace(model, vehicle_id=vehicle, grid=grid)


def test_a_vehicle_that_sends_nonsense_stays_out():
    """Its maps match nothing; the other vehicles' map is as if it were not there."""
    matcher = KnowingMatcher(FLEET)

    def answer(request):
        vehicles = {i[0] for i in (*request.source_ids, *request.target_ids)}
        return refuse(request) if "auv_0" in vehicles else matcher(request)

    queue = MapQueue(CONFIG)
    for submap_id in sorted(FLEET.submaps):
        queue.add_submap(FLEET.submaps[submap_id])
        if submap_id[0] == "auv_1":
            queue.add_submap(noise("auv_0", submap_id.sequence))
            bad = dataclasses.replace(
                noise("auv_0", submap_id.sequence), revision=1, covariance=np.full((3, 3), np.nan)
            )
            with pytest.raises(InvalidInputError, match="auv_0/"):
                queue.add_submap(bad)
    answer_all(queue, answer)
    states = {r.submap.vehicle_id: r.state for r in queue.submaps()}
    assert states["auv_0"] is SubmapState.WAITING
    assert {states[v] for v in ("auv_1", "auv_2", "auv_3")} == {SubmapState.MERGED}
    assert map_bytes(queue) == calm_map()


def test_two_vehicles_of_one_name_are_told_and_the_first_one_stays():
    queue = MapQueue(CONFIG)
    for submap_id in sorted(FLEET.submaps):
        queue.add_submap(FLEET.submaps[submap_id])
    for sequence in range(4):
        impostor = dataclasses.replace(FLEET.submaps["auv_3", 0, sequence], vehicle_id="auv_1")
        with pytest.raises(InvalidInputError, match="two vehicles of this name"):
            queue.add_submap(impostor)
    answer_all(queue, KnowingMatcher(FLEET))
    assert map_bytes(queue) == calm_map()


@pytest.mark.parametrize("shift_s", [-1.5e9, 30.0, 4e8])
def test_clocks_that_are_apart_change_no_map(shift_s):
    """Each vehicle keeps its own time; only trajectories carry it."""
    queue = MapQueue(CONFIG)
    shift_ns = int(shift_s * 1e9)
    for submap_id in sorted(FLEET.submaps):
        submap = FLEET.submaps[submap_id]
        if submap_id[0] == "auv_2":
            submap = dataclasses.replace(
                submap,
                stamp_ns=submap.stamp_ns + shift_ns,
                trajectory_stamp_ns=submap.trajectory_stamp_ns + shift_ns,
            )
        queue.add_submap(submap)
    answer_all(queue, KnowingMatcher(FLEET))
    assert map_bytes(queue) == calm_map()
    stamps_ns = queue.trajectories()["auv_2"][0]
    assert stamps_ns[0] == FLEET.submaps["auv_2", 0, 0].trajectory_stamp_ns[0] + shift_ns


def test_a_withdrawn_submap_of_a_killed_manager_stays_out():
    queue = MapQueue(CONFIG)
    for submap_id in sorted(FLEET.submaps):
        queue.add_submap(FLEET.submaps[submap_id])
    answer_all(queue, KnowingMatcher(FLEET))
    queue.withdraw(("auv_2", 0, 1))
    answer_all(queue, KnowingMatcher(FLEET))
    resumed = MapQueue.from_state(queue.to_state(), CONFIG)
    resumed.add_submap(dataclasses.replace(FLEET.submaps["auv_2", 0, 1], revision=9))
    answer_all(resumed, KnowingMatcher(FLEET))
    states = {r.submap.submap_id: r.state for r in resumed.submaps()}
    assert states["auv_2", 0, 1] is SubmapState.WITHDRAWN
    assert SE2() == next(
        r.T_component_submap for r in resumed.submaps() if r.submap.submap_id == ANCHOR
    )
