"""Scan matching: planted motions, the field against a slow one, what a straight wall allows."""

import numpy as np
import pytest

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.mapping.scans.match_kernels import score_poses, score_window
from uw_dslam_ros2.core.mapping.scans.matcher import LikelihoodField, Prior, match_points, thin
from uw_dslam_ros2.core.se2 import SE2

pytestmark = pytest.mark.kernels

SIGMA = 0.12


def wall(a, b, spacing=0.05):
    a, b = np.asarray(a, float), np.asarray(b, float)
    steps = np.linspace(0.0, 1.0, int(np.linalg.norm(b - a) / spacing))
    return a + steps[:, None] * (b - a)


def corner():
    return np.vstack([wall((0, 0), (8, 0)), wall((8, 0), (8, 5)), wall((3, 2), (4, 4))])


def match(known, source, guess=SE2(), sigma=(0.5, 0.5, 0.1)):
    prior = Prior(guess, np.diag(np.square(sigma)))
    fields = [LikelihoodField(known, np.ones(len(known)), s) for s in (3 * SIGMA, SIGMA)]
    half = tuple(3.0 * s for s in sigma)
    return match_points(fields, source, np.ones(len(source)), prior, half, 0.1)


@pytest.mark.parametrize("seed", range(5))
def test_a_planted_motion_is_found(seed):
    rng = np.random.default_rng(seed)
    truth = SE2(*rng.uniform((-1.0, -1.0, -0.2), (1.0, 1.0, 0.2)))
    known = corner() + rng.normal(0, 0.03, corner().shape)
    source = truth.inverse().apply(corner()) + rng.normal(0, 0.03, corner().shape)
    found = match(known, source)
    distance, turn = found.T_target_source.distance_to(truth)
    assert distance < 0.04
    assert turn < 0.01
    assert found.overlap > 0.9


def test_a_straight_wall_is_not_believed_along_itself():
    known, source = wall((-20, 0), (20, 0)), wall((-4, -3), (4, -3))
    found = match(known, source, SE2(0.0, 2.7, 0.0))
    across = found.information[1, 1]
    assert found.T_target_source.y == pytest.approx(3.0, abs=0.02)
    assert found.information[0, 0] < 1e-3 * across
    # Turned by 40 degrees the free direction turns along.
    turn = SE2(0, 0, 0.7)
    turned = match(turn.apply(known), source, turn @ SE2(0.0, 2.7, 0.0))
    along = turn.rotation() @ (1.0, 0.0)
    normal = turn.rotation() @ (0.0, 1.0)
    planar = turned.information[:2, :2]
    assert along @ planar @ along < 5e-3 * (normal @ planar @ normal)


def test_a_single_match_is_not_surer_than_it_is_good():
    # Against a map without errors one match is much better than it says: a map that is built from
    # matches repeats its errors, and the share of independent information allows for that.
    squares = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        known = corner() + rng.normal(0, 0.03, corner().shape)
        source = corner() + rng.normal(0, 0.03, corner().shape)
        found = match(known, source)
        error = found.T_target_source.as_array()
        squares.append(error @ found.information @ error / 3.0)
    assert np.mean(squares) < 0.02  # 0.006 was seen


def test_information_grows_with_the_number_of_echoes():
    few = match(corner(), corner()[::4])
    many = match(corner(), corner())
    ratio = np.trace(many.information[:2, :2]) / np.trace(few.information[:2, :2])
    assert 3.0 < ratio < 5.0


def test_two_piers_alike_have_no_lead_and_one_has():
    pier = wall((0, 0), (0, 4))
    two = np.vstack([pier, SE2(3.0, 0.0, 0.0).apply(pier)])
    ambiguous = match(two, pier, SE2(1.5, 0.0, 0.0), sigma=(1.0, 0.3, 0.05))
    clear = match(pier, pier, SE2(1.0, 0.0, 0.0), sigma=(1.0, 0.3, 0.05))
    assert ambiguous.lead < 1e-3
    assert clear.lead > 0.5


def test_elsewhere_there_is_no_overlap():
    found = match(corner(), SE2(40.0, 0.0, 0.0).apply(corner()))
    assert found.overlap == 0.0


def test_field_is_the_kernel_density_of_thinned_points(rng):
    points, weight = rng.uniform(0, 3, (50, 2)), rng.uniform(0.1, 2.0, 50)
    field = LikelihoodField(points, weight, 0.2)
    centers, support = thin(points, weight, 0.2)
    for row, col in rng.integers(0, np.array(field.values.shape), (50, 2)):
        p = np.array(field.origin) + (np.array([col, row]) + 0.5) * field.cell_m
        squares = ((centers - p) ** 2).sum(axis=1) / 0.2**2
        density = ((1 - np.exp(-support)) * np.exp(-0.5 * squares)).sum()
        # Beyond 3.5 sigma the kernel is cut.
        assert field.values[row, col] == pytest.approx(1 - np.exp(-density / 1.5), abs=0.02)


def test_scores_are_the_obvious_sums(rng):
    field, cell = rng.random((20, 30)), 0.5
    points, weight = rng.uniform(0, 8, (40, 2)), rng.random(40)
    pose = np.array([0.7, -0.3, 0.2])
    lattice = score_window(
        field, -1.0, -2.0, cell, points, weight, pose, np.array([1, 2, 1]), 0.5, 0.1
    )
    assert lattice.shape == (3, 5, 3)
    for (t, m, n), value in np.ndenumerate(lattice):
        moved = SE2(*(pose + np.array([0.5 * (n - 1), 0.5 * (m - 2), 0.1 * (t - 1)]))).apply(
            points
        )
        expected = 0.0
        for p, w in zip(moved, weight, strict=True):
            col, row = np.floor((p - (-1.0, -2.0)) / cell).astype(int)
            if 0 <= row < 20 and 0 <= col < 30:
                expected += w * field[row, col]
        assert value == pytest.approx(expected)


def test_bilinear_scores_are_exact_on_a_plane():
    rows, cols = np.mgrid[0:20, 0:20]
    field = 2.0 * (cols + 0.5) + 3.0 * (rows + 0.5)
    points = np.array([[4.2, 5.7], [10.0, 3.3]])
    value = score_poses(field, 0.0, 0.0, 1.0, points, np.ones(2), np.array([[0.5, 0.25, 0.0]]))
    moved = points + np.array([0.5, 0.25])
    assert value[0] == pytest.approx((2.0 * moved[:, 0] + 3.0 * moved[:, 1]).sum())


def test_thinning_keeps_weight_and_mean(rng):
    points, weight = rng.normal(0, 5, (200, 2)), rng.random(200)
    mean, total = thin(points, weight, 1.0)
    assert total.sum() == pytest.approx(weight.sum())
    np.testing.assert_allclose(total @ mean, weight @ points)
    assert len(np.unique(np.floor(mean), axis=0)) == len(mean)


def test_same_input_same_bytes():
    first, second = (match(corner(), corner()) for _ in range(2))
    assert first.information.tobytes() == second.information.tobytes()
    assert first.T_target_source == second.T_target_source


def test_a_field_of_nothing_is_refused():
    with pytest.raises(InvalidInputError, match="needs points"):
        LikelihoodField(np.empty((0, 2)), np.empty(0), 0.1)


@pytest.mark.parametrize("seed", range(5))
def test_derivatives_are_those_of_differences_taken_one_by_one(seed):
    rng = np.random.default_rng(seed)
    field = LikelihoodField(corner(), np.ones(len(corner())), 2.0 * SIGMA)
    points, weight = corner()[:: 1 + seed], rng.random(len(corner()[:: 1 + seed]))
    pose, steps = rng.normal(0.0, (0.2, 0.2, 0.03)), np.array([SIGMA, SIGMA, SIGMA / 3.0])
    units = np.diag(steps)

    def score(offset):
        return field.scores(points, weight, (pose + offset)[None])[0]

    gradient, hessian = field.derivatives(points, weight, pose, steps)
    for i in range(3):
        slope = (score(units[i]) - score(-units[i])) / (2.0 * steps[i])
        second = (score(units[i]) + score(-units[i]) - 2.0 * score(np.zeros(3))) / steps[i] ** 2
        assert gradient[i] == pytest.approx(slope, abs=1e-9)
        assert hessian[i, i] == pytest.approx(second, abs=1e-9)
        for j in range(i):
            both, apart = units[i] + units[j], units[i] - units[j]
            mixed = score(both) + score(-both) - score(apart) - score(-apart)
            mixed /= 4.0 * steps[i] * steps[j]
            assert hessian[i, j] == hessian[j, i] == pytest.approx(mixed, abs=1e-9)
    assert np.abs(gradient).max() > 1.0
