import numpy as np
import pytest

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.sim.waters.places import PLACES, make_place


@pytest.mark.parametrize("place", PLACES)
def test_a_seed_gives_one_place_and_another_seed_another(place):
    first, again, other = make_place(place, 3), make_place(place, 3), make_place(place, 4)
    np.testing.assert_array_equal(first.segments, again.segments)
    assert first.segments.shape != other.segments.shape or not np.allclose(
        first.segments, other.segments
    )


@pytest.mark.parametrize("seed", range(5))
def test_a_harbour_has_what_it_should(seed):
    names = {s.name for s in make_place("harbour", seed).surfaces}
    assert {"concrete", "steel", "rock", "rubble"} <= names


@pytest.mark.parametrize("seed", range(5))
def test_a_harbour_is_closed_but_for_its_mouth(seed):
    world = make_place("harbour", seed)
    angles = np.linspace(-np.pi, np.pi, 2000, endpoint=False)
    is_open = np.isinf(world.cast(world.water_point, angles, 1000.0).range_m)
    # Seen from the middle, only the mouth, to the north, lets a ray out.
    assert 0 < is_open.sum() < 400
    assert (np.sin(angles[is_open]) > 0.0).all()


def test_a_place_grows_with_the_vehicles_or_is_as_wide_as_told():
    widths = [make_place("harbour", 0, n).bounds[2] for n in (1, 2, 3, 6)]
    assert (np.diff(widths) > 20.0).all()
    assert make_place("harbour", 0, 6, 60.0).bounds[2] < 70.0


def test_unknown_place():
    with pytest.raises(InvalidInputError, match="place is 'ocean', expected one of harbour, lake"):
        make_place("ocean", 0)
