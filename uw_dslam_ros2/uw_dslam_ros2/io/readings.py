"""What the instruments said, one reading at a time: plain values of core, without ROS."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar.types import SonarImage

__all__ = [
    "DepthEvent",
    "Event",
    "ImageEvent",
    "ImuEvent",
    "PointsEvent",
    "ScanEvent",
    "TransformEvent",
    "TruthEvent",
    "VelocityEvent",
]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ImageEvent:
    """A ping of an imaging sonar."""

    vehicle_id: str
    stamp_ns: int
    frame_id: str
    image: SonarImage


@dataclass(frozen=True, slots=True)
class ImuEvent:
    """Heading (ENU yaw of the IMU's x axis) and yaw rate; None where the message has none."""

    vehicle_id: str
    stamp_ns: int
    frame_id: str
    yaw_rad: float | None
    yaw_variance: float | None
    yaw_rate_rad_s: float | None


@dataclass(frozen=True, slots=True, eq=False)
class VelocityEvent:
    """Velocity over ground (2,) [m/s] in horizontal FLU axes; covariance (2, 2) or None.

    A DVL's own frame has z down: its y is already turned to port here. ``planar_mount`` of the
    instrument's frame (x forward) brings it to base_link.
    """

    vehicle_id: str
    stamp_ns: int
    frame_id: str
    velocity_m_s: FloatArray
    covariance: FloatArray | None


@dataclass(frozen=True, slots=True)
class DepthEvent:
    """Depth below the surface."""

    vehicle_id: str
    stamp_ns: int
    frame_id: str
    depth_m: float


@dataclass(frozen=True, slots=True, eq=False)
class ScanEvent:
    """Ranges (N,) [m] at angles (N,) [rad], counter-clockwise from the frame's x axis."""

    vehicle_id: str
    stamp_ns: int
    frame_id: str
    angles_rad: FloatArray
    ranges_m: FloatArray
    range_max_m: float


@dataclass(frozen=True, slots=True, eq=False)
class PointsEvent:
    """Echoes (N, 2) [m], x forward, y to port."""

    vehicle_id: str
    stamp_ns: int
    frame_id: str
    points: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class TransformEvent:
    """A fixed transform ``T_parent_child`` (4, 4): ``frame_id`` is the parent."""

    vehicle_id: str
    stamp_ns: int
    frame_id: str
    child_frame_id: str
    T_parent_child: FloatArray


@dataclass(frozen=True, slots=True)
class TruthEvent:
    """Where the vehicle really was: for scoring, never an input."""

    vehicle_id: str
    stamp_ns: int
    frame_id: str
    T_world_base: SE2


Event = (
    ImageEvent
    | ImuEvent
    | VelocityEvent
    | DepthEvent
    | ScanEvent
    | PointsEvent
    | TransformEvent
    | TruthEvent
)
