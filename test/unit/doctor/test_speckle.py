"""What pixels stand for is read from speckle of known laws, and from nothing else."""

import numpy as np
import pytest

from uw_dslam_ros2.core.doctor.samples.speckle import decibels_per_count, patch_levels, quantity_of


def power(seed, shape=(400, 256)):
    """Fully developed speckle over a scene that changes slowly, with a bright wall."""
    rng = np.random.default_rng(seed)
    scene = 1.0 + 0.8 * np.sin(np.linspace(0.0, 9.0, shape[0]))[:, None] * np.ones(shape[1])
    scene[150:154] *= 30.0
    return scene * rng.exponential(size=shape)


@pytest.mark.parametrize(
    ("exponent", "quantity"), [(1.0, "power"), (0.5, "amplitude"), (0.25, "compressed")]
)
def test_the_law_is_recognised(exponent, quantity):
    images = [patch_levels((power(seed) ** exponent).astype(np.float32)) for seed in range(2)]
    assert quantity_of(images) == quantity


@pytest.mark.parametrize("db_per_count", [0.2, 0.4])
def test_a_logarithm_is_recognised_with_its_step(db_per_count):
    images = []
    for seed in range(2):
        decibels = 10.0 * np.log10(power(seed) * 300.0 ** np.linspace(0.0, -1.0, 256))
        counts = (decibels / db_per_count + 160.0).clip(0, 255).astype(np.uint8)
        images.append(patch_levels(counts))
    assert quantity_of(images) == "decibel"
    assert decibels_per_count(images) == pytest.approx(db_per_count, rel=0.15)


@pytest.mark.parametrize("exponent", [1.0, 0.5, 0.25])
def test_no_root_of_an_echo_is_a_logarithm(exponent):
    scene = power(0) * 300.0 ** np.linspace(0.0, -1.0, 256)
    assert decibels_per_count([patch_levels((scene**exponent).astype(np.float32))] * 2) == 0.0


def test_nothing_is_said_of_what_shows_no_speckle():
    coarse = np.minimum(power(0) * 0.5, 255.0).astype(np.uint8)
    assert quantity_of([patch_levels(coarse)]) is None
    thresholded = np.where(power(1) > 3.0, 200.0 * power(1), 0.0).astype(np.uint16)
    assert quantity_of([patch_levels(thresholded)]) is None
    assert quantity_of([patch_levels(np.zeros((400, 256), np.uint8))]) is None
    assert quantity_of([patch_levels(np.ones((8, 8), np.uint8))]) is None
    assert quantity_of([]) is None
