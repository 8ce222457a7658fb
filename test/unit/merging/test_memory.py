"""What the planning remembers, and that it does not matter to what comes out."""

import itertools

import numpy as np
import pytest

from uw_dslam_ros2.core.merging import MapQueue
from uw_dslam_ros2.core.merging.checks.places import meetings, pose_uncertainty, vague_places
from uw_dslam_ros2.core.merging.graph.library import Library
from uw_dslam_ros2.core.merging.graph.memory import Memory
from uw_dslam_ros2.core.merging.graph.submap_groups import StoredSubmap, shared_area_m2
from uw_dslam_ros2.core.merging.steering.decisions import DecisionLog
from uw_dslam_ros2.core.merging.types import Edge
from uw_dslam_ros2.core.pose_graph import chained_covariance, invert_covariance
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.maps.fleets import KnowingMatcher, answer_all, lawnmower_fleet


@pytest.fixture(scope="module")
def fleet():
    return lawnmower_fleet(3, 8, 5, lane_m=9.0)


@pytest.fixture(scope="module")
def library(fleet):
    stored = {i: StoredSubmap.of(s, 10**6) for i, s in fleet.submaps.items()}
    return Library(stored, DecisionLog(), Memory())


def test_what_is_asked_for_is_kept_and_the_rest_forgotten():
    memory, made = Memory(), []

    def ask(key):
        return memory.remember_solution(key, lambda: made.append(key) or key)

    for number in range(100):
        ask("often")
        assert ask(number) == number
        ask(number)
    assert made.count("often") == 1
    assert len(made) == 101, "what was asked twice in a row was worked out once"
    ask(0)
    assert made.count(0) == 2, "what nobody asked for was kept"


def test_meetings_are_those_of_looking_at_all_pairs(library, fleet):
    sides = [library.track_side(track) for track in library.tracks[:2]]
    ids = [side.T_frame_submap for side in sides]
    truth = fleet.T_world_submap
    first = next(iter(ids[0])), next(iter(ids[1]))
    T_target_source = (
        ids[1][first[1]] @ truth[first[1]].inverse() @ truth[first[0]] @ ids[0][first[0]].inverse()
    )
    shares = {}
    for source, target in itertools.product(*ids):
        T = ids[1][target].inverse() @ T_target_source @ ids[0][source]
        ends = library.submaps[source], library.submaps[target]
        share = shared_area_m2(*ends, T) / min(end.area_m2 for end in ends)
        if share >= 0.25:
            shares[source, target] = share
    found = meetings(library, T_target_source, *sides, 1, 1000)
    assert set(found) == set(shares)
    assert shares[found[0]] == max(shares.values())


def test_covariances_of_odometry_are_those_of_going_step_by_step(library):
    odometry = library.odometry
    steps = {edge.target: edge for edge in odometry.edges}
    for first in library.active:
        covariance, motion, here = np.zeros((3, 3)), SE2(), first
        np.testing.assert_allclose(odometry.covariances([first], [first]), [covariance])
        while here in steps:
            step = steps[here]
            covariance = chained_covariance(
                motion, covariance, step.T_target_source, step.covariance
            )
            motion, here = motion @ step.T_target_source, step.source
            both = odometry.covariances([first, here], [here, first])
            back = invert_covariance(covariance, motion)
            np.testing.assert_allclose(both, [covariance, back], rtol=1e-9, atol=1e-12)


def test_vague_places_are_those_that_no_edge_makes_sure(library, fleet):
    side = library.component_side(fleet.T_world_submap)
    ids = sorted(side.T_frame_submap)
    exact = np.diag([1e-4, 1e-4, 1e-6])
    edges = [
        Edge(source, target, side.between(target, source), exact)
        for target, source in [(ids[1], ids[14]), (ids[20], ids[9]), (ids[2], ids[6])]
    ]
    found = vague_places(library, side, edges, 1, 0.4, 1000)
    assert found
    for (source, target), covariance in found:
        ways = [side.covariance(target, source)]
        ways = ways if source.track == target.track else []
        for edge in edges:
            for main in (edge, edge.reversed()):
                if (main.source.track, main.target.track) == (source.track, target.track):
                    ways.append(pose_uncertainty(main, (source, target), side, side))
        ways = ways or [side.covariance(target, source)]
        traces = [float(np.linalg.eigvalsh(way[:2, :2])[-1]) for way in ways]
        assert np.allclose(covariance, ways[int(np.argmin(traces))])
        assert min(traces) > 0.2**2, "surer than 0.4 cells"


def test_an_edge_over_itself_is_as_sure_as_it_says(library):
    side = library.component_side({i: SE2(3.0 * i.sequence, 1.0, 0.2) for i in library.active})
    ends = sorted(side.T_frame_submap)[3], sorted(side.T_frame_submap)[12]
    covariance = np.diag([0.04, 0.01, 0.001])
    edge = Edge(*ends, side.between(ends[1], ends[0]), covariance)
    assert np.allclose(pose_uncertainty(edge, ends, side, side), covariance)


@pytest.mark.parametrize("batch", [1, 40])
def test_how_many_are_answered_at_once_does_not_change_the_map(batch):
    fleet, results = lawnmower_fleet(5, 4, 1), []
    for size in (3, batch):
        queue = MapQueue()
        for submap_id in sorted(fleet.submaps):
            queue.add_submap(fleet.submaps[submap_id])
        answer_all(queue, KnowingMatcher(fleet), batch=size)
        poses = [(r.submap.submap_id, r.T_component_submap) for r in queue.submaps()]
        results.append((poses, queue.global_map().values.tobytes()))
    assert results[0] == results[1]
