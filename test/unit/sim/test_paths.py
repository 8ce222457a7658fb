import itertools

import numpy as np
import pytest

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.sim.vehicles.paths import SurveyArea, plan_survey, split_areas
from uw_dslam_ros2.sim.waters.places import make_place


@pytest.mark.parametrize("place", ["harbour", "lake"])
@pytest.mark.parametrize("seed", range(3))
def test_routes_are_clear_smooth_and_long_enough(place, seed):
    world = make_place(place, seed, 2)
    area = split_areas(world, 2, 0.3)[seed % 2]
    route = plan_survey(world, area, 150.0, 4.0, np.random.default_rng(seed))
    steps = np.diff(route, axis=0)
    lengths = np.hypot(*steps.T)
    # Rounding the corners takes a part of the way that was asked for.
    assert lengths.sum() > 110.0
    assert lengths.max() < 0.3
    fan = np.linspace(-np.pi, np.pi, 72)
    nearest = [world.cast(p, fan, 50.0).range_m.min() for p in route[::8]]
    assert min(nearest) > 2.0
    # It turns back here and there, but hardly ever: elsewhere neighbouring steps agree.
    course = np.arctan2(steps[:, 1], steps[:, 0])
    turns = np.abs((np.diff(course) + np.pi) % (2.0 * np.pi) - np.pi)
    assert np.quantile(turns, 0.95) < 0.25


def test_areas_share_what_they_should():
    world = make_place("harbour", 0, 3)
    areas = split_areas(world, 3, 0.4)
    assert areas[0].x_min == pytest.approx(world.bounds[0])
    assert areas[-1].x_max == pytest.approx(world.bounds[2])
    for a, b in itertools.pairwise(areas):
        assert (a.x_max - b.x_min) / (a.x_max - a.x_min) == pytest.approx(0.4)


def test_an_area_without_water_is_named():
    world = make_place("harbour", 0, 1)
    with pytest.raises(InvalidInputError, match=r"has no water with 4\.0 m of clearance"):
        plan_survey(
            world, SurveyArea(-900.0, 0.0, -890.0, 9.0), 50.0, 4.0, np.random.default_rng(0)
        )
