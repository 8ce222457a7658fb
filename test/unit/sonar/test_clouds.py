"""Clouds of points: what kind of sonar they are of is told by where they lie, and when."""

import math

import numpy as np
import pytest

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.sonar import Clouds, detections_from_points

S = 1_000_000_000


def ring(first_rad=0.0, last_rad=2.0 * math.pi, step_rad=0.0314):
    bearing = np.arange(first_rad, last_rad, step_rad)
    return 10.0 * np.column_stack([np.cos(bearing), np.sin(bearing)])


def taken(clouds, stamps_s, points):
    return [clouds.add(int(t * S), points, t) for t in stamps_s]


def test_points_all_round_are_a_turn_at_once():
    clouds = Clouds()
    assert taken(clouds, [0], ring()) == [[0]]
    assert clouds.turn_spacing_rad == pytest.approx(0.0314, abs=1e-3)


@pytest.mark.parametrize("points", [ring(0.0, 1.0), ring()[:3], np.empty((0, 2))])
def test_clouds_that_come_quickly_are_of_a_fan(points):
    clouds = Clouds()
    assert taken(clouds, [0.0, 0.1, 0.2], points) == [[], [0.0, 0.1], [0.2]]
    assert clouds.turn_spacing_rad == 0.0


@pytest.mark.parametrize("period_s", [4.5, 14, 35])
def test_few_echoes_from_everywhere_are_of_turns(period_s):
    clouds = Clouds()
    sides = [ring(0.0, 0.5), ring(1.5, 2.0), ring(3.5, 3.6)]
    given = [clouds.add(int(i * period_s * S), side, i) for i, side in enumerate(sides)]
    assert given == [[], [], [0, 1, 2]]
    assert clouds.turn_spacing_rad > 0.0


@pytest.mark.parametrize("period_s", [4.5, 10, 30])
@pytest.mark.parametrize("aperture_rad", [0.5, math.radians(130.0)])
@pytest.mark.parametrize("ahead_rad", [0.0, math.pi, -1.2])
def test_clouds_that_never_leave_an_aperture_are_of_a_slow_fan(period_s, aperture_rad, ahead_rad):
    """Whichever way it looks, whatever part of it hears something."""
    rng, clouds = np.random.default_rng(0), Clouds()
    given = []
    for i in range(40):
        bearing = ahead_rad + rng.uniform(-0.5, 0.5, rng.integers(0, 60)) * aperture_rad
        points = 10.0 * np.column_stack([np.cos(bearing), np.sin(bearing)])
        given += clouds.add(int(i * period_s * S), points, i)
    assert given == list(range(40))
    assert clouds.turn_spacing_rad == 0.0


def test_what_was_taken_for_a_slow_fan_is_a_turn_once_it_hears_elsewhere():
    clouds = Clouds()
    taken(clouds, np.arange(0, 112, 14), ring(0.0, 1.0))
    assert clouds.turn_spacing_rad == 0.0
    assert clouds.add(126 * S, ring(3.0, 3.5), "behind") == ["behind"]
    assert clouds.turn_spacing_rad > 0.0


def test_what_waits_comes_with_the_first_turn_that_shows_itself():
    clouds = Clouds()
    assert clouds.add(0, ring(0.0, 1.0), "sparse") == []
    assert clouds.add(14 * S, ring(), "full") == ["sparse", "full"]
    assert clouds.take() == []


def test_what_still_waits_at_the_end_can_be_taken():
    clouds = Clouds()
    clouds.add(0, ring(0.0, 1.0), "lone")
    assert clouds.take() == ["lone"]


def test_bad_points_do_not_wait():
    clouds = Clouds()
    with pytest.raises(InvalidInputError, match="finite"):
        clouds.add(0, [[np.nan, 0.0]], "bad")
    assert clouds.take() == []


def test_few_points_of_a_turn_are_all_kept_and_say_nothing_of_other_beams():
    points = [[5.0, 0.25], [9.0, 1.45], [3.0, -3.0]]
    fan, turn = (
        detections_from_points(0, points),
        detections_from_points(0, points, turn_spacing_rad=0.03),
    )
    assert len(fan.points) == 0
    assert len(turn.points) == 3
    assert turn.is_turn
    assert not fan.is_turn
    seen = turn.free_range_m > 0.0
    assert sorted(turn.free_range_m[seen]) == pytest.approx(
        sorted(np.hypot(*np.transpose(points)))
    )
    for x, y in points:
        beam = np.argmin(np.abs(turn.bearing_rad - math.atan2(y, x)))
        assert turn.free_range_m[beam] == pytest.approx(math.hypot(x, y))


def test_a_point_straight_behind_has_a_beam_of_its_own():
    """Its bearing, half a turn, may be a whole number of beams."""
    turn = detections_from_points(0, [[-5.0, 0.0]], turn_spacing_rad=math.pi / 128)
    assert len(turn.points) == 1
    assert turn.free_range_m.max() == pytest.approx(5.0)
