"""Fragments of which any `k` are enough: a Cauchy Reed-Solomon code over bytes.

The first `k` are the data themselves; the others are sums of them, so that one and the same repair
helps receivers that have lost different ones.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError

__all__ = ["MAX_INDEX", "MAX_NEEDED", "fragment", "restore"]

MAX_NEEDED = 63
MAX_INDEX = 127
_POLYNOMIAL = 0x11D

ByteArray = NDArray[np.uint8]


@functools.cache
def _products() -> tuple[ByteArray, ByteArray]:
    """Products of all pairs of elements of GF(256), and the inverse of each (of 0: 0)."""
    power, log = np.zeros(510, np.int64), np.zeros(256, np.int64)
    value = 1
    for exponent in range(255):
        power[exponent] = power[exponent + 255] = value
        log[value] = exponent
        value = value << 1 ^ (_POLYNOMIAL if value & 0x80 else 0)
    table = power[log[:, None] + log[None, :]].astype(np.uint8)
    table[0] = table[:, 0] = 0
    inverse = power[255 - log].astype(np.uint8)
    inverse[0] = 0
    return table, inverse


def _row(index: int, num_needed: int) -> ByteArray:
    """How a fragment is summed from the data's parts."""
    if index < num_needed:
        unit: ByteArray = np.zeros(num_needed, np.uint8)
        unit[index] = 1
        return unit
    _, inverse = _products()
    return inverse[index ^ np.arange(num_needed)]


def fragment(data: bytes, num_needed: int, index: int) -> bytes:
    """One fragment of data whose length is a multiple of `num_needed`."""
    if not (1 <= num_needed <= MAX_NEEDED and 0 <= index <= MAX_INDEX) or len(data) % num_needed:
        raise InvalidInputError(
            f"fragment {index} of {len(data)} bytes in {num_needed} parts, expected up to "
            f"{MAX_NEEDED} equal parts and an index up to {MAX_INDEX}"
        )
    parts = np.frombuffer(data, np.uint8).reshape(num_needed, -1)
    table, _ = _products()
    summed: ByteArray = np.bitwise_xor.reduce(
        table[_row(index, num_needed)[:, None], parts], axis=0
    )
    return summed.tobytes()


def restore(fragments: Mapping[int, bytes], num_needed: int) -> bytes:
    """The data, from `num_needed` fragments of one length by their index."""
    chosen = sorted(fragments)[:num_needed]
    if len(chosen) < num_needed or len({len(fragments[i]) for i in chosen}) != 1:
        raise InvalidInputError(f"{len(fragments)} fragments, expected {num_needed} of one length")
    table, inverse = _products()
    left = np.array([_row(index, num_needed) for index in chosen])
    right = np.array([np.frombuffer(fragments[index], np.uint8) for index in chosen])
    for column in range(num_needed):
        pivot = column + int(np.argmax(left[column:, column] != 0))
        left[[column, pivot]], right[[column, pivot]] = (
            left[[pivot, column]],
            right[[pivot, column]],
        )
        scale = inverse[left[column, column]]
        left[column], right[column] = table[scale, left[column]], table[scale, right[column]]
        factors = left[:, column].copy()
        factors[column] = 0
        left ^= table[factors[:, None], left[column]]
        right ^= table[factors[:, None], right[column]]
    return right.tobytes()
