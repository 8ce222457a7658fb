"""Loop closures: a planted loop is found, a periodic pier that fits twice is refused."""

import math

import numpy as np
import pytest

from uw_dslam_ros2.core.mapping import OccupancyConfig, VehicleMapperConfig
from uw_dslam_ros2.core.mapping.loops.graph import SubmapGraph
from uw_dslam_ros2.core.mapping.loops.rivals import without_direction
from uw_dslam_ros2.core.mapping.loops.verdict import decide_loop
from uw_dslam_ros2.core.mapping.scans.matcher import Prior
from uw_dslam_ros2.core.mapping.section import OpenSection
from uw_dslam_ros2.core.pose_graph import chained_covariance
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar import SonarConfig, detections_from_scan
from uw_dslam_ros2.sim.waters.world import cast_rays

CONFIG = VehicleMapperConfig(occupancy=OccupancyConfig(resolution_m=0.1)).suited(0.01)
SPACING = 4.0
BEARINGS = np.linspace(-1.1, 1.1, 120)
S = 1_000_000_000


def piers(distances):
    """Segments (S, 4) of a long quay with piers 3 m long at these distances along it."""
    segments = [(-60.0, 0.0, 60.0, 0.0)]
    segments += [(x + w, 0.0, x + w, 3.0) for x in distances for w in (0.0, 0.8)]
    segments += [(x, 3.0, x + 0.8, 3.0) for x in distances]
    return np.array(segments)


PERIODIC = piers(np.arange(-52.0, 56.0, SPACING))
UNEVEN = piers([-31.0, -22.0, -16.5, -13.0, -6.0, 1.5, 4.7, 9.0, 17.0, 19.5, 28.0, 36.0])


def section(segments, start, rng):
    """A submap of a vehicle that passes 8 m off the quay and looks at it."""
    opened = OpenSection(CONFIG, 0, np.zeros((3, 3)))
    for i in range(13):
        T_submap_base = SE2(0.0, 1.0 * i, 0.0)  # it moves to port and looks ahead, at the quay
        pose = start @ T_submap_base
        hits = cast_rays(segments, (pose.x, pose.y), pose.yaw + BEARINGS, 25.0)
        ranges = hits.range_m + rng.normal(0.0, 0.03, len(BEARINGS))
        found = detections_from_scan(
            i * S, BEARINGS, ranges, 25.0, SonarConfig(neighbor_distance_m=0.0)
        )
        opened.add(found, T_submap_base, SE2(), T_submap_base)
    return opened.close(SE2(), np.diag([1e-4, 1e-4, 1e-6]))


def pair(segments, rng, along=1.0):
    starts = SE2(-6.0, 8.0, -math.pi / 2), SE2(-6.0 + along, 9.0, -math.pi / 2 + 0.05)
    return (
        section(segments, starts[0], rng),
        section(segments, starts[1], rng),
        (starts[0].inverse() @ starts[1]),
    )


def close(target, source, guess):
    return decide_loop(target, source, Prior(guess, np.diag([0.3, 2.0, 0.03]) ** 2), CONFIG)


@pytest.mark.parametrize("along", [1.0, 5.0])
def test_uneven_piers_close_a_loop(rng, along):
    target, source, T_true = pair(UNEVEN, rng, along)
    # Along the quay the guess is off by more than a metre.
    answer = close(target, source, SE2(0.2, 1.3, 0.02) @ T_true)
    assert answer is not None
    distance, turn = answer[0].distance_to(T_true)
    assert distance < 0.02  # 0.006 m and 0.0004 rad were seen
    assert turn < 0.002


@pytest.mark.parametrize("along", [1.0, 5.0])
def test_of_periodic_piers_only_what_lies_across_is_believed(rng, along):
    target, source, T_true = pair(PERIODIC, rng, along)
    guesses = [SE2(0.0, off, 0.0) @ T_true for off in (-SPACING, 0.0, SPACING)]
    # A guess may also be refused altogether.
    answers = [answer for guess in guesses if (answer := close(target, source, guess))]
    assert answers
    for T_target_source, information in answers:
        # The quay runs along the target's y axis; where along it nothing but luck would have told.
        sigma_across, sigma_along = 1.0 / np.sqrt(np.diag(information)[:2] + 1e-12)
        assert sigma_along > 3.0 * SPACING  # 31 m and more were seen
        assert 0.01 < sigma_across < 0.2
        assert abs(T_target_source.x - T_true.x) < 0.02  # 0.005 m and 0.0002 rad were seen
        assert abs(T_target_source.yaw - T_true.yaw) < 0.002


def test_nothing_is_left_along_the_rivals_and_nothing_is_lost_across():
    information = np.diag([400.0, 100.0, 2500.0])
    along = np.array([0.6, 0.8])
    offsets = np.array([[2.4, 3.2], [-2.4, -3.2]])
    left = without_direction(information, offsets)
    np.testing.assert_allclose(left[:2, :2] @ along, 0.0, atol=1e-5)
    # Across, what a projection keeps: information given that the place along is free.
    across = np.array([-0.8, 0.6])
    expected = 1.0 / (across @ np.linalg.inv(information[:2, :2]) @ across)
    assert across @ left[:2, :2] @ across == pytest.approx(expected, rel=1e-5)
    assert left[2, 2] == pytest.approx(2500.0)
    # Rivals on all sides leave next to nothing.
    around = np.array([[3.0, 0.0], [0.0, 3.0], [-3.0, 0.0], [0.0, -3.0]])
    assert np.linalg.eigvalsh(without_direction(information, around)[:2, :2])[-1] < 1.0
    np.testing.assert_array_equal(without_direction(information, np.empty((0, 2))), information)


def graph_of(num_submaps=7):
    """A square that comes back to its start; every submap drifts."""
    step, covariance = SE2(10.0, 0.0, math.pi / 2), np.diag([0.04, 0.04, 1e-4])
    graph = SubmapGraph()
    graph.add_first(SE2(), np.zeros((3, 3)))
    for _ in range(num_submaps - 1):
        graph.add_next(step, covariance)
    return graph, step, covariance


def test_covariance_without_loops_is_that_of_the_steps():
    graph, step, covariance = graph_of()
    pose, expected = SE2(), np.zeros((3, 3))
    for _ in range(6):
        pose, expected = pose @ step, chained_covariance(pose, expected, step, covariance)
    np.testing.assert_allclose(graph.covariance(), expected, rtol=0.02, atol=1e-3)


def test_a_loop_narrows_the_search_for_the_next_one_at_once():
    graph, _, _ = graph_of()
    pose, blind = graph.relative(1, 5)
    graph.add_loop(0, 4, SE2(0.05, -0.04, 0.0), np.diag([400.0, 400.0, 1e4]))
    same, narrow = graph.relative(1, 5)
    assert same == pose
    assert np.trace(narrow[:2, :2]) < 0.5 * np.trace(blind[:2, :2])


def test_a_loop_shrinks_the_covariance_and_a_false_one_does_not():
    graph, _, _ = graph_of()
    blind = np.trace(graph.covariance()[:2, :2])
    graph.add_loop(0, 4, SE2(0.05, -0.04, 0.0), np.diag([400.0, 400.0, 1e4]))
    graph.optimize()
    assert graph.num_loops_believed == 1
    closed = np.trace(graph.covariance()[:2, :2])
    assert closed < 0.5 * blind
    graph.add_loop(1, 5, SE2(9.0, 6.0, 0.8), np.diag([400.0, 400.0, 1e4]))
    graph.optimize()
    assert graph.num_loops_believed == 1
    assert np.trace(graph.covariance()[:2, :2]) == pytest.approx(closed, rel=0.05)
