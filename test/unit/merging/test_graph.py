"""Covariances against sampling, the graph against what was planted, cliques against trying all."""

import itertools

import numpy as np
import pytest

from uw_dslam_ros2.core.merging.graph.consistency import Side, consistent_set, cycles_of
from uw_dslam_ros2.core.merging.graph.library import milestone
from uw_dslam_ros2.core.merging.types import Edge
from uw_dslam_ros2.core.pose_graph import (
    compose_covariance,
    invert_covariance,
    mahalanobis,
    residual,
    solve_graph,
)
from uw_dslam_ros2.core.se2 import SE2, wrap_angle


def random_motion(rng):
    return SE2.from_array(rng.uniform(-5, 5, 3))


def random_covariance(rng):
    factor = rng.normal(size=(3, 3)) * (1e-3, 2e-3, 1e-3)
    return factor @ factor.T + 1e-8 * np.eye(3)


def sampled(rng, covariance, function, motion):
    """Covariance of a function of a motion, by trying."""
    draws = rng.multivariate_normal(np.zeros(3), covariance, size=20_000)
    centre = function(motion).as_array()
    found = [function(SE2.from_array(motion.as_array() + d)).as_array() - centre for d in draws]
    values = np.array(found)
    values[:, 2] = wrap_angle(values[:, 2])
    return np.cov(values.T)


@pytest.mark.parametrize("seed", range(3))
def test_covariances_follow_sampling(seed):
    rng = np.random.default_rng(seed)
    left, middle, right = (random_motion(rng) for _ in range(3))
    covariance = random_covariance(rng)
    scale = np.trace(covariance) * 40
    np.testing.assert_allclose(
        compose_covariance(covariance, left, middle, right),
        sampled(rng, covariance, lambda m: left @ m @ right, middle),
        atol=0.03 * scale,
    )
    np.testing.assert_allclose(
        invert_covariance(covariance, middle),
        sampled(rng, covariance, lambda m: m.inverse(), middle),
        atol=0.03 * scale,
    )


def test_an_edge_turned_twice_is_itself():
    rng = np.random.default_rng(0)
    edge = Edge(("a", 0), ("b", 0), random_motion(rng), random_covariance(rng))
    twice = edge.reversed().reversed()
    assert (twice.source, twice.target) == (edge.source, edge.target)
    np.testing.assert_allclose(twice.T_target_source.as_array(), edge.T_target_source.as_array())
    np.testing.assert_allclose(twice.covariance, edge.covariance, atol=1e-12)


def ring(num_poses, rng, sigma):
    """Poses on a circle, firm edges along it, all with noise."""
    truth = {("a", 0): SE2()}
    for i in range(1, num_poses):
        truth["a", i] = truth["a", i - 1] @ SE2(4.0, 0.0, 2 * np.pi / num_poses)
    covariance = np.diag([sigma**2, sigma**2, (0.1 * sigma) ** 2])

    def edge(source, target):
        noise = SE2.from_array(rng.multivariate_normal(np.zeros(3), covariance))
        motion = truth["a", target].inverse() @ truth["a", source]
        return Edge(("a", source), ("a", target), motion @ noise, covariance)

    return truth, edge


def test_false_edges_are_found_and_do_no_harm():
    rng = np.random.default_rng(1)
    truth, edge = ring(12, rng, 0.05)
    firm = [edge(i, i - 1) for i in range(1, 12)]
    right = [edge(11, 0), edge(6, 0), edge(9, 2), edge(8, 3)]
    covariance = right[0].covariance
    wrong = [
        Edge(("a", 10), ("a", 1), SE2(30.0, 5.0, 2.0), covariance),
        Edge(("a", 7), ("a", 2), SE2(-9.0, 5.0, -1.0), covariance),
    ]
    initial = {("a", 0): SE2()}
    for step in firm:
        initial[step.source] = initial[step.target] @ step.T_target_source
    solution = solve_graph(("a", 0), firm, [*right, *wrong], initial, 0.999)
    assert solution.is_inlier.tolist() == [True] * 4 + [False] * 2
    worst = max(T.distance_to(truth[i])[0] for i, T in solution.T_anchor_pose.items())
    assert worst < 0.5
    assert residual(wrong[0], solution.T_anchor_pose)[0] > 5.0


def test_the_largest_consistent_set_is_that_of_trying_all():
    rng = np.random.default_rng(2)
    poses = {(v, i): SE2(4.0 * i, 0.0, 0.1 * i) for v in "ab" for i in range(5)}
    exact = np.diag([1e-4, 1e-4, 1e-6])

    def covariances(targets, _sources):
        return np.array([exact] * len(targets))

    source = Side({i: T for i, T in poses.items() if i[0] == "a"}, covariances)
    target = Side({i: T for i, T in poses.items() if i[0] == "b"}, covariances)
    covariance = np.diag([0.04, 0.04, 0.001])
    T_b_a = SE2(3.0, -2.0, 0.7)
    edges = []
    for index in range(5):
        ends = ("a", index), ("b", (2 * index) % 5)
        motion = poses[ends[1]].inverse() @ T_b_a @ poses[ends[0]]
        if index % 2:
            motion = motion @ SE2.from_array(rng.uniform(-8, 8, 3))
        edges.append(Edge(*ends, motion, covariance))
    weights = [0.9, 0.99, 0.8, 0.99, 0.7]
    found = consistent_set(edges, weights, source, target, 0.99)

    def agree(chosen):
        pairs = list(itertools.combinations(chosen, 2))
        return bool((mahalanobis(*cycles_of(edges, pairs, source, target)) < 11.34).all())

    subsets = itertools.chain.from_iterable(
        itertools.combinations(range(5), n) for n in range(1, 6)
    )
    best = max(filter(agree, subsets), key=lambda chosen: sum(weights[i] for i in chosen))
    assert found == list(best) == [0, 2, 4]


def test_milestones_are_a_function_of_the_count_that_never_falls():
    values = [milestone(count) for count in range(1, 60)]
    assert values[:6] == [1, 2, 3, 4, 4, 6]
    assert values == sorted(values)
    assert all(count / 1.6 < value <= count for count, value in enumerate(values, start=1))
