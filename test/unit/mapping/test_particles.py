"""The particle filter: without loops it is odometry, its proposal is the product of Gaussians."""

import math
from dataclasses import replace

import numpy as np
import pytest

from uw_dslam_ros2.core.mapping import VehicleMapperConfig
from uw_dslam_ros2.core.mapping.config import ParticleConfig
from uw_dslam_ros2.core.mapping.loops.particles import ParticleFilter, _proposal
from uw_dslam_ros2.core.pose_graph import chained_covariance
from uw_dslam_ros2.core.se2 import SE2

CONFIG = VehicleMapperConfig(estimator="particle_filter")
STEP = SE2(5.0, 0.5, 0.3)
COVARIANCE = np.diag([0.04, 0.02, 0.0004])


class Section:
    """A closed submap without echoes."""

    points = np.empty((0, 2))


def walked(num_steps, seed=0, num_particles=400):
    particles = ParticleConfig(num_particles=num_particles, seed=seed)
    found = ParticleFilter(replace(CONFIG, particles=particles))
    found.add_first(SE2(1.0, 2.0, 0.1), np.zeros((3, 3)))
    sections = [Section()]
    for _ in range(num_steps):
        found.close_loops(sections)
        found.add_next(STEP, COVARIANCE)
        sections.append(Section())
    found.close_loops(sections)
    return found


def test_without_echoes_it_is_odometry():
    found = walked(6)
    pose, covariance = SE2(1.0, 2.0, 0.1), np.zeros((3, 3))
    for estimate in found.poses:
        distance, turn = estimate.distance_to(pose)
        assert distance < 0.03  # the mean of turned steps is a little shorter than one of them
        assert turn < 1e-4
        last_covariance = covariance
        pose, covariance = pose @ STEP, chained_covariance(pose, covariance, STEP, COVARIANCE)
    # 400 draws know a standard deviation to 3.5 %; linearised, the truth is a little off as well.
    expected = np.sqrt(np.diag(last_covariance))
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance())), expected, rtol=0.15)


def test_an_undrawn_step_counts_in_the_covariance():
    found = walked(2)
    before = found.covariance()
    found.add_next(STEP, COVARIANCE)
    expected = chained_covariance(found.poses[-2], before, STEP, COVARIANCE)
    np.testing.assert_allclose(found.covariance(), expected, rtol=0.05, atol=1e-4)


def test_proposal_is_the_product_of_the_gaussians():
    covariance = np.array([[0.05, 0.01, 0.001], [0.01, 0.03, 0.0], [0.001, 0.0, 0.002]])
    information = np.array([[40.0, 5.0, 1.0], [5.0, 60.0, 0.0], [1.0, 0.0, 900.0]])
    step, found = SE2(1.0, 2.0, 0.3), SE2(1.1, 1.9, 0.32)
    mean, spread, log_weight = _proposal(step, covariance, found, information, 1.5)
    sigma = np.sqrt(np.diag(covariance))
    axes = [np.linspace(-6 * s, 6 * s, 61) for s in sigma]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    cell = math.prod(axis[1] - axis[0] for axis in axes)
    off = grid + step.as_array() - found.as_array()
    prior = np.exp(-0.5 * np.einsum("ni,ij,nj->n", grid, np.linalg.inv(covariance), grid))
    prior /= math.sqrt((2 * math.pi) ** 3 * np.linalg.det(covariance))
    product = prior * np.exp(1.5 - 0.5 * np.einsum("ni,ij,nj->n", off, information, off)) * cell
    total = product.sum()
    expected = (product @ grid) / total
    assert log_weight == pytest.approx(math.log(total), abs=1e-3)
    np.testing.assert_allclose(mean - step.as_array(), expected, atol=1e-4)
    delta = grid - expected
    slow = np.einsum("n,ni,nj->ij", product / total, delta, delta)
    np.testing.assert_allclose(spread, slow, rtol=5e-3, atol=1e-5)


def test_a_match_that_knows_one_direction_moves_only_that():
    information = np.diag([0.0, 1e4, 0.0])
    covariance = np.diag([0.04, 0.04, 1e-4])
    mean, spread, _ = _proposal(SE2(), covariance, SE2(1.0, 0.1, 0.05), information, 0.0)
    np.testing.assert_allclose(mean, [0.0, 0.1, 0.0], atol=1e-3)
    assert spread[0, 0] == pytest.approx(0.04)
    assert spread[1, 1] < 2e-4


def test_resampling_keeps_the_likely_histories_and_the_number():
    found = walked(3, num_particles=100)
    best = found._histories[17].copy()
    found._log_weight[17] += 50.0
    found._resample()
    assert found.num_resampled == 1
    assert found._histories.shape == (100, 4, 3)
    np.testing.assert_array_equal(found._histories, np.broadcast_to(best, (100, 4, 3)))
    np.testing.assert_allclose(found.weights, 0.01)


def test_equal_weights_are_not_resampled():
    found = walked(3)
    before = found._histories.copy()
    found._resample()
    assert found.num_resampled == 0
    np.testing.assert_array_equal(found._histories, before)


def test_a_particle_owns_24_bytes_for_each_submap():
    found = walked(9, num_particles=50)
    assert found._histories.nbytes == 50 * 10 * 24


def test_same_seed_same_particles_other_seed_others():
    assert walked(3)._histories.tobytes() == walked(3)._histories.tobytes()
    assert walked(3)._histories.tobytes() != walked(3, seed=1)._histories.tobytes()
