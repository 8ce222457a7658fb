"""The tables of a field hold upper bounds, everywhere, for any content."""

import math

import numpy as np
import pytest

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.registration.search.field import (
    field_from_samples,
    likelihood_field,
    mixture_field,
)

pytestmark = pytest.mark.kernels


def exact_mixture(points, centers, weights, sigmas):
    square = ((points[:, None, :] - centers[None, :, :]) ** 2).sum(axis=2)
    return (weights * np.exp(-0.5 * square / sigmas**2)).sum(axis=1)


def some_fields(rng):
    centers = rng.uniform(-1.0, 1.0, (30, 2))
    sigmas = rng.uniform(0.05, 0.2, 30)
    weights = rng.uniform(0.1, 3.0, 30)
    yield mixture_field(centers, weights, sigmas)
    yield likelihood_field(centers, weights, np.full(30, 0.1), 40.0)
    yield field_from_samples(rng.normal(size=(17, 40)), (-2.0, 1.0), 0.25)
    yield field_from_samples(rng.normal(size=(1, 1)), (0.0, 0.0), 0.1)


def rectangle(field, low, high):
    """Cells that the rectangle from low to high touches: first column and row, last ones."""
    first = np.floor((np.asarray(low) - field.origin) / field.pitch_m + 0.5 - 1e-9).astype(int)
    last = np.floor((np.asarray(high) - field.origin) / field.pitch_m + 0.5 + 1e-9).astype(int)
    end = np.array(field.coefficients.shape)[::-1] - 1
    return *np.clip(first, 0, end), *np.clip(last, 0, end)


def largest(windows, col, row, last_col, last_row):
    """What the kernels read: the maximum of four windows; None where there are none so large."""
    span = max(last_col - col, last_row - row)
    level = int(math.log2(span + 1))
    if level >= len(windows):
        return None
    size = 1 << level
    rows, cols = [row, max(row, last_row - size + 1)], [col, max(col, last_col - size + 1)]
    return float(windows[level][np.ix_(rows, cols)].max())


def upper_bound(field, low, high):
    """Of the values in a rectangle, from the windows, or over the whole plane."""
    value = largest(field.tables[0], *rectangle(field, low, high))
    return field.maximum if value is None else value


@pytest.mark.parametrize("size", [0.0, 0.01, 0.07, 0.3, 1.0, 4.0])
def test_bounds_hold_in_random_rectangles(size):
    rng = np.random.default_rng(1)
    for field in some_fields(rng):
        extent = field.pitch_m * np.array(field.coefficients.shape)[::-1]
        for _ in range(60):
            low = field.origin + rng.uniform(-0.2, 1.0, 2) * extent
            high = low + size * rng.uniform(0.0, 1.0, 2)
            points = rng.uniform(low, high, (100, 2))
            assert field.values(points).max() <= upper_bound(field, low, high)


def test_curvature_bounds_the_taylor_remainder():
    rng = np.random.default_rng(2)
    for field in some_fields(rng):
        extent = field.pitch_m * np.array(field.coefficients.shape)[::-1]
        for _ in range(200):
            low = field.origin + rng.uniform(-0.1, 1.0, 2) * extent
            high = low + rng.uniform(0.0, 8.0, 2) * field.pitch_m
            curvature = largest(field.tables[1], *rectangle(field, low, high))
            a, b = rng.uniform(low, high, (2, 2))
            middle, ends = field.values([0.5 * (a + b)])[0], field.values([a, b]).mean()
            # A second derivative of at most c lets the mean of the ends rise c |b - a|^2 / 8 above
            # the middle.
            slack = 1e-9 * (1.0 + np.abs(field.coefficients).max())
            assert ends - middle <= curvature * ((b - a) ** 2).sum() / 8.0 + slack


def test_refined_it_is_the_same_function_with_closer_bounds():
    rng = np.random.default_rng(7)
    for field in some_fields(rng):
        fine = field.refined()
        extent = field.pitch_m * np.array(field.coefficients.shape)[::-1]
        points = field.origin + rng.uniform(-0.1, 1.1, (2000, 2)) * extent
        peak = np.abs(field.coefficients).max()
        np.testing.assert_allclose(fine.values(points), field.values(points), atol=1e-6 * peak)
        bounds = fine.tables[0][0].reshape(*field.coefficients.shape[:1], 2, -1, 2)
        coarse = field.tables[0][0]
        assert (bounds.max(axis=(1, 3)) <= coarse + 1e-6 * peak).all()


def test_slopes_are_those_of_the_values():
    rng = np.random.default_rng(8)
    for field in some_fields(rng):
        extent = field.pitch_m * np.array(field.coefficients.shape)[::-1]
        points = field.origin + rng.uniform(0.0, 1.0, (200, 2)) * extent
        slopes, step = field.slopes(points), 1e-5 * field.pitch_m
        for axis in range(2):
            ahead = points + step * np.eye(2)[axis]
            behind = points - step * np.eye(2)[axis]
            change = (field.values(ahead) - field.values(behind)) / (2.0 * step)
            np.testing.assert_allclose(slopes[:, axis], change, atol=1e-3 * np.abs(slopes).max())


@pytest.mark.parametrize("nodes_per_sigma", [1.0, 3.0, 5.0])
@pytest.mark.parametrize("num_centers", [1, 4, 300])
def test_mixture_error_holds_against_the_exact_sum(nodes_per_sigma, num_centers):
    rng = np.random.default_rng(3)
    centers = rng.uniform(-1.0, 1.0, (num_centers, 2))
    weights, sigmas = rng.uniform(0.0, 2.0, num_centers), rng.uniform(0.1, 0.15, num_centers)
    field = mixture_field(centers, weights, sigmas, nodes_per_sigma=nodes_per_sigma)
    points = rng.uniform(-2.0, 2.0, (20_000, 2))
    miss = np.abs(field.values(points) - exact_mixture(points, centers, weights, sigmas))
    assert miss.max() <= field.error
    assert nodes_per_sigma < 2.0 or field.error < 60.0 * miss.max()


def test_mixture_error_is_small_where_it_matters():
    field = mixture_field(np.zeros((1, 2)), np.ones(1), np.full(1, 0.1))
    assert field.error < 1e-3


def test_a_coarser_lattice_says_so():
    centers = np.array([[0.0, 0.0], [100.0, 100.0]])
    field = mixture_field(centers, np.ones(2), np.full(2, 0.1), max_nodes=10_000)
    assert field.coefficients.size < 12_000
    points = np.random.default_rng(4).normal(0.0, 0.1, (1000, 2))
    miss = np.abs(
        field.values(points) - exact_mixture(points, centers, np.ones(2), np.full(2, 0.1))
    )
    assert miss.max() <= field.error


def test_likelihood_saturates():
    rng = np.random.default_rng(5)
    one = likelihood_field(np.zeros((1, 2)), np.ones(1), np.full(1, 0.1), 100.0)
    crowd = likelihood_field(rng.normal(0.0, 0.03, (10, 2)), np.ones(10), np.full(10, 0.1), 100.0)
    assert one.values([[0.0, 0.0]])[0] == pytest.approx(1.0, abs=0.01)
    expected = math.log(1.0 + 100.0 * 10.0) / math.log(101.0)
    assert 1.2 < crowd.values([[0.0, 0.0]])[0] < expected + 0.01


def test_signed_samples_keep_their_range():
    rng = np.random.default_rng(6)
    samples = rng.normal(size=(9, 12))
    field = field_from_samples(samples, (1.0, 2.0), 0.5)
    values = field.values(rng.uniform(-2.0, 10.0, (5000, 2)))
    assert values.max() <= samples.max()
    assert values.min() >= samples.min()
    assert field.values([[-10.0, 0.0], [100.0, 3.0]]).tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("samples", "pitch"),
    [(np.zeros(3), 1.0), (np.full((2, 2), np.nan), 1.0), (np.ones((2, 2)), 0.0)],
)
def test_bad_samples_are_refused(samples, pitch):
    with pytest.raises(InvalidInputError):
        field_from_samples(samples, (0.0, 0.0), pitch)
