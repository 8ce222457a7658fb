import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.link.coding.cell_coder import (
    decode_cells,
    decode_walls,
    encode_cells,
    encode_walls,
    near_walls,
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
def test_cells_come_back(both):
    cells, coarse = both
    np.testing.assert_array_equal(decode_cells(encode_cells(cells, coarse), coarse), cells)


@given(CELLS)
def test_walls_come_back(both):
    walls, coarse = (both[0] == 2) & near_walls(both[1]), both[1]
    np.testing.assert_array_equal(decode_walls(encode_walls(walls, coarse), coarse), walls)


@pytest.mark.parametrize("value", [0, 1, 2])
def test_sameness_costs_nothing(value):
    cells = np.full((300, 300), value, np.int8)
    data = encode_cells(cells, np.zeros_like(cells))
    assert len(data) < 100
    np.testing.assert_array_equal(decode_cells(data, np.zeros_like(cells)), cells)


def test_a_room_is_small():
    cells = room()
    data = encode_cells(cells, np.zeros_like(cells))
    assert len(data) < 0.25 * len(zlib.compress(cells.tobytes(), 9))


def test_what_the_receiver_has_is_not_sent_again():
    cells = room()
    assert len(encode_cells(cells, cells)) < 0.5 * len(encode_cells(cells, np.zeros_like(cells)))


@given(st.binary(max_size=64))
def test_any_bytes_decode_to_cells(data):
    cells = decode_cells(data, np.zeros((9, 7), np.int8))
    assert set(np.unique(cells)) <= {0, 1, 2}


def test_the_answer_does_not_change_with_the_version_of_anything():
    """What is on the wire is a format: these bytes are what the codec's version means."""
    cells = room()[15:60, 10:50]
    data = encode_cells(cells, np.zeros_like(cells))
    assert data.hex() == "da2638cdcb2432a65717363666179785"


def test_no_table_hangs_on_the_last_digit_of_a_logarithm():
    probability = (np.arange(4096) + 0.5) / 4096.0
    values = 256.0 * np.log(probability / (1.0 - probability))
    assert np.abs(values - np.floor(values) - 0.5).min() > 1e-6
    values = 65536.0 / (1.0 + np.exp(-np.arange(-3071, 3072) / 256.0))
    assert np.abs(values - np.floor(values) - 0.5).min() > 1e-6


def test_sides_must_agree():
    with pytest.raises(InvalidInputError, match=r"\(2, 3\).*\(3, 2\)"):
        encode_cells(np.zeros((2, 3), np.int8), np.zeros((3, 2), np.int8))
