"""Where instruments sit on a vehicle: mounting transforms of space, brought down to the plane."""

from __future__ import annotations

import math
from collections.abc import Set
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.se2 import SE2

__all__ = [
    "FanMount",
    "ForwardAxis",
    "StaticFrames",
    "fan_mount",
    "fan_tilt",
    "level_rotation",
    "rotation_of_quaternion",
    "rotation_of_roll_pitch",
]

FloatArray = NDArray[np.float64]
ForwardAxis = Literal["x", "z"]
"""The axis of a sonar's frame that points forward: x (REP 103) or z (imaging sonar)."""

_MAX_TILT_RAD = math.radians(60.0)
_LEVEL = 1e-9  # parts of a unit vector that rounding leaves


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


def rotation_of_roll_pitch(roll_rad: float, pitch_rad: float) -> FloatArray:
    """Rotation matrix (3, 3) about x, and then about y."""
    cr, sr, cp, sp = (
        math.cos(roll_rad),
        math.sin(roll_rad),
        math.cos(pitch_rad),
        math.sin(pitch_rad),
    )
    return np.array([[cp, sp * sr, sp * cr], [0.0, cr, -sr], [-sp, cp * sr, cp * cr]])


@dataclass(frozen=True, slots=True, eq=False)
class FanMount:
    """Where a sonar's fan of beams sits on a vehicle, and how it is seen from above.

    A point (2,) of the fan [m] (x along bearing 0, y to port) lies at
    ``T_base_fan.apply(projection @ point)`` in the plane of base_link. ``projection`` (2, 2) is
    None where the fan is level and upright; it shortens what points up or down, and mirrors what
    hangs upside down.
    """

    T_base_fan: SE2
    projection: FloatArray | None


def fan_mount(
    T_base_sensor: ArrayLike,
    forward: ForwardAxis | None = "x",
    R_level_base: ArrayLike | None = None,
) -> FanMount:
    """How the fan of a sonar whose frame sits at ``T_base_sensor`` (4, 4) is seen from above.

    Parameters
    ----------
    T_base_sensor
        Mounting.
    forward
        The axis of its frame along bearing 0: "x" (y to port, z up) or "z" (x up, y to starboard).
        None: the more level of the two.
    R_level_base
        Rotation (3, 3) from base_link to the level frame with the same yaw: roll and pitch when
        the ping was measured. None: level.

    Raises
    ------
    InvalidInputError
        If the middle of the fan points more than 60 degrees up or down: then it has no direction
        in the plane.
    """
    T_base_sensor = np.asarray(T_base_sensor, dtype=np.float64)
    rotation, place = T_base_sensor[:3, :3], T_base_sensor[:3, 3]
    if R_level_base is not None:
        rotation, place = np.asarray(R_level_base) @ rotation, np.asarray(R_level_base) @ place
    forward = forward or _more_level(rotation)
    ahead, to_port = _fan_axes(rotation, forward)
    tilt = math.asin(min(1.0, abs(float(ahead[2]))))
    if not tilt <= _MAX_TILT_RAD:
        raise InvalidInputError(
            f"the middle of the sonar's fan points {math.degrees(tilt):.0f} degrees out of the "
            f"horizontal plane, expected at most {math.degrees(_MAX_TILT_RAD):.0f}; "
            f"is its frame defined with another forward axis than {forward}?"
        )
    yaw = math.atan2(ahead[1], ahead[0])
    T_base_fan = SE2(float(place[0]), float(place[1]), yaw)
    seen = SE2(0.0, 0.0, -yaw).apply(np.stack([ahead[:2], to_port[:2]])).T
    is_level = bool(np.abs(seen - np.eye(2)).max() < _LEVEL)
    return FanMount(T_base_fan, None if is_level else seen)


def fan_tilt(T_base_sensor: FloatArray, forward: ForwardAxis | None = "x") -> float:
    """How far the middle of a fan points up or down on a level vehicle [rad]."""
    rotation = T_base_sensor[:3, :3]
    ahead, _ = _fan_axes(rotation, forward or _more_level(rotation))
    return math.asin(min(1.0, abs(float(ahead[2]))))


def _more_level(rotation: FloatArray) -> ForwardAxis:
    return "x" if abs(rotation[2, 0]) <= abs(rotation[2, 2]) else "z"


def _fan_axes(rotation: FloatArray, forward: ForwardAxis) -> tuple[FloatArray, FloatArray]:
    """Directions (3,) of bearing 0 and of bearing 90 degrees to port."""
    if forward == "x":
        return rotation[:, 0], rotation[:, 1]
    return rotation[:, 2], -rotation[:, 1]


def level_rotation(R_world_base: ArrayLike) -> FloatArray | None:
    """Roll and pitch alone (3, 3): from base_link to the level frame of the same yaw.

    None where the vehicle would lean by more than 60 degrees: an attitude in another convention,
    or of an instrument that is mounted otherwise than was told.
    """
    rotation = np.asarray(R_world_base, dtype=np.float64)
    if rotation[2, 2] < math.cos(_MAX_TILT_RAD):
        return None
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    cos, sin = math.cos(yaw), math.sin(yaw)
    unturned = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    level: FloatArray = unturned @ rotation
    # Rounding is no attitude: what is level stays so to the last bit.
    return np.eye(3) if np.abs(level - np.eye(3)).max() < _LEVEL else level


class StaticFrames:
    """A tree of fixed frames, filled transform by transform.

    Names are compared without slashes at their ends. A name that is not in the tree stands for
    the one that has the vehicle's name before it (``sonar`` for ``auv_1/sonar``), or lacks it.
    """

    def __init__(self) -> None:
        self._parent: dict[str, tuple[str, FloatArray]] = {}

    def add(self, parent_frame_id: str, frame_id: str, T_parent_frame: ArrayLike) -> None:
        """Take one transform (4, 4); a later one for the same frame replaces the earlier."""
        matrix = np.asarray(T_parent_frame, dtype=np.float64)
        self._parent[frame_id.strip("/")] = (parent_frame_id.strip("/"), matrix)

    def __len__(self) -> int:
        return len(self._parent)

    def __contains__(self, frame_id: str) -> bool:
        return frame_id.strip("/") in self._parent

    @property
    def names(self) -> Set[str]:
        """Frames whose parent was told."""
        return self._parent.keys()

    def lookup(self, base_frame_id: str, frame_id: str) -> FloatArray:
        """``T_base_frame`` (4, 4), through any number of links upwards from `frame_id`.

        Raises
        ------
        InvalidInputError
            If no chain leads from the frame up to the base.
        """
        T_base_frame = np.eye(4)
        for name in self.chain(base_frame_id, frame_id):
            T_base_frame = self._parent[name][1] @ T_base_frame
        return T_base_frame

    def chain(self, base_frame_id: str, frame_id: str) -> list[str]:
        """Frames whose transforms lead from `frame_id` up to the base, see `lookup`."""
        base_frame_id = base_frame_id.strip("/")
        vehicle_id = base_frame_id.rpartition("/")[0]
        known = self._parent.keys() | {parent for parent, _ in self._parent.values()}
        base = _named(base_frame_id, vehicle_id, known)
        here = _named(frame_id.strip("/"), vehicle_id, known | {base_frame_id})
        names: list[str] = []
        for _ in range(len(self._parent) + 1):
            if here in (base, base_frame_id):
                return names
            if here not in self._parent:
                break
            names.append(here)
            here = self._parent[here][0]
        raise InvalidInputError(
            f"no static transform leads from {frame_id!r} to {base_frame_id!r}; "
            f"known frames: {', '.join(sorted(self._parent)) or 'none'}"
        )


def _named(frame_id: str, vehicle_id: str, known: Set[str]) -> str:
    """The same frame as the tree calls it."""
    for name in (frame_id, f"{vehicle_id}/{frame_id}", frame_id.removeprefix(f"{vehicle_id}/")):
        if name in known:
            return name
    return frame_id
