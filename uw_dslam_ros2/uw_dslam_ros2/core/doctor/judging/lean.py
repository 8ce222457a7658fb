"""An IMU by which the vehicle lies on its side: mounted so, or with its quaternion disordered."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.doctor.examination import Examination, words_of

__all__ = ["Lean"]

FloatArray = NDArray[np.float64]

_MIN_ORIENTATIONS = 20
_MIN_LEAN_RAD = math.radians(60.0)  # a vehicle that is at work leans less
_SLIGHT_RAD = math.radians(12.0)
_MIN_EXCESS = 0.06  # three times what a speed of sound is usually wrong by
_LEVEL_RAD = math.radians(20.0)
_ALWAYS = 0.97  # of the mean of unit vectors, within 14 degrees of one another


class Lean:
    """Gathers where up is by an IMU's orientations, in the axes that its mounting gives it."""

    def __init__(self) -> None:
        self._orientations: list[FloatArray] = []
        self._R_base_imu = np.eye(3)

    def add(self, orientation_xyzw: FloatArray, R_base_imu: FloatArray) -> None:
        """Take the orientation of one message."""
        self._orientations.append(orientation_xyzw)
        self._R_base_imu = R_base_imu

    def _up(self, shift: int = 0) -> FloatArray:
        """Up (N, 3) in base_link by quaternions whose fields are moved by so many."""
        q = np.roll(np.array(self._orientations), -shift, axis=1)
        x, y, z, w = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
        up = np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=1)
        return np.asarray(up @ self._R_base_imu.T)

    def changes(self) -> dict[str, Any]:
        """Conventions by which the vehicle does not lie on its side; none where it does not."""
        if len(self._orientations) < _MIN_ORIENTATIONS or _leans(self._up()) < _MIN_LEAN_RAD:
            return {}
        up = self._up().mean(axis=0)
        if float(np.linalg.norm(up)) < _ALWAYS:
            is_ordered = _leans(self._up(1)) < _LEVEL_RAD
            return {"imu_orientation": "wxyz" if is_ordered else "none"}
        return _upright(up)

    def tell_slight(self, result: Examination) -> None:
        """Tell of a vehicle that leans a little all the time; mend it where it really does not.

        One that pitches shows walls farther away than they are, and its velocity ahead is less
        than its way: by both, echoes would move farther than the DVL says.
        """
        if len(self._orientations) < _MIN_ORIENTATIONS:
            return
        up = self._up().mean(axis=0)
        lean_rad = math.acos(float(np.clip(up[2], -1.0, 1.0)))
        is_steady = float(np.linalg.norm(up)) > _ALWAYS
        if not is_steady or not _SLIGHT_RAD < lean_rad < _MIN_LEAN_RAD:
            return
        changes = _upright(up)
        mend = words_of(changes)
        excess = 1.0 / math.cos(changes["imu_pitch_rad"]) ** 2 - 1.0
        scale = result.scale
        is_level = (
            scale is not None
            and scale.by == "velocity"
            and excess > _MIN_EXCESS
            and abs(scale.ratio - 1.0) + 2.0 * scale.sigma < 0.5 * excess
        )
        why = "yet its echoes move as those of a level one:" if is_level else "if it does not,"
        result.tell(
            "imu_leans",
            "imu",
            f"by its orientation the vehicle leans by {math.degrees(lean_rad):.0f} degrees all "
            f"the time; {why} it is the imu that leans, and tf does not say so ({mend})",
            **(changes if is_level else {}),
        )

    def tell(self, result: Examination) -> None:
        """Say so before all else, with what mends it."""
        changes = self.changes()
        if not changes:
            return
        mend = words_of(changes)
        lean = math.degrees(_leans(self._up()))
        if changes.get("imu_orientation") == "wxyz":
            why = "and turns about an axis that lies: its quaternion begins with w"
        elif changes.get("imu_orientation") == "none":
            why = "another way at each heading: its quaternion is disordered; use only its rates"
        else:
            why = "all the time: it is mounted on its side or upside down, and tf does not say so"
        result.tell(
            "imu_leans",
            "imu",
            f"by its orientation the vehicle leans by {lean:.0f} degrees {why} ({mend})",
            **changes,
        )
        result.put_first()


def _upright(up: FloatArray) -> dict[str, Any]:
    """Conventions that turn a direction (3,) upwards."""
    roll = math.atan2(up[1], up[2])
    pitch = -math.atan2(up[0], math.hypot(up[1], up[2]))
    return {"imu_roll_rad": round(roll, 3) + 0.0, "imu_pitch_rad": round(pitch, 3) + 0.0}


def _leans(up: FloatArray) -> float:
    """Median angle [rad] between up and the vehicle's own z axis."""
    return math.acos(float(np.clip(np.median(up[:, 2]), -1.0, 1.0)))
