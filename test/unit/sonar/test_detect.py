"""The front end on images, scans and points with known answers."""

import itertools
import math

import numpy as np
import pytest

from uw_dslam_ros2.core.errors import ConfigError, InvalidInputError
from uw_dslam_ros2.core.sonar import (
    SonarConfig,
    SonarImage,
    detect,
    detections_from_points,
    detections_from_scan,
)
from uw_dslam_ros2.core.sonar.silence import silent_beams

pytestmark = pytest.mark.kernels

FIXED = SonarConfig(segmentation="fixed", fixed_threshold=0.3, neighbor_distance_m=0.0)


def image(intensity, bin_m=0.1, bearings=None):
    num_ranges, num_beams = intensity.shape
    if bearings is None:
        bearings = np.linspace(-0.6, 0.6, num_beams)
    return SonarImage(7, intensity, bin_m * np.arange(1, num_ranges + 1), np.asarray(bearings))


def noisy(rng, dtype=np.uint8, num_ranges=200, num_beams=64):
    scale = min(np.iinfo(dtype).max, 2**24) if np.issubdtype(dtype, np.integer) else 1.0
    noise = rng.rayleigh(0.02 * scale, (num_ranges, num_beams))
    noise[120:123, 20:40] = 0.8 * scale
    return noise.astype(dtype)


def test_a_target_to_port_has_positive_y():
    intensity = np.zeros((100, 3), np.uint8)
    intensity[49, 2] = 255  # 5 m, 30 degrees to port
    found = detect(image(intensity, bearings=[-math.pi / 6, 0.0, math.pi / 6]), FIXED)
    np.testing.assert_allclose(found.points, [[4.3301270, 2.5]], atol=1e-6)
    assert found.stamp_ns == 7


def test_order_of_bearings_does_not_matter(rng):
    intensity, bearings = noisy(rng), np.linspace(-0.6, 0.6, 64) ** 3
    there = detect(image(intensity, bearings=bearings))
    back = detect(image(intensity[:, ::-1], bearings=bearings[::-1]))
    assert len(there.points) >= 15
    key = np.lexsort(there.points.T)
    np.testing.assert_array_equal(there.points[key], back.points[np.lexsort(back.points.T)])


@pytest.mark.parametrize(
    "dtype", [np.uint8, np.uint16, np.uint32, np.int16, np.float32, np.float64]
)
@pytest.mark.parametrize("segmentation", ["fixed", "adaptive", "cfar_ca", "cfar_soca"])
def test_every_type_and_segmentation_finds_the_wall(rng, dtype, segmentation):
    config = SonarConfig(segmentation=segmentation, returns="strongest")
    found = detect(
        image(noisy(rng, dtype) if dtype != np.uint32 else noisy(rng, dtype) * 200), config
    )
    at_wall = np.abs(np.linalg.norm(found.points, axis=1) - 12.2) < 0.2
    assert at_wall.sum() >= 18
    assert ((found.weight > 0.0) & (found.weight <= 1.0)).all()


@pytest.mark.parametrize(("dtype", "step"), [(np.uint8, 0.3), (np.uint16, 0.002)])
def test_a_logarithm_becomes_the_amplitude_that_it_is_of(rng, dtype, step):
    amplitude = noisy(rng, np.float32) + 1e-3
    counts = 20.0 * np.log10(amplitude) / step + np.iinfo(dtype).max
    logarithm = image(np.round(counts.clip(0, np.iinfo(dtype).max)).astype(dtype))
    found = detect(logarithm, SonarConfig(intensity="decibel", db_per_count=step))
    plain = detect(image(amplitude))
    assert abs(len(found.points) - len(plain.points)) <= 2
    assert len(plain.points) >= 20


def test_a_ring_is_no_wall_and_hides_none(rng):
    bearings = np.linspace(-1.1, 1.1, 64)
    plain = image(noisy(rng), bearings=bearings)
    ringed = plain.intensity.copy()
    ringed[60:62] = 200
    found = detect(image(ringed, bearings=bearings))
    expected = detect(plain)
    wall = np.abs(np.hypot(*expected.points.T) - 12.1) < 0.2
    seen = np.abs(np.hypot(*found.points.T) - 12.1) < 0.2
    assert seen.sum() == wall.sum() == 20
    assert not (np.abs(np.hypot(*found.points.T) - 6.1) < 0.2).any()
    # A narrow fan may look at a wall head-on.
    narrow = detect(image(ringed, bearings=bearings / 3.0))
    assert (np.abs(np.hypot(*narrow.points.T) - 6.1) < 0.2).sum() > 50


def test_memory_order_of_the_image_does_not_matter(rng):
    intensity = noisy(rng)
    for a, b in itertools.pairwise([intensity, np.asfortranarray(intensity), intensity.copy()]):
        np.testing.assert_array_equal(detect(image(a)).points, detect(image(b)).points)


def test_range_is_better_than_a_bin():
    bins = np.arange(100)
    for true_bin in (30.0, 30.2, 30.45, 60.7):
        pulse = 200.0 * np.exp(-0.5 * ((bins - true_bin) / 1.5) ** 2)
        found = detect(image(pulse[:, None].astype(np.uint8), bearings=[0.0]), FIXED)
        assert found.points[0, 0] == pytest.approx(0.1 * (true_bin + 1.0), abs=0.012)


def test_saturated_echo_is_found_once_in_its_middle():
    intensity = np.zeros((50, 1), np.uint8)
    intensity[20:25] = 255
    for returns in ("first", "strongest", "all"):
        config = SonarConfig(
            segmentation="fixed", returns=returns, neighbor_distance_m=0.0, min_separation_m=0.0
        )
        found = detect(image(intensity, bearings=[0.0]), config)
        np.testing.assert_allclose(found.points, [[2.3, 0.0]], atol=1e-9)


def test_which_return_is_kept():
    intensity = np.zeros((100, 1), np.uint8)
    intensity[30], intensity[60], intensity[62] = 120, 250, 140

    def ranges(returns, separation=0.15):
        config = SonarConfig(
            segmentation="fixed", returns=returns, neighbor_distance_m=0.0,
            min_separation_m=separation,
        )  # fmt: skip
        return detect(image(intensity, bearings=[0.0]), config).points[:, 0].round(6).tolist()

    assert ranges("first") == [3.1]
    assert ranges("strongest") == [6.1]
    assert ranges("all") == [3.1, 6.1, 6.3]
    assert ranges("all", separation=0.5) == [3.1, 6.1]


def test_near_field_and_range_gate_are_blank():
    intensity = np.full((100, 4), 255, np.uint8)
    intensity[::2] = 0
    config = SonarConfig(
        segmentation="fixed", returns="all", min_range_m=2.0, max_range_m=5.0,
        min_separation_m=0.0, neighbor_distance_m=0.0,
    )  # fmt: skip
    ranges = np.linalg.norm(detect(image(intensity), config).points, axis=1)
    assert ranges.min() >= 1.99
    assert ranges.max() < 5.0
    beyond = SonarConfig(min_range_m=50.0)
    nothing = detect(image(intensity), beyond)
    assert len(nothing.points) == 0
    assert (nothing.free_range_m == 0.0).all()


def test_distance_constraint_is_the_obvious_double_loop(rng):
    points = rng.uniform((3.0, -5.0), (13.0, 5.0), (120, 2))
    config = SonarConfig(
        neighbor_distance_m=0.6, min_neighbors=2, beamwidth_rad=0.02, min_range_m=0.1
    )
    found = detections_from_points(0, points, config)
    kept = []
    for i, p in enumerate(points):
        reach = 0.6 + 0.02 * np.hypot(*p)
        near = [j for j, q in enumerate(points) if j != i and np.hypot(*(p - q)) <= reach]
        if len(near) >= 2:
            kept.append(p)
    assert 0 < len(kept) < len(points)
    np.testing.assert_array_equal(found.points, kept)


def test_water_is_free_only_before_the_first_echo():
    intensity = np.zeros((100, 3), np.uint8)
    intensity[39, 0] = intensity[70, 0] = 255
    found = detect(image(intensity), FIXED)
    assert found.free_range_m[0] == pytest.approx(3.95)
    # No echo says less than an echo does.
    assert found.free_range_m[1] == pytest.approx(0.5 * 10.0)


def test_a_lone_echo_that_the_filter_drops_still_ends_the_free_water():
    intensity = np.zeros((100, 3), np.uint8)
    intensity[39, 1] = 255
    found = detect(image(intensity), SonarConfig(segmentation="fixed", neighbor_distance_m=0.3))
    assert len(found.points) == 0
    assert found.free_range_m[1] == pytest.approx(3.95)


def test_scan_says_echo_nothing_and_unknown():
    found = detections_from_scan(
        1, [0.5, 0.0, -0.5, 1.0], [2.0, np.inf, np.nan, 0.1], 10.0,
        SonarConfig(neighbor_distance_m=0.0),
    )  # fmt: skip
    np.testing.assert_allclose(found.points, [[2 * math.cos(0.5), 2 * math.sin(0.5)]])
    np.testing.assert_allclose(found.free_range_m, [2.0, 5.0, 0.0, 0.0])


def test_points_free_the_water_before_the_nearest_of_a_bearing():
    config = SonarConfig(neighbor_distance_m=0.0, beamwidth_rad=0.1)
    found = detections_from_points(0, [[5.0, 0.25], [9.0, 0.45], [3.0, -3.0]], config)
    order = np.argsort(found.bearing_rad)
    np.testing.assert_allclose(
        found.free_range_m[order], [math.hypot(3, 3), math.hypot(5, 0.25)], rtol=1e-12
    )


def test_a_ping_without_echoes_is_an_answer():
    found = detections_from_points(0, np.empty((0, 2)))
    assert found.points.shape == (0, 2)
    assert len(detect(image(np.zeros((50, 8), np.uint8))).points) == 0


@pytest.mark.parametrize(
    ("call", "what"),
    [
        (
            lambda: detect(SonarImage(0, np.zeros((2, 1)), np.array([2.0, 1.0]), np.zeros(1))),
            "rise",
        ),
        (
            lambda: detect(SonarImage(0, np.zeros((1, 1)), np.ones(1), np.array([np.nan]))),
            "bearing",
        ),
        (lambda: detect(image(np.full((50, 2), np.nan, np.float32))), "finite"),
        (lambda: detect(image(np.zeros((50, 2), np.complex64))), "complex64"),
        (lambda: SonarImage(0, np.zeros((2, 3)), np.ones(2), np.zeros(2)), r"\(2, 2\)"),
        (lambda: detections_from_points(0, [[1.0, np.inf]]), "finite"),
        (lambda: detections_from_points(0, [1.0, 2.0]), "shape"),
        (lambda: detections_from_scan(0, [0.0], [1.0, 2.0], 5.0), "shape"),
        (lambda: detections_from_scan(0, [0.0], [1.0], -5.0), "range_max_m"),
        (lambda: detections_from_scan(0, [np.nan], [1.0], 5.0), "angles"),
    ],
)
def test_malformed_input_is_named(call, what):
    with pytest.raises(InvalidInputError, match=what):
        call()


def test_contradicting_gates_are_refused():
    with pytest.raises(ConfigError, match="max_range_m"):
        SonarConfig(min_range_m=5.0, max_range_m=4.0)


def test_points_all_round_are_as_far_from_one_another_as_the_beams_of_a_turn():
    bearing = np.arange(120) * 2 * math.pi / 120
    ring = 10.0 * np.column_stack([np.cos(bearing), np.sin(bearing)])
    turn = detections_from_points(0, ring)
    assert turn.beamwidth_rad == pytest.approx(2 * math.pi / 120)
    # At 10 m they lie 0.52 m apart: further than neighbours of a fan may.
    assert len(turn.points) == 120
    fan = detections_from_points(0, ring[np.abs(np.sin(0.5 * bearing)) < 0.5])
    assert fan.beamwidth_rad == 0.02


@pytest.mark.parametrize("dead", [slice(0, 32), slice(40, 48), slice(63, 64)])
def test_nothing_is_known_of_the_water_before_dead_receivers(rng, dead):
    intensity = noisy(rng)
    intensity[:, dead] = 7
    expected = np.zeros(64, np.bool_)
    expected[dead] = True
    np.testing.assert_array_equal(silent_beams(intensity), expected)
    found = detect(image(intensity))
    assert (found.free_range_m[expected] == 0.0).all()
    assert (found.free_range_m[~expected] > 5.0).all()


def test_beams_without_an_echo_above_a_drivers_threshold_are_not_dead(rng):
    intensity = noisy(rng)
    assert not silent_beams(intensity).any()
    assert not silent_beams(np.zeros_like(intensity)).any()
    intensity[intensity < 16] = 0  # sparse specks are left
    intensity[:, 50:] = 0
    assert not silent_beams(intensity).any()


@pytest.mark.parametrize("least", [60, 200])
def test_what_a_drivers_threshold_left_are_echoes(rng, least):
    intensity = noisy(rng)
    cut = np.where(intensity >= least, intensity, 0).astype(np.uint8)
    binary = np.where(intensity >= least, 255, 0).astype(np.uint8)
    expected = detect(image(intensity))
    for pixels in (cut, binary):
        found = detect(image(pixels))
        np.testing.assert_allclose(found.points, expected.points, atol=0.05)


def test_few_counts_above_nothing_are_no_echoes(rng):
    counts = rng.poisson(0.01, (200, 64)).astype(np.uint8)  # of a gain that is too low
    counts[100, 30] = 60
    assert len(detect(image(counts)).points) == 0
