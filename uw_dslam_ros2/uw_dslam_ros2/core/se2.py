"""Rigid motions of the plane."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.errors import InvalidInputError

__all__ = ["SE2", "compose_poses", "invert_poses", "wrap_angle"]

FloatArray = NDArray[np.float64]
_TWO_PI = 2.0 * math.pi
_set = object.__setattr__


@overload
def wrap_angle(angle: float) -> float: ...
@overload
def wrap_angle(angle: FloatArray) -> FloatArray: ...
def wrap_angle(angle: float | FloatArray) -> float | FloatArray:
    """Wrap an angle [rad] to [-pi, pi)."""
    wrapped = (angle + math.pi) % _TWO_PI - math.pi
    # The remainder of a tiny negative number rounds up to the full turn.
    if isinstance(wrapped, np.ndarray):
        return np.where(wrapped >= math.pi, -math.pi, wrapped)
    return -math.pi if wrapped >= math.pi else float(wrapped)


@dataclass(frozen=True, slots=True)
class SE2:
    """A rigid motion ``p -> R(yaw) p + (x, y)``; named ``T_target_source`` after what it maps.

    ``x`` and ``y`` in metres, ``yaw`` in radians, counter-clockwise, wrapped to [-pi, pi).
    """

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0

    def __post_init__(self) -> None:
        # Written out: graphs of many submaps make these by the hundred thousand.
        x, y, yaw = float(self.x), float(self.y), float(self.yaw)
        if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(yaw)):
            for name, value in zip(("x", "y", "yaw"), (x, y, yaw), strict=True):
                if not math.isfinite(value):
                    raise InvalidInputError(f"SE2.{name} is {value}, expected a finite number")
        wrapped = (yaw + math.pi) % _TWO_PI - math.pi
        _set(self, "x", x)
        _set(self, "y", y)
        _set(self, "yaw", -math.pi if wrapped >= math.pi else wrapped)

    def __matmul__(self, other: SE2) -> SE2:
        """Compose: ``T_a_c = T_a_b @ T_b_c``."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return SE2(
            self.x + cos * other.x - sin * other.y,
            self.y + sin * other.x + cos * other.y,
            self.yaw + other.yaw,
        )

    def inverse(self) -> SE2:
        """``T_source_target`` of a ``T_target_source``."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return SE2(-cos * self.x - sin * self.y, sin * self.x - cos * self.y, -self.yaw)

    def apply(self, points: ArrayLike) -> FloatArray:
        """Move points (N, 2) [m], or one point (2,), from source to target coordinates."""
        points = np.asarray(points, dtype=np.float64)
        x, y = points[..., 0], points[..., 1]
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        # Written out it is five times as fast as a product of such narrow matrices, and the last
        # digit does not depend on a linear-algebra library.
        moved = np.empty(points.shape)
        moved[..., 0] = cos * x - sin * y + self.x
        moved[..., 1] = sin * x + cos * y + self.y
        return moved

    def rotation(self) -> FloatArray:
        """Rotation matrix (2, 2)."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return np.array([[cos, -sin], [sin, cos]])

    def matrix(self) -> FloatArray:
        """Homogeneous matrix (3, 3)."""
        matrix = np.eye(3)
        matrix[:2, :2] = self.rotation()
        matrix[:2, 2] = (self.x, self.y)
        return matrix

    def as_array(self) -> FloatArray:
        """``[x, y, yaw]``, shape (3,)."""
        return np.array([self.x, self.y, self.yaw])

    @classmethod
    def from_array(cls, values: ArrayLike) -> SE2:
        """Build from ``[x, y, yaw]``."""
        x, y, yaw = np.asarray(values, dtype=np.float64)
        return cls(float(x), float(y), float(yaw))

    def distance_to(self, other: SE2) -> tuple[float, float]:
        """Translation [m] and absolute rotation [rad] between two motions into the same frame."""
        return (
            math.hypot(self.x - other.x, self.y - other.y),
            abs(wrap_angle(self.yaw - other.yaw)),
        )


def compose_poses(T_a_b: FloatArray, T_b_c: FloatArray) -> FloatArray:
    """Compose many motions at once: ``T_a_c`` (N, 3) of arrays (N, 3) [x, y, yaw]."""
    cos, sin = np.cos(T_a_b[:, 2]), np.sin(T_a_b[:, 2])
    x, y = T_b_c[:, 0], T_b_c[:, 1]
    turned = cos * x - sin * y, sin * x + cos * y, T_b_c[:, 2]
    composed = T_a_b + np.column_stack(turned)
    composed[:, 2] = wrap_angle(composed[:, 2])
    return composed


def invert_poses(T_a_b: FloatArray) -> FloatArray:
    """Invert many motions at once: ``T_b_a`` (N, 3) of an array (N, 3) [x, y, yaw]."""
    cos, sin = np.cos(T_a_b[:, 2]), np.sin(T_a_b[:, 2])
    x, y = T_a_b[:, 0], T_a_b[:, 1]
    return np.column_stack([-cos * x - sin * y, sin * x - cos * y, wrap_angle(-T_a_b[:, 2])])
