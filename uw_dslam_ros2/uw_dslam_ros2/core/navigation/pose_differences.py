"""Velocity and yaw from the poses of a vehicle's own filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.se2 import SE2

__all__ = ["PoseDifferences"]

_LEAST_S = 0.2  # over which two poses are compared: their jitter counts less
_MOST_S = 2.0  # a longer gap says little about the velocity on the way


@dataclass(slots=True)
class PoseDifferences:
    """Motion between successive poses, in whatever frame they are given.

    Only how the vehicle moved on is used: where the frame lies, and how it drifts, is no matter.
    """

    _stamp_ns: int | None = None
    _T_frame_base: SE2 = SE2()

    def add(self, stamp_ns: int, T_frame_base: SE2) -> tuple[int, NDArray[np.float64]] | None:
        """Take a pose; from time to time return a velocity (2,) [m/s] and its stamp [ns].

        The velocity is over ground along base_link's axes (forward, left), in the middle between
        two poses.
        """
        if self._stamp_ns is None or not 0.0 <= stamp_ns - self._stamp_ns <= _MOST_S * 1e9:
            self._stamp_ns, self._T_frame_base = stamp_ns, T_frame_base
            return None
        duration_s = (stamp_ns - self._stamp_ns) * 1e-9
        if duration_s < _LEAST_S:
            return None
        moved = self._T_frame_base.inverse() @ T_frame_base
        half_turned = SE2(0.0, 0.0, -0.5 * moved.yaw)
        velocity = half_turned.apply(np.array([[moved.x, moved.y]]))[0] / duration_s
        middle_ns = self._stamp_ns + (stamp_ns - self._stamp_ns) // 2
        self._stamp_ns, self._T_frame_base = stamp_ns, T_frame_base
        return middle_ns, velocity
