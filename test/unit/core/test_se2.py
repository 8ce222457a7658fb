"""Rigid motions against homogeneous matrices."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.se2 import SE2, wrap_angle

coordinate = st.floats(-1e4, 1e4)
motion = st.builds(SE2, coordinate, coordinate, st.floats(-10.0, 10.0))


@given(motion, motion)
def test_composition_is_the_matrix_product(T_a_b, T_b_c):
    expected = T_a_b.matrix() @ T_b_c.matrix()
    np.testing.assert_allclose((T_a_b @ T_b_c).matrix(), expected, atol=1e-8)


@given(motion)
def test_inverse_is_the_matrix_inverse(T_a_b):
    np.testing.assert_allclose((T_a_b.inverse() @ T_a_b).matrix(), np.eye(3), atol=1e-8)


def test_apply_in_literal_numbers():
    T_target_source = SE2(10.0, 20.0, math.pi / 2)
    np.testing.assert_allclose(
        T_target_source.apply([[1.0, 0.0], [0.0, 2.0]]), [[10.0, 21.0], [8.0, 20.0]]
    )
    np.testing.assert_allclose(T_target_source.apply([1.0, 0.0]), [10.0, 21.0])


@given(st.floats(-1e6, 1e6))
def test_wrapped_angle_is_in_the_half_open_turn_and_the_same_direction(angle):
    wrapped = wrap_angle(angle)
    assert -math.pi <= wrapped < math.pi
    assert math.cos(wrapped - angle) == pytest.approx(1.0, abs=1e-9)


def test_wrap_angle_of_an_array_equals_the_scalars():
    angles = np.array([-math.pi, math.pi, -1e-17 - math.pi, 7.0, 0.0])
    assert wrap_angle(angles).tolist() == [wrap_angle(float(angle)) for angle in angles]


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_motion_that_is_no_number_is_refused_by_name(value):
    with pytest.raises(InvalidInputError, match=r"SE2\.y is"):
        SE2(0.0, value, 0.0)


def test_distance_wraps_the_angle():
    metres, radians = SE2(0.0, 0.0, 3.1).distance_to(SE2(3.0, 4.0, -3.1))
    assert metres == pytest.approx(5.0)
    assert radians == pytest.approx(2 * math.pi - 6.2)
