import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.link.coding.cell_coder import (
    decode_marks,
    encode_marks,
    near_cells,
)

CELLS = array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=24).flatmap(
    lambda shape: st.tuples(
        arrays(np.int8, shape, elements=st.integers(0, 2)),
        arrays(np.int8, shape, elements=st.integers(0, 2)),
    )
)


def room(size=120):
    """Free water in walls, a slanting one among them; unknown outside."""
    rows, cols = np.mgrid[:size, :size]
    cells = np.zeros((size, size), np.int8)
    cells[20:100, 15:110] = 1
    cells[20, 15:110] = cells[99, 15:110] = cells[20:100, 15] = 2
    cells[(np.abs(rows - 0.4 * cols - 20) < 1) & (cells == 1)] = 2
    return cells


@given(CELLS)
def test_marks_come_back(both):
    marks, known = both[0] == 2, both[1]
    np.testing.assert_array_equal(decode_marks(encode_marks(marks, known), known), marks)


@given(CELLS)
def test_marks_come_back_where_they_may_be(both):
    is_open, known = near_cells(both[1] == 2), both[1]
    marks = (both[0] == 2) & is_open
    data = encode_marks(marks, known, is_open)
    np.testing.assert_array_equal(decode_marks(data, known, is_open), marks)


@pytest.mark.parametrize("value", [False, True])
def test_sameness_costs_nothing(value):
    marks, unknown = np.full((300, 300), value), np.zeros((300, 300), np.int8)
    data = encode_marks(marks, unknown)
    assert len(data) < 100
    np.testing.assert_array_equal(decode_marks(data, unknown), marks)


def test_a_room_is_small():
    cells = room()
    data = encode_marks(cells == 2, np.zeros_like(cells))
    assert len(data) < 0.25 * len(zlib.compress(np.packbits(cells == 2).tobytes(), 9))


def test_what_the_receiver_has_is_not_sent_again():
    cells = room()
    told, untold = (len(encode_marks(cells == 2, known)) for known in (cells, 0 * cells))
    assert told < 0.5 * untold


@given(st.binary(max_size=64))
def test_any_bytes_decode_to_marks(data):
    marks = decode_marks(data, np.zeros((9, 7), np.int8))
    assert (marks.shape, marks.dtype) == ((9, 7), bool)


def test_the_answer_does_not_change_with_the_version_of_anything():
    """What is on the wire is a format: these bytes are what the codec's version means."""
    cells = room()[15:60, 10:50]
    data = encode_marks(cells == 2, np.minimum(cells, 1))
    assert data.hex() == "eef12a7ce3bfd3c1b454e21eb2c858a0"


def test_no_table_hangs_on_the_last_digit_of_a_logarithm():
    probability = (np.arange(4096) + 0.5) / 4096.0
    values = 256.0 * np.log(probability / (1.0 - probability))
    assert np.abs(values - np.floor(values) - 0.5).min() > 1e-6
    values = 65536.0 / (1.0 + np.exp(-np.arange(-3071, 3072) / 256.0))
    assert np.abs(values - np.floor(values) - 0.5).min() > 1e-6


def test_sides_must_agree():
    with pytest.raises(InvalidInputError, match=r"\(2, 3\).*\(3, 2\)"):
        encode_marks(np.zeros((2, 3), bool), np.zeros((3, 2), np.int8))
