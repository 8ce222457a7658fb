"""Drivers that stopped and repeat what they said last, under new stamps."""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np

from uw_dslam_ros2.core.findings import Finding
from uw_dslam_ros2.io.readings import Event, ImageEvent, VelocityEvent

__all__ = ["FrozenSensors"]

_MANY_PIXELS = 1000
_FEW_IMAGES = 5
"""A driver may repeat an image now and then, when it missed one."""
_FEW_VELOCITIES = 4
"""Drivers repeat a velocity until there is another."""
_LONG_NS = 4_000_000_000


class FrozenSensors:
    """Watches one vehicle's readings, in the order of recording.

    Noise makes every image and every velocity of a DVL another. Other velocities may be commands,
    which do repeat; zeros mean that there is no bottom lock, or that the vehicle stands.
    """

    def __init__(self) -> None:
        self._checksum: int | None = None
        self._num_images = 0
        self._velocity: tuple[float, ...] = ()
        self._num_alike = 0
        self._since_ns = 0
        self._longest_ns = 0

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
        says_nothing = pixels.size < _MANY_PIXELS or pixels.min() == pixels.max()
        self._checksum = None if says_nothing else zlib.crc32(np.ascontiguousarray(pixels))
        is_frozen = self._checksum is not None and self._checksum == before
        self._num_images += is_frozen
        return is_frozen

    def _is_velocity_frozen(self, event: VelocityEvent) -> bool:
        velocity = tuple(event.velocity_m_s[:2].tolist())
        if velocity != self._velocity or not any(velocity):
            self._velocity, self._num_alike, self._since_ns = velocity, 0, event.stamp_ns
            return False
        self._num_alike += 1
        self._longest_ns = max(self._longest_ns, event.stamp_ns - self._since_ns)
        return self._num_alike >= _FEW_VELOCITIES

    def findings(self) -> list[Finding]:
        """What to tell of it."""
        found = []
        if self._num_images >= _FEW_IMAGES:
            found.append(
                Finding(
                    "sonar_frozen",
                    "sonar",
                    "many of its images are the one before once more, to the last pixel, under a "
                    "new stamp: its driver had stopped; they are left out",
                )
            )
        if self._longest_ns >= _LONG_NS:
            found.append(
                Finding(
                    "dvl_frozen",
                    "velocity",
                    f"its velocity stays the same to the last digit for up to "
                    f"{self._longest_ns * 1e-9:.0f} s: its driver had stopped; what it repeats is "
                    "left out",
                )
            )
        return found
