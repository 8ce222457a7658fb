"""Numbers to bytes and back: what layers, packets and statuses are made of.

Every number that is decoded is a whole number times a constant, so that it is the same everywhere.
"""

from __future__ import annotations

import hashlib
import math

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["ByteReader", "ByteWriter", "digest_of"]

FloatArray = NDArray[np.float64]

_TURN = 1 << 16
_POSITION_M = 0.01
_MAX_VARINT_BYTES = 9
# An eighth of an octave apart, from 10 micrometres to 40 km; as literals, not from a library.
_SIGMA_STEPS = (
    1.0, 1.0905077326652577, 1.189207115002721, 1.2968395546510096,
    1.4142135623730951, 1.5422108254079407, 1.681792830507429, 1.8340080864093424,
)  # fmt: skip
_SIGMA_UNIT = 1e-5
_SIGMAS = np.array(
    [0.0] + [_SIGMA_UNIT * math.ldexp(_SIGMA_STEPS[k % 8], k // 8) for k in range(255)]
)
_CORRELATION_STEPS = 128


def digest_of(content: bytes, key: bytes, size: int = 4) -> bytes:
    """Checksum; with a key that only the fleet knows, others cannot make it."""
    return hashlib.blake2b(content, digest_size=size, key=key).digest()


class ByteWriter:
    """Appends numbers to bytes."""

    def __init__(self) -> None:
        self._data = bytearray()

    def __bytes__(self) -> bytes:
        return bytes(self._data)

    def raw(self, data: bytes) -> None:
        """Bytes as they are."""
        self._data += data

    def fixed(self, value: int, num_bytes: int) -> None:
        """A number >= 0, the most significant byte first."""
        self._data += value.to_bytes(num_bytes, "big")

    def varint(self, value: int) -> None:
        """A number >= 0 in as many bytes as it needs, seven bits each."""
        while value >= 0x80:
            self._data.append(value & 0x7F | 0x80)
            value >>= 7
        self._data.append(value)

    def signed(self, value: int) -> None:
        """A number of either sign, short where it is near zero."""
        self.varint(2 * value if value >= 0 else -2 * value - 1)

    def pose(self, T: SE2) -> None:
        """To a centimetre and a ten-thousandth of a radian."""
        self.signed(round(T.x / _POSITION_M))
        self.signed(round(T.y / _POSITION_M))
        self.fixed(round(T.yaw / (2.0 * math.pi) * _TURN) % _TURN, 2)

    def covariance(self, covariance: FloatArray) -> None:
        """Three deviations, rounded up to an eighth of an octave, and three correlations.

        The last one is partial, so that any three bytes make a covariance.
        """
        sigma = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
        for value in sigma:
            self.fixed(min(int(np.searchsorted(_SIGMAS, value * (1.0 - 1e-9))), 255), 1)
        scale = np.where(sigma > 0.0, sigma, 1.0)
        r = np.clip(np.asarray(covariance) / np.outer(scale, scale), -1.0, 1.0)
        a, b = (_rounded_correlation(value) for value in (r[0, 1], r[0, 2]))
        rest = math.sqrt((1.0 - _correlation(a) ** 2) * (1.0 - _correlation(b) ** 2))
        c = _rounded_correlation((r[1, 2] - _correlation(a) * _correlation(b)) / rest)
        for code in (a, b, c):
            self.fixed(code + _CORRELATION_STEPS, 1)


class ByteReader:
    """Takes numbers from bytes; raises `InvalidInputError` where they end too early."""

    def __init__(self, data: bytes) -> None:
        self._data, self._place = data, 0

    @property
    def rest(self) -> bytes:
        """All that was not read yet."""
        return self._data[self._place :]

    def raw(self, num_bytes: int) -> bytes:
        """So many bytes as they are."""
        end = self._place + num_bytes
        if end > len(self._data):
            raise InvalidInputError(
                f"the data end after {len(self._data)} bytes, expected at least {end}"
            )
        found = self._data[self._place : end]
        self._place = end
        return found

    def fixed(self, num_bytes: int) -> int:
        """As `ByteWriter.fixed`."""
        return int.from_bytes(self.raw(num_bytes), "big")

    def varint(self) -> int:
        """As `ByteWriter.varint`."""
        value = 0
        for index in range(_MAX_VARINT_BYTES):
            byte = self.fixed(1)
            value |= (byte & 0x7F) << (7 * index)
            if byte < 0x80:
                return value
        raise InvalidInputError(f"a number has more than {_MAX_VARINT_BYTES} bytes")

    def bounded(self, name: str, low: int, high: int) -> int:
        """A `varint` that must lie in a range."""
        value = self.varint()
        if not low <= value <= high:
            raise InvalidInputError(f"{name} is {value}, expected {low} to {high}")
        return value

    def signed(self) -> int:
        """As `ByteWriter.signed`."""
        value = self.varint()
        return value // 2 if value % 2 == 0 else -(value + 1) // 2

    def pose(self) -> SE2:
        """As `ByteWriter.pose`."""
        x, y = self.signed() * _POSITION_M, self.signed() * _POSITION_M
        return SE2(x, y, self.fixed(2) / _TURN * (2.0 * math.pi))

    def covariance(self) -> FloatArray:
        """As `ByteWriter.covariance`; symmetric, no eigenvalue below zero."""
        sigma = np.array([_SIGMAS[self.fixed(1)] for _ in range(3)])
        a, b, c = (_correlation(self.fixed(1) - _CORRELATION_STEPS) for _ in range(3))
        last = c * math.sqrt((1.0 - a * a) * (1.0 - b * b)) + a * b
        r = np.array([[1.0, a, b], [a, 1.0, last], [b, last, 1.0]])
        return r * np.outer(sigma, sigma)


def _rounded_correlation(value: float) -> int:
    limit = _CORRELATION_STEPS - 1
    return max(-limit, min(limit, round(value * _CORRELATION_STEPS)))


def _correlation(code: int) -> float:
    limit = _CORRELATION_STEPS - 1
    return max(-limit, min(limit, code)) / _CORRELATION_STEPS
