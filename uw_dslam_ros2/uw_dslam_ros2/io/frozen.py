"""Readings that say nothing: of drivers that stopped and repeat themselves, and white images."""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.findings import Finding
from uw_dslam_ros2.io.readings import Event, ImageEvent, VelocityEvent

__all__ = ["FrozenSensors"]

_MANY_PIXELS = 1000
_FEW_VELOCITIES = 4
"""Drivers repeat a velocity until there is another."""
_WHITE, _SOME, _FEW = 0.5, 20, 0.05
"""Share of an image's pixels; images, and their share, that are worth telling."""
_LONG_NS = 4_000_000_000
"""Relays and viewers repeat what they have at a rate of their own; what is longer is missing."""


class FrozenSensors:
    """Watches one vehicle's readings, in the order of recording.

    Noise makes every image and every velocity of a DVL another. Other velocities may be commands,
    which do repeat; zeros mean that there is no bottom lock, or that the vehicle stands.
    """

    def __init__(self) -> None:
        self._num_images = 0
        self._num_even: Counter[float] = Counter()
        self._top = 0.0
        self._checksum: int | None = None
        self._image_since_ns = self._longest_image_ns = 0
        self._velocity: tuple[float, ...] = ()
        self._num_alike = 0
        self._velocity_since_ns = self._longest_velocity_ns = 0

    def is_frozen(self, found: Sequence[Event]) -> bool:
        """Whether what a message says is only what the one before said."""
        if len(found) != 1:
            return False
        match found[0]:
            case ImageEvent() as event:
                return self._is_image_frozen(event)
            case VelocityEvent(is_z_down=True) as event:
                return self._is_velocity_frozen(event)
        return False

    def _is_image_frozen(self, event: ImageEvent) -> bool:
        pixels, before = event.image.intensity, self._checksum
        says_nothing = pixels.size < _MANY_PIXELS or self._is_even(pixels)
        self._checksum = None if says_nothing else zlib.crc32(np.ascontiguousarray(pixels))
        if self._checksum is None or self._checksum != before:
            self._image_since_ns = event.stamp_ns
            return False
        alike_ns = event.stamp_ns - self._image_since_ns
        self._longest_image_ns = max(self._longest_image_ns, alike_ns)
        return True

    def _is_even(self, pixels: NDArray[np.generic]) -> bool:
        """Whether most of an image is one value, its largest: black, or white."""
        top = float(pixels.max())
        is_even = bool(np.mean(pixels == top) > _WHITE)
        self._num_images += 1
        self._num_even[top] += is_even
        self._top = max(self._top, top)
        return is_even

    def _is_velocity_frozen(self, event: VelocityEvent) -> bool:
        velocity = tuple(event.velocity_m_s[:2].tolist())
        if velocity != self._velocity or not any(velocity):
            self._velocity, self._num_alike = velocity, 0
            self._velocity_since_ns = event.stamp_ns
            return False
        self._num_alike += 1
        alike_ns = event.stamp_ns - self._velocity_since_ns
        self._longest_velocity_ns = max(self._longest_velocity_ns, alike_ns)
        return self._num_alike >= _FEW_VELOCITIES

    def findings(self) -> list[Finding]:
        """What to tell of it."""
        found = []
        if self._longest_image_ns >= _LONG_NS:
            found.append(
                _stopped("sonar_frozen", "sonar", "image", "pixel", self._longest_image_ns)
            )
        if self._longest_velocity_ns >= _LONG_NS:
            found.append(
                _stopped("dvl_frozen", "velocity", "velocity", "digit", self._longest_velocity_ns)
            )
        num_white = self._num_even[self._top] if self._top > 0.0 else 0
        if num_white >= max(_SOME, _FEW * self._num_images):
            found.append(
                Finding(
                    "sonar_saturated",
                    "sonar",
                    f"{num_white} of {self._num_images} images are white, more than half of "
                    "their pixels at the largest value: the gain is too high, and nothing is seen "
                    "in them",
                )
            )
        return found


def _stopped(kind: str, role: str, what: str, last: str, longest_ns: int) -> Finding:
    return Finding(
        kind,
        role,
        f"its {what} stays the same to the last {last}, under new stamps, for up to "
        f"{longest_ns * 1e-9:.0f} s: its driver had stopped; what it repeats is left out",
    )
