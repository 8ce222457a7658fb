"""Readings examined while they come: a few minutes of them at a time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.doctor import Examination, SampleCollector, examine
from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.sonar import SonarConfig
from uw_dslam_ros2.io.feeding import feed
from uw_dslam_ros2.io.readings import (
    ImageEvent,
    ImuEvent,
    PointsEvent,
    Reading,
    ScanEvent,
    VelocityEvent,
)

__all__ = ["ReadingWatch"]

_EXAMINED_PINGS = (ImageEvent, ScanEvent, PointsEvent)
_EXAMINED = (ImuEvent, VelocityEvent, *_EXAMINED_PINGS)
_SECOND_NS = 1_000_000_000
_WINDOW_NS = 150 * _SECOND_NS
_PING_STEP_NS = _SECOND_NS
_JUMP_NS = 2 * _SECOND_NS
_MAX_READINGS = 200_000
"""In a window: that of an IMU at 1 kHz, with room for others."""


class ReadingWatch:
    """Keeps the navigation and a ping a second, and has them examined when a window is full.

    Single beams of a sonar that turns are not kept: a window holds too few turns to judge by.
    """

    def __init__(self, sonar: SonarConfig, vehicle_id: str) -> None:
        self._sonar = sonar
        self._vehicle_id = vehicle_id
        self._clear()

    def _clear(self) -> None:
        self._collector = SampleCollector(self._sonar)
        self._first_ns: int | None = None
        self._newest_ns = 0
        self._next_ping_ns = 0
        self._num_readings = 0

    def take(
        self, reading: Reading, T_base_sensor: NDArray[np.float64]
    ) -> Callable[[], Examination] | None:
        """Keep a reading, in the order of stamps, and the ``T_base_sensor`` (4, 4) it has.

        Returns what examines the window that it completes; that takes about a second, and may be
        called in another thread.
        """
        if not isinstance(reading, _EXAMINED):
            return None
        stamp_ns = reading.stamp_ns
        examined = None
        is_other_clock = abs(stamp_ns - self._newest_ns) > _WINDOW_NS or (
            stamp_ns < self._newest_ns - _JUMP_NS
        )
        if self._first_ns is not None and is_other_clock:
            self._clear()
        if self._first_ns is None:
            self._first_ns = stamp_ns
        is_full = self._num_readings >= _MAX_READINGS
        if is_full or stamp_ns - self._first_ns >= _WINDOW_NS:
            examined = self._examination()
            self._clear()
            self._first_ns = stamp_ns
        self._newest_ns = max(self._newest_ns, stamp_ns)
        self._keep(reading, T_base_sensor)
        return examined

    def _keep(self, reading: Reading, T_base_sensor: NDArray[np.float64]) -> None:
        if isinstance(reading, _EXAMINED_PINGS):
            if reading.stamp_ns < self._next_ping_ns:
                return
            self._next_ping_ns = reading.stamp_ns + _PING_STEP_NS
        self._num_readings += 1
        try:
            feed(self._collector, reading, T_base_sensor)  # type: ignore[arg-type]  # has a mapper's inputs
        except InvalidInputError:
            return  # mapping says what is wrong with it

    def _examination(self) -> Callable[[], Examination]:
        collector, vehicle_id = self._collector, self._vehicle_id
        return lambda: examine(collector.navigation(), collector.pings(), vehicle_id)
