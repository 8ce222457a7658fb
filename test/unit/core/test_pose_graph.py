"""Sparse, robust pose graphs against slow dense least squares and against what was planted."""

import itertools

import numpy as np
import pytest
from scipy.optimize import least_squares

from uw_dslam_ros2.core.pose_graph import Edge, Marginals, chi2_threshold, solve_graph
from uw_dslam_ros2.core.se2 import SE2, wrap_angle

STEP_COVARIANCE = np.array([[4e-2, 5e-3, 1e-3], [5e-3, 2e-2, 0.0], [1e-3, 0.0, 1e-4]])
LOOP_COVARIANCE = np.diag([2.5e-3, 9e-3, 2.5e-5])


def random_graph(seed, num_poses=12, num_loops=12, num_false=0):
    """A winding way and loops over it, the false ones first: firm, loose, first guess."""
    rng = np.random.default_rng(seed)
    truth = [SE2()]
    for _ in range(num_poses - 1):
        truth.append(truth[-1] @ SE2(8.0, 0.0, rng.normal(0.0, 0.6)))

    def edge(source, target, covariance, off):
        noise = SE2.from_array(rng.multivariate_normal(np.zeros(3), covariance))
        motion = SE2.from_array((truth[target].inverse() @ truth[source]).as_array()) @ noise @ off
        return Edge(source, target, motion, covariance)

    firm = [edge(i, i - 1, STEP_COVARIANCE, SE2()) for i in range(1, num_poses)]
    pairs = rng.permutation(list(itertools.combinations(range(num_poses), 2)))[:num_loops]
    loose = []
    for k, (one, other) in enumerate(pairs.tolist()):
        far = SE2(*rng.uniform(3.0, 9.0, 2), rng.uniform(-3.0, 3.0))
        ends = (one, other) if rng.random() < 0.5 else (other, one)
        loose.append(edge(*ends, LOOP_COVARIANCE, far if k < num_false else SE2()))
    guess = {0: SE2()}
    for step in firm:
        guess[step.source] = guess[step.target] @ step.T_target_source
    return firm, loose, guess


def dense_solution(edges, guess, anchor):
    """Poses (N, 3) and covariance (3N - 3, 3N - 3) by dense least squares."""
    keys = [key for key in guess if key != anchor]
    roots = [
        np.linalg.cholesky(np.linalg.inv(e.covariance + np.diag([1e-6, 1e-6, 1e-8]))).T
        for e in edges
    ]

    def residuals(flat):
        poses = {anchor: guess[anchor]}
        poses |= {k: SE2.from_array(p) for k, p in zip(keys, flat.reshape(-1, 3), strict=True)}
        found = []
        for edge, root in zip(edges, roots, strict=True):
            predicted = (poses[edge.target].inverse() @ poses[edge.source]).as_array()
            off = predicted - edge.T_target_source.as_array()
            off[2] = wrap_angle(off[2])
            found.append(root @ off)
        return np.concatenate(found)

    start = np.concatenate([guess[key].as_array() for key in keys])
    fit = least_squares(residuals, start, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    return dict(zip(keys, fit.x.reshape(-1, 3), strict=True)), np.linalg.inv(fit.jac.T @ fit.jac)


def assert_same(found, expected, atol=1e-5):
    for key, pose in expected.items():
        off = found[key].as_array() - pose
        np.testing.assert_allclose([*off[:2], wrap_angle(off[2])], 0.0, atol=atol)


@pytest.mark.parametrize("seed", range(4))
def test_without_false_edges_it_is_the_dense_solution(seed):
    firm, loose, guess = random_graph(seed)
    solution = solve_graph(0, firm, loose, guess, 1.0 - 1e-9)
    assert solution.is_inlier.all()
    expected, _ = dense_solution([*firm, *loose], guess, 0)
    assert_same(solution.T_anchor_pose, expected)


@pytest.mark.parametrize("seed", range(8))
def test_of_false_edges_nothing_is_left_in_the_solution(seed):
    firm, loose, guess = random_graph(seed, num_false=4)
    solution = solve_graph(0, firm, loose, guess, 0.9999)
    np.testing.assert_array_equal(solution.is_inlier, np.arange(12) >= 4)
    expected, _ = dense_solution([*firm, *loose[4:]], guess, 0)
    assert_same(solution.T_anchor_pose, expected)


def test_a_single_bridge_that_fails_holds_its_part_where_it_says():
    """Two vehicles, and two bridges that contradict each other: at most one is believed."""
    covariance = 1e-4 * np.eye(3)
    firm = [Edge((v, i), (v, i - 1), SE2(5.0), covariance) for v in "ab" for i in (1, 2)]
    bridges = [
        Edge(("b", 0), ("a", 0), SE2(0.0, 4.0), covariance),
        Edge(("b", 2), ("a", 2), SE2(9.0, -7.0, 2.0), covariance),
    ]
    guess = {(v, i): SE2(5.0 * i, 4.0 * (v == "b")) for v in "ab" for i in range(3)}
    solution = solve_graph(("a", 0), firm, bridges, guess, 0.99)
    assert solution.is_inlier.sum() <= 1
    for v in "ab":
        between = solution.T_anchor_pose[v, 0].inverse() @ solution.T_anchor_pose[v, 2]
        assert between.distance_to(SE2(10.0)) == pytest.approx((0.0, 0.0), abs=1e-3)


def test_covariances_are_blocks_of_the_dense_inverse():
    firm, loose, guess = random_graph(3)
    edges = [*firm, *loose]
    expected, dense = dense_solution(edges, guess, 0)
    poses = {0: SE2()} | {key: SE2.from_array(pose) for key, pose in expected.items()}
    marginals = Marginals(0, edges, poses)
    for target, source in ((0, 11), (4, 9), (9, 4)):
        own = {key: slice(3 * key - 3, 3 * key) for key in (target, source)}
        jacobian = np.zeros((3, len(dense)))
        for key in (target, source):
            for axis in range(3):
                if key == 0:
                    continue
                moved = dict(poses)
                off = np.zeros(3)
                off[axis] = 1e-6
                moved[key] = SE2.from_array(poses[key].as_array() + off)
                change = (moved[target].inverse() @ moved[source]).as_array() - (
                    poses[target].inverse() @ poses[source]
                ).as_array()
                jacobian[:, own[key].start + axis] = change / 1e-6
        np.testing.assert_allclose(
            marginals.covariance(target, source),
            jacobian @ dense @ jacobian.T,
            rtol=1e-3,
            atol=1e-6,
        )
    np.testing.assert_allclose(marginals.covariance(7, 7), 0.0, atol=1e-12)


def test_the_anchor_is_a_matter_of_taste():
    """Another anchor, and every pose moved rigidly: the same motions and covariances between."""
    firm, loose, guess = random_graph(5, num_false=3)
    first = solve_graph(0, firm, loose, guess, 0.99)
    T_other = SE2(300.0, -200.0, 2.5)
    moved = {key: T_other @ pose for key, pose in guess.items()}
    second = solve_graph(9, firm, loose, moved, 0.99)
    assert second.T_anchor_pose[9].distance_to(moved[9]) == pytest.approx((0.0, 0.0), abs=1e-6)
    np.testing.assert_array_equal(first.is_inlier, second.is_inlier)
    edges = [*firm, *itertools.compress(loose, first.is_inlier)]
    between, covariances = [], []
    for anchor, solution in ((0, first), (9, second)):
        poses = solution.T_anchor_pose
        between.append({k: (poses[3].inverse() @ T) for k, T in poses.items()})
        covariances.append(Marginals(anchor, edges, poses).covariance(3, 11))
    assert_same(between[0], {k: T.as_array() for k, T in between[1].items()}, atol=1e-5)
    np.testing.assert_allclose(covariances[0], covariances[1], rtol=1e-4)


def test_the_same_edges_in_another_order_give_the_same_poses():
    firm, loose, guess = random_graph(6, num_false=4)
    first = solve_graph(0, firm, loose, guess, 0.99)
    assert solve_graph(0, firm, loose, guess, 0.99).T_anchor_pose == first.T_anchor_pose
    again = solve_graph(0, firm[::-1], loose[::-1], guess, 0.99)
    np.testing.assert_array_equal(again.is_inlier, first.is_inlier[::-1])
    expected = {key: T.as_array() for key, T in first.T_anchor_pose.items()}
    assert_same(again.T_anchor_pose, expected, atol=2e-7)


def test_one_pose_alone_stays_where_it_is():
    solution = solve_graph("a", [], [], {"a": SE2(1.0, 2.0, 3.0)}, 0.99)
    assert solution.T_anchor_pose == {"a": SE2(1.0, 2.0, 3.0)}
    assert solution.is_inlier.shape == (0,)


def test_the_chi_square_test_keeps_the_share_that_it_says():
    rng = np.random.default_rng(0)
    squares = (rng.standard_normal((100_000, 3)) ** 2).sum(axis=1)
    for probability in (0.5, 0.95, 0.99):
        assert (squares < chi2_threshold(probability)).mean() == pytest.approx(
            probability, abs=0.005
        )
