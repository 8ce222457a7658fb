"""Sonars that turn: beams to sweeps, each beam placed by its own pose."""

import math

import numpy as np
import pytest

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar import (
    BeamGatherer,
    Beams,
    SonarConfig,
    SonarImage,
    detect,
    detections_from_scan,
    place_sweep,
)

S = 1_000_000_000
STEP_NS = 70_000_000
SONAR = SE2(0.3, 0.1, 0.2)
NO_FILTER = SonarConfig(neighbor_distance_m=0.0)


def beams_of(bearing, ranges, start_ns=0, step_ns=STEP_NS):
    stamps = start_ns + np.arange(len(bearing)) * step_ns
    return Beams(stamps, np.asarray(bearing, float), np.asarray(ranges, float), 30.0)


def gathered(*messages):
    gatherer = BeamGatherer()
    for message in messages:
        gatherer.add(message, SONAR)
    return gatherer.take(None)


def single(beams):
    """The same beams, one a message."""
    for i in range(len(beams.stamp_ns)):
        one = slice(i, i + 1)
        intensity = None if beams.intensity is None else beams.intensity[:, one]
        range_m = beams.range_m[one] if intensity is None else beams.range_m
        yield Beams(beams.stamp_ns[one], beams.bearing_rad[one], range_m, 30.0, intensity)


@pytest.mark.parametrize(
    ("bearing", "expected"),
    [
        (np.arange(500) * 2 * math.pi / 200, [200, 200, 100]),
        (-np.arange(500) * 2 * math.pi / 200 + 1.0, [200, 200, 100]),
        # To and fro over a sector: the turning point belongs to the sweep that ends there.
        (np.abs(np.arange(300) % 200 - 100) * 0.03, [102, 100, 98]),
    ],
    ids=["left", "right", "sector"],
)
def test_a_sweep_is_a_turn_or_goes_one_way(bearing, expected):
    beams = beams_of(np.remainder(bearing, 2 * math.pi), np.full(len(bearing), 5.0))
    for messages in ([beams], list(single(beams))):
        assert [len(sweep.beams) for sweep in gathered(*messages)] == expected


def test_a_pause_ends_a_sweep_and_beams_sent_twice_count_once():
    first = beams_of([0.0, 0.1, 0.2], [5.0] * 3)
    later = beams_of([0.3, 0.4], [5.0] * 2, start_ns=10 * S)
    gatherer = BeamGatherer()
    for message in (first, first, later, first):
        gatherer.add(message, SONAR)
    assert gatherer.take(9 * S)[0].bearing_rad.tolist() == [0.0, 0.1, 0.2]
    assert gatherer.take(20 * S) == []
    assert [len(sweep.beams) for sweep in gatherer.take(None)] == [2]
    assert gatherer.num_late == 6


def test_every_echo_lands_where_geometry_says():
    rng = np.random.default_rng(0)
    bearing = np.arange(200) * 2 * math.pi / 200
    ranges = np.where(rng.random(200) < 0.2, np.inf, rng.uniform(2.0, 25.0, 200))
    (sweep,) = gathered(beams_of(bearing, ranges))
    # Half a metre a second, and a third of a turn meanwhile.
    poses = [SE2(0.035 * i - 3.0, 0.01 * i, 0.01 * i - 1.0) for i in range(200)]
    placed = place_sweep(sweep, poses, 7 * S, NO_FILTER)
    expected = [
        (poses[i] @ SONAR).apply([r * math.cos(b), r * math.sin(b)])
        for i, (b, r) in enumerate(zip(bearing, ranges, strict=True))
        if np.isfinite(r)
    ]
    np.testing.assert_allclose(placed.detections.points, expected, atol=1e-9)
    drawn = [p.T_reference_sonar.apply(p.detections.points) for p in placed.slices]
    np.testing.assert_allclose(np.vstack(drawn), expected, atol=1e-9)
    # A ray begins within a slice's length of where it was heard, and points where it did.
    drawn_bearing = np.concatenate(
        [p.detections.bearing_rad + p.T_reference_sonar.yaw for p in placed.slices]
    )
    own = [(pose @ SONAR).yaw + b for pose, b in zip(poses, bearing, strict=True)]
    np.testing.assert_allclose(np.exp(1j * drawn_bearing), np.exp(1j * np.array(own)), atol=1e-9)
    free_m = np.concatenate([p.detections.free_range_m for p in placed.slices])
    beside = np.minimum(np.append(ranges[1:], np.inf), np.insert(ranges[:-1], 0, np.inf))
    # Without echo, half the range is free, but not past what the beams beside it met.
    silent_m = np.minimum(beside, 15.0)
    np.testing.assert_allclose(free_m, np.where(np.isinf(ranges), silent_m, ranges))


def test_at_rest_a_turn_is_one_scan():
    bearing = np.arange(200) * 2 * math.pi / 200
    ranges = np.where(np.arange(200) % 7 == 0, np.inf, 8.0 + np.sin(3 * bearing))
    (sweep,) = gathered(*single(beams_of(bearing, ranges)))
    (part,) = place_sweep(sweep, [SE2()] * 200, 7 * S, SonarConfig()).slices
    scan = detections_from_scan(0, bearing, ranges, 30.0)
    np.testing.assert_allclose(part.detections.points, scan.points, atol=1e-12)
    has_echo = np.isfinite(ranges)
    np.testing.assert_allclose(part.detections.free_range_m[has_echo], scan.free_range_m[has_echo])
    assert (part.detections.free_range_m <= scan.free_range_m).all()
    assert part.T_reference_sonar == SONAR


def test_at_rest_a_turn_of_intensities_is_one_image():
    rng = np.random.default_rng(1)
    bearing = np.arange(100) * 2 * math.pi / 100
    range_m = (np.arange(200) + 0.5) * 0.1
    intensity = rng.rayleigh(10.0, (200, 100)).astype(np.uint8)
    intensity[120:124] = 200
    beams = Beams(np.arange(100) * STEP_NS, bearing, range_m, 20.0, intensity)
    (sweep,) = gathered(*single(beams))
    placed = place_sweep(sweep, [SE2()] * 100, 3 * S, SonarConfig())
    image = detect(SonarImage(0, intensity, range_m, bearing), NO_FILTER)
    assert len(image.points) > 90
    np.testing.assert_allclose(placed.detections.points, SONAR.apply(image.points), atol=1e-12)
    np.testing.assert_allclose(placed.detections.weight, image.weight)


def test_echoes_need_no_neighbours_which_are_far_on_a_wall_at_a_slant():
    bearing = np.arange(100) * 2 * math.pi / 100
    ranges = np.full(100, 5.0)
    ranges[50] = 20.0
    (sweep,) = gathered(beams_of(bearing, ranges))
    assert len(place_sweep(sweep, [SE2()] * 100, 0, SonarConfig()).detections.points) == 100
    (alone,) = gathered(beams_of([0.5], [20.0]))
    assert len(place_sweep(alone, [SE2()], 0, SonarConfig()).detections.points) == 1


def test_other_bins_begin_a_sweep_and_each_beam_has_its_own_mounting():
    gatherer = BeamGatherer()
    for k, num_bins in enumerate([20, 30, 30]):
        stamps, range_m = k * S + np.arange(2) * STEP_NS, np.arange(num_bins) + 0.5
        intensity = np.ones((num_bins, 2), np.uint8)
        beams = Beams(stamps, np.array([0.2, 0.3]) * k, range_m, 9.0, intensity)
        gatherer.add(beams, SE2(0.1 * k))
    sweeps = gatherer.take(None)
    assert [[beam.T_base_sonar.x for beam in sweep.beams] for sweep in sweeps] == [
        [0.0, 0.0],
        [0.1, 0.1, 0.2, 0.2],
    ]


def test_a_tilted_fan_is_shortened_to_the_plane():
    gatherer = BeamGatherer()
    gatherer.add(beams_of([0.0, math.pi / 2], [10.0, 10.0]), SE2(), np.diag([0.8, 1.0]))
    (sweep,) = gatherer.take(None)
    placed = place_sweep(sweep, [SE2()] * 2, 0, NO_FILTER)
    np.testing.assert_allclose(placed.detections.points, [[8.0, 0.0], [0.0, 10.0]], atol=1e-9)


@pytest.mark.parametrize(
    ("bearing", "range_m", "range_max_m", "intensity"),
    [
        ([0.0], [1.0], 30.0, None),
        ([0.0, math.nan], [1.0, 2.0], 30.0, None),
        ([0.0, 1.0], [1.0, 2.0, 3.0], 30.0, None),
        ([0.0, 1.0], [1.0, 2.0], 0.0, None),
        ([0.0, 1.0], [1.0, 2.0, 3.0], 30.0, np.ones((2, 2))),
    ],
)
def test_bad_beams_are_refused(bearing, range_m, range_max_m, intensity):
    with pytest.raises(InvalidInputError, match=r"bearing|range_m|intensity"):
        Beams(np.array([0, 1]), np.array(bearing), np.array(range_m), range_max_m, intensity)
