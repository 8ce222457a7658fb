import pytest
from unit.merging.fleet import map_bytes, three_vehicles

from uw_dslam_ros2.core.link.transport.channel import ChannelConfig
from uw_dslam_ros2.core.merging import MapQueue, MapQueueConfig
from uw_dslam_ros2.sim.maps.fleets import KnowingMatcher, answer_all
from uw_dslam_ros2.sim.missions.link_mission import run_link


def queue_of(events, fleet, is_growing):
    """A manager that gets submaps as they come, and has them registered meanwhile."""
    # Else the map has the cells of the layer of its first submap that comes first.
    queue = MapQueue(MapQueueConfig(anchor_vehicle="auv_1", resolution_m=0.5))
    matcher = KnowingMatcher(fleet)
    queue.is_growing = is_growing
    for number, (_, submap) in enumerate(events):
        queue.add_submap(submap)
        if is_growing and number % 5 == 4:
            answer_all(queue, matcher)
    queue.is_growing = False
    answer_all(queue, matcher)
    return queue


@pytest.mark.slow
def test_all_who_have_received_the_same_have_the_same_map():
    fleet = three_vehicles()
    run = run_link(list(fleet.submaps.values()), ChannelConfig(loss=0.3, seed=3), limit_s=600.0)
    orders = [[s.submap_id for _, s in events] for events in run.known.values()]
    assert len(set(map(tuple, orders))) == 3, "each received them in another order"
    queues = [queue_of(events, fleet, k == 1) for k, events in enumerate(run.known.values())]
    maps = [map_bytes(queue) for queue in queues]
    assert maps[0] == maps[1] == maps[2] != b""
    assert all(record.component == 0 for record in queues[2].submaps())


def test_half_the_mission_in_blackout_changes_nothing_in_the_end():
    fleet = three_vehicles(num_submaps=3)
    submaps = list(fleet.submaps.values())
    begin_ns = min(int(s.trajectory_stamp_ns[0]) for s in submaps)
    length_s = max((s.stamp_ns - begin_ns) * 1e-9 for s in submaps)
    half = [(0.25 * length_s, 0.75 * length_s)]
    maps = set()
    for blackouts in ([], half):
        run = run_link(submaps, ChannelConfig(loss=0.3), limit_s=600.0, blackouts=blackouts)
        assert (run.channel.blacked_out > 0) == bool(blackouts)
        maps |= {map_bytes(queue_of(events, fleet, False)) for events in run.known.values()}
    assert len(maps) == 1


def test_nobody_knows_a_submap_before_it_is_closed():
    fleet = three_vehicles(num_submaps=2)
    run = run_link(list(fleet.submaps.values()), ChannelConfig(), limit_s=600.0)
    begin_ns = min(s.trajectory_stamp_ns[0] for s in fleet.submaps.values())
    for events in run.known.values():
        for at_s, submap in events:
            closed = fleet.submaps[submap.submap_id].stamp_ns
            assert at_s >= (closed - begin_ns) * 1e-9 - 1e-6
