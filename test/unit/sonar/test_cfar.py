"""Constant false alarm rates: the factors, and the kernel against a slow obvious version."""

import numpy as np
import pytest

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.sonar.cfar import (
    cell_averaging_factor,
    cell_averaging_factors,
    smallest_of_factor,
)
from uw_dslam_ros2.core.sonar.kernels import cfar_ratio, row_ratio

pytestmark = pytest.mark.kernels


def slow_ratio(power, num_train, num_guard, rate, is_smallest_of, floor):
    num_rows, num_beams = power.shape
    ratio = np.zeros(power.shape)
    for r in range(num_rows):
        lead = power[r + num_guard + 1 : r + num_guard + 1 + num_train].astype(float)
        lag = power[max(0, r - num_guard - num_train) : max(0, r - num_guard)].astype(float)
        for b in range(num_beams):
            if is_smallest_of and len(lead) == num_train == len(lag):
                noise = min(lead[:, b].mean(), lag[:, b].mean())
                threshold = smallest_of_factor(num_train, rate) * noise
            else:
                cells = np.concatenate([lead[:, b], lag[:, b]])
                if len(cells) == 0:
                    continue
                threshold = cell_averaging_factor(len(cells), rate) * cells.mean()
            ratio[r, b] = power[r, b] / max(threshold, floor)
    return ratio


@pytest.mark.parametrize("is_smallest_of", [False, True])
@pytest.mark.parametrize(("num_train", "num_guard"), [(3, 0), (5, 2), (12, 1)])
def test_kernel_is_the_obvious_loop(rng, is_smallest_of, num_train, num_guard):
    power = rng.exponential(2.0, (37, 5)).astype(np.float32)
    factor = smallest_of_factor(num_train, 1e-3) if is_smallest_of else 0.0
    factors = cell_averaging_factors(2 * num_train, 1e-3)
    ratio = cfar_ratio(power, num_train, num_guard, factors, factor, 0.5)
    expected = slow_ratio(power, num_train, num_guard, 1e-3, is_smallest_of, 0.5)
    np.testing.assert_allclose(ratio, expected, rtol=1e-5)


@pytest.mark.parametrize("is_smallest_of", [False, True])
@pytest.mark.parametrize("rate", [1e-2, 1e-3])
def test_false_alarms_come_at_the_designed_rate(rng, is_smallest_of, rate):
    amplitude = rng.rayleigh(1.0, (1000, 2000)).astype(np.float32)
    num_train = 16
    factor = smallest_of_factor(num_train, rate) if is_smallest_of else 0.0
    factors = cell_averaging_factors(2 * num_train, rate)
    ratio = cfar_ratio(amplitude**2, num_train, 2, factors, factor, 0.0)
    inner = ratio[20:-20]  # at the ends there are fewer noise cells
    expected = rate * inner.size
    # Windows overlap, so alarms are not quite independent: five times the Poisson deviation.
    assert abs((inner > 1.0).sum() - expected) < 5.0 * np.sqrt(expected)


def test_smallest_of_needs_a_higher_factor_than_averaging():
    # The smaller of two noisy means is too small on average.
    assert smallest_of_factor(16, 1e-4) > cell_averaging_factor(32, 1e-4)


def test_one_cell_of_averaging_by_hand():
    # P(x > a y) = 1 / (1 + a) for two exponential cells.
    assert cell_averaging_factor(1, 0.25) == pytest.approx(3.0)
    assert np.isinf(cell_averaging_factor(0, 0.25))


@pytest.mark.parametrize("rate", [0.0, 1.0, -1.0, float("nan")])
def test_impossible_rates_are_refused(rate):
    with pytest.raises(InvalidInputError, match="false_alarm_rate"):
        cell_averaging_factor(8, rate)


def test_adaptive_threshold_ignores_a_strong_minority(rng):
    factor, power = 3.0, rng.uniform(1.0, 2.0, (3, 200)).astype(np.float32)
    # Every second beam is looked at: 100, of which the minority takes 10. What was the k-th of
    # all is then one of the k-th to (k + 10)-th, whichever of them the minority has replaced.
    ordered = np.sort(power[:, ::2].astype(float), axis=1)
    quarter, middle, taken = 25, 50, 10
    power[:, :20] = 1000.0
    ratio = row_ratio(power, factor, 0.0)
    assert (ratio[:, :20] > 1.0).all()
    low = ordered[:, middle] + factor * 2.0 * (ordered[:, middle] - ordered[:, quarter + taken])
    high = ordered[:, middle + taken] + factor * 2.0 * (
        ordered[:, middle + taken] - ordered[:, quarter]
    )
    threshold = power[:, 50:] / ratio[:, 50:]
    assert (threshold >= low[:, None] * (1.0 - 1e-6)).all()
    assert (threshold <= high[:, None] * (1.0 + 1e-6)).all()
