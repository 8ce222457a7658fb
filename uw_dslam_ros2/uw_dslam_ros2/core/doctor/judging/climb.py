"""A DVL by which the vehicle moves up and down more than ahead: its frame is not what it says."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from uw_dslam_ros2.core.doctor.examination import Examination

__all__ = ["Climb"]

_MIN_VELOCITIES = 20
_MOVES_M_S = 0.1


class Climb:
    """Adds up how fast a vehicle moves, in the axes that the DVL's mounting gives it."""

    def __init__(self) -> None:
        self._num = 0
        self._level_m_s = self._upward_m_s = 0.0
        self._frame_id = ""

    def add(self, frame_id: str, velocity_m_s: ArrayLike) -> None:
        """Take a velocity (3,) in base_link's axes, of an instrument in this frame."""
        x, y, z = np.asarray(velocity_m_s, dtype=np.float64).tolist()
        if x * x + y * y + z * z > _MOVES_M_S**2:
            self._num += 1
            self._level_m_s += float(np.hypot(x, y))
            self._upward_m_s += abs(z)
            self._frame_id = frame_id

    def tell(self, result: Examination) -> None:
        """Say so, where that is so."""
        if self._num < _MIN_VELOCITIES or self._upward_m_s < self._level_m_s:
            return
        result.tell(
            "dvl_vertical",
            "velocity",
            f"in its frame {self._frame_id!r}, as transforms mount it, the vehicle moves up and "
            "down more than ahead: the frame is another instrument's, or tf turns it wrongly",
        )
        result.put_first()
