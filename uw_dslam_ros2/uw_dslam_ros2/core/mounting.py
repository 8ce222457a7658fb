"""Where instruments sit on a vehicle: mounting transforms of space, brought down to the plane."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["ForwardAxis", "StaticFrames", "planar_mount", "rotation_of_quaternion"]

FloatArray = NDArray[np.float64]
ForwardAxis = Literal["x", "z"]
"""The axis of an instrument's frame that points forward: x (REP 103, DVL) or z (imaging sonar)."""

_MAX_TILT_RAD = math.radians(60.0)


def rotation_of_quaternion(quaternion: ArrayLike) -> FloatArray:
    """Rotation matrix (3, 3) of a quaternion [x, y, z, w]; normalised first.

    Raises
    ------
    InvalidInputError
        If a component is not finite, or the norm is not near 1.
    """
    q = np.asarray(quaternion, dtype=np.float64)
    norm = float(np.linalg.norm(q))
    if q.shape != (4,) or not np.isfinite(q).all() or abs(norm - 1.0) > 0.05:
        raise InvalidInputError(f"quaternion [x y z w] is {q.tolist()}, expected norm 1")
    x, y, z, w = q / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def planar_mount(T_base_sensor: ArrayLike, forward: ForwardAxis = "x") -> SE2:
    """Pose in the plane of an instrument whose frame sits at ``T_base_sensor`` (4, 4).

    The result's yaw is where the `forward` axis of the instrument points, seen from above; so a
    sonar with z forward, x up and y to starboard that looks straight ahead has yaw 0, like a DVL
    with x forward and z down.

    Raises
    ------
    InvalidInputError
        If the forward axis points more than 60 degrees up or down: then it has no direction in the
        plane.
    """
    matrix = np.asarray(T_base_sensor, dtype=np.float64)
    axis = matrix[:3, 0 if forward == "x" else 2]
    tilt = math.atan2(abs(axis[2]), math.hypot(axis[0], axis[1]))
    if not tilt <= _MAX_TILT_RAD:
        raise InvalidInputError(
            f"the instrument's {forward} axis points {math.degrees(tilt):.0f} degrees out of the "
            f"horizontal plane, expected at most {math.degrees(_MAX_TILT_RAD):.0f}; "
            "is its frame defined with another forward axis?"
        )
    return SE2(float(matrix[0, 3]), float(matrix[1, 3]), math.atan2(axis[1], axis[0]))


class StaticFrames:
    """A tree of fixed frames, filled transform by transform."""

    def __init__(self) -> None:
        self._parent: dict[str, tuple[str, FloatArray]] = {}

    def add(self, parent_frame_id: str, frame_id: str, T_parent_frame: ArrayLike) -> None:
        """Take one transform (4, 4); a later one for the same frame replaces the earlier."""
        self._parent[frame_id] = (parent_frame_id, np.asarray(T_parent_frame, dtype=np.float64))

    def __contains__(self, frame_id: str) -> bool:
        return frame_id in self._parent

    def lookup(self, base_frame_id: str, frame_id: str) -> FloatArray:
        """``T_base_frame`` (4, 4), through any number of links upwards from `frame_id`.

        Raises
        ------
        InvalidInputError
            If no chain leads from the frame up to the base.
        """
        T_here_frame = np.eye(4)
        here = frame_id
        for _ in range(len(self._parent) + 1):
            if here == base_frame_id:
                return T_here_frame
            if here not in self._parent:
                break
            here, T_parent_here = self._parent[here]
            T_here_frame = T_parent_here @ T_here_frame
        raise InvalidInputError(
            f"no static transform leads from {frame_id!r} to {base_frame_id!r}; "
            f"known frames: {', '.join(sorted(self._parent)) or 'none'}"
        )
