import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.link.transport.erasure import MAX_INDEX, fragment, restore


def test_the_first_fragments_are_the_data():
    assert [fragment(b"abcdef", 3, index) for index in range(3)] == [b"ab", b"cd", b"ef"]


def test_any_fragments_are_enough():
    data = bytes(range(40))
    fragments = {index: fragment(data, 4, index) for index in range(8)}
    for chosen in itertools.combinations(fragments, 4):
        assert restore({index: fragments[index] for index in chosen}, 4) == data


@given(st.integers(1, 63), st.integers(1, 40), st.randoms(use_true_random=False))
def test_any_number_of_parts_comes_back(num_needed, size, random):
    data = bytes(random.randrange(256) for _ in range(num_needed * size))
    chosen = random.sample(range(MAX_INDEX + 1), num_needed)
    found = restore({i: fragment(data, num_needed, i) for i in chosen}, num_needed)
    assert found == data


def test_products_are_those_of_a_field(rng):
    """The sum's parts by the schoolbook: shift and add, reduced by x^8 + x^4 + x^3 + x^2 + 1."""

    def product(a, b):
        total = 0
        while b:
            total ^= a if b & 1 else 0
            a = a << 1 ^ (0x11D if a & 0x80 else 0)
            b >>= 1
        return total

    data = rng.integers(0, 256, 12).astype(np.uint8)
    for index in (3, 17, 127):
        inverse = [next(v for v in range(256) if product(v, index ^ j) == 1) for j in range(3)]
        parts = data.reshape(3, 4)
        wanted = [
            product(inverse[0], int(a)) ^ product(inverse[1], int(b)) ^ product(inverse[2], int(c))
            for a, b, c in parts.T
        ]
        assert list(fragment(data.tobytes(), 3, index)) == wanted


def test_too_few_or_uneven_fragments_are_refused():
    with pytest.raises(InvalidInputError, match="1 fragments, expected 2"):
        restore({0: b"ab"}, 2)
    with pytest.raises(InvalidInputError, match="expected 2 of one length"):
        restore({0: b"ab", 1: b"c"}, 2)
    with pytest.raises(InvalidInputError, match="5 bytes in 2 parts"):
        fragment(b"abcde", 2, 0)
