"""A map that looks like itself after a turn makes its matches ambiguous, seen or unseen."""

import math

import numpy as np
import pytest

from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.registration.grids.register import register_grids
from uw_dslam_ros2.core.registration.result import PriorWindow, Verdict
from uw_dslam_ros2.core.se2 import SE2

_ROWS, _COLS = 160, 280
_RESOLUTION_M = 0.1


def _place(rng: np.random.Generator, is_symmetric: bool) -> np.ndarray:
    """Bars at random in free space; to the right of the middle as to the left, or others."""
    halves = []
    for _ in range(2):
        half = np.zeros((_ROWS, _COLS // 2), np.int8)
        for _ in range(22):
            row, col = rng.integers(4, _ROWS - 30), rng.integers(4, _COLS // 2 - 30)
            length = int(rng.integers(8, 26))
            if rng.random() < 0.5:
                half[row : row + 2, col : col + length] = 100
            else:
                half[row : row + length, col : col + 2] = 100
        halves.append(half)
    right = np.rot90(halves[0], 2) if is_symmetric else halves[1]
    return np.hstack([halves[0], right])


def _window(place: np.ndarray, first: int, last: int) -> OccupancyMap:
    frame = SE2(first * _RESOLUTION_M, 0.0, 0.0)
    return OccupancyMap(
        GridSpec(_RESOLUTION_M, _ROWS, last - first, frame), place[:, first:last].copy()
    )


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("is_target", [False, True])
def test_a_symmetry_that_one_map_shows_is_held_against_a_match(seed, is_target):
    """Where the source would lie after the half turn, the target knows next to nothing."""
    rng = np.random.default_rng(seed)
    place = _place(rng, is_symmetric=True)
    wide, narrow = _window(place, 0, 200), _window(place, 0, 110)
    pair = (narrow, wide) if is_target else (wide, narrow)
    result = register_grids(*pair)
    assert result.verdict is Verdict.AMBIGUOUS, result.reason
    T_half_turn = SE2(_COLS * _RESOLUTION_M, _ROWS * _RESOLUTION_M, math.pi)
    poses = [result.T_target_source, *(rival.T_target_source for rival in result.rivals)]
    for T_true in (SE2(), T_half_turn):
        assert any(_is_near(pose, T_true) for pose in poses)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_prior_that_excludes_the_half_turn_settles_it(seed):
    place = _place(np.random.default_rng(seed), is_symmetric=True)
    wide, narrow = _window(place, 0, 200), _window(place, 0, 110)
    result = register_grids(narrow, wide, prior=PriorWindow(SE2(0.2, -0.1, 0.05), 3.0, 0.3))
    assert result.verdict is Verdict.ACCEPTED, result.reason
    assert _is_near(result.T_target_source, SE2())


@pytest.mark.parametrize("seed", [0, 1])
def test_the_same_windows_of_a_place_without_symmetry_are_accepted(seed):
    place = _place(np.random.default_rng(seed), is_symmetric=False)
    result = register_grids(_window(place, 0, 110), _window(place, 0, 200))
    assert result.verdict is Verdict.ACCEPTED, result.reason
    assert _is_near(result.T_target_source, SE2())


def _is_near(pose: SE2, other: SE2) -> bool:
    distance_m, angle_rad = pose.distance_to(other)
    return distance_m < 0.5 and angle_rad < 0.05
