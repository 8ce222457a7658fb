"""The synthetic problems hold what they promise."""

import numpy as np
import pytest

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.sim.maps.point_sets import outlier_problem, overlap_problem, unrelated_problem


@pytest.mark.parametrize(
    ("share", "num_target"), [(0.0, 100), (0.33, 149), (0.5, 200), (0.9, 1000)]
)
def test_outliers_are_a_share_of_the_target(share, num_target):
    problem = outlier_problem(100, share, seed=1)
    assert problem.source.shape == (100, 2)
    assert problem.target.shape == (num_target, 2)
    moved = problem.T_target_source.apply(problem.source[problem.source_index])
    np.testing.assert_allclose(problem.target[problem.target_index], moved, atol=1e-12)
    assert len(np.unique(problem.target_index)) == 100


def test_noise_has_the_stated_size():
    problem = outlier_problem(4000, noise_m=0.05, seed=2)
    moved = problem.T_target_source.apply(problem.source[problem.source_index])
    residual = problem.target[problem.target_index] - moved
    # The standard error of a standard deviation over 8000 values is 0.8 %; five of them.
    assert residual.std() == pytest.approx(0.05, rel=0.04)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 1.0])
def test_overlap_is_a_share_of_both(share):
    problem = overlap_problem(50, share, seed=3)
    assert problem.source.shape == problem.target.shape == (50, 2)
    assert len(problem.source_index) == round(50 * share)
    moved = problem.T_target_source.apply(problem.source[problem.source_index])
    np.testing.assert_allclose(problem.target[problem.target_index], moved, atol=1e-12)


def test_the_seed_decides_everything():
    for make in (
        lambda seed: outlier_problem(20, 0.5, 0.02, seed=seed),
        lambda seed: overlap_problem(20, 0.5, 0.02, seed=seed),
        lambda seed: unrelated_problem(20, 30, seed=seed),
    ):
        first, again, other = make(4), make(4), make(5)
        np.testing.assert_array_equal(first.target, again.target)
        assert first.T_target_source == again.T_target_source
        assert first.T_target_source != other.T_target_source


def test_unrelated_sets_have_no_pairs():
    problem = unrelated_problem(20, 30, seed=6)
    assert len(problem.source_index) == len(problem.target_index) == 0
    assert problem.target.shape == (30, 2)


@pytest.mark.parametrize(
    "arguments", [(0, 0.1, 0.0), (5, 1.0, 0.0), (5, -0.1, 0.0), (5, 0.1, -1.0), (5, 0.1, np.nan)]
)
def test_bad_arguments_are_refused(arguments):
    with pytest.raises(InvalidInputError):
        outlier_problem(*arguments, seed=0)
