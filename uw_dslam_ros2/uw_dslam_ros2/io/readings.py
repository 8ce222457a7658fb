"""What the instruments said, one reading at a time: plain values of core, without ROS."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.mounting import ForwardAxis, rotation_of_quaternion
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar.types import SonarImage

__all__ = [
    "PINGS",
    "BeamsEvent",
    "DepthEvent",
    "Event",
    "FixEvent",
    "ImageEvent",
    "ImuEvent",
    "PointsEvent",
    "PoseEvent",
    "Reading",
    "ScanEvent",
    "TransformEvent",
    "TruthEvent",
    "VelocityEvent",
]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ImageEvent:
    """A ping of an imaging sonar.

    ``forward`` is the axis of its frame along bearing 0. With "z" the frame is x up, y to
    starboard (a beam is [0, -sin b, cos b]); with "x" it is y to port, z up ([cos b, sin b, 0]).
    None: the driver does not say; then it is the one of the two that is mounted more level.
    """

    vehicle_id: str
    stamp_ns: int
    frame_id: str
    image: SonarImage
    forward: ForwardAxis | None = "z"


@dataclass(frozen=True, slots=True, eq=False)
class ImuEvent:
    """Orientation [x, y, z, w] of the IMU's frame in the world, and rates (3,) in its own frame.

    None where the message has none; ``yaw_variance`` [rad^2] is None where it is unknown.
    ``drift_rad`` of its heading and ``drift_rad_s`` of its rates, counter-clockwise seen from
    above, are known not to be the vehicle's.
    """

    vehicle_id: str
    stamp_ns: int
    frame_id: str
    orientation_xyzw: FloatArray | None
    yaw_variance: float | None
    angular_velocity_rad_s: FloatArray | None
    drift_rad: float = 0.0
    drift_rad_s: float = 0.0

    @property
    def yaw_rad(self) -> float | None:
        """Yaw of the IMU's x axis in the world as the message has it; None without orientation."""
        if self.orientation_xyzw is None:
            return None
        rotation = rotation_of_quaternion(self.orientation_xyzw)
        return math.atan2(rotation[1, 0], rotation[0, 0])

    @property
    def yaw_rate_rad_s(self) -> float | None:
        """Rate about the IMU's own z axis; None without rates."""
        rates = self.angular_velocity_rad_s
        return None if rates is None else float(rates[2])


@dataclass(frozen=True, slots=True, eq=False)
class VelocityEvent:
    """Velocity over ground (3,) [m/s] in the instrument's own frame; covariance (3, 3) or None.

    ``is_z_down`` is what the message's definition says of that frame (x forward, y to starboard, z
    down, as a DVL has it; else y to port, z up), for where no transform says it. A component that
    the instrument does not measure is 0.
    """

    vehicle_id: str
    stamp_ns: int
    frame_id: str
    velocity_m_s: FloatArray
    covariance: FloatArray | None
    is_z_down: bool = False

    def horizontal(self) -> tuple[FloatArray, FloatArray | None]:
        """Velocity (2,) and covariance (2, 2) with x forward, y to port, by the definition."""
        to_port = np.array([1.0, -1.0 if self.is_z_down else 1.0])
        velocity = self.velocity_m_s[:2] * to_port
        if self.covariance is None:
            return velocity, None
        return velocity, self.covariance[:2, :2] * np.outer(to_port, to_port)


@dataclass(frozen=True, slots=True)
class DepthEvent:
    """Depth below the surface."""

    vehicle_id: str
    stamp_ns: int
    frame_id: str
    depth_m: float


@dataclass(frozen=True, slots=True, eq=False)
class ScanEvent:
    """Ranges (N,) [m] at angles (N,) [rad], counter-clockwise from the frame's x axis.

    All of one moment: a sonar that turns while it measures makes `BeamsEvent`.
    """

    vehicle_id: str
    stamp_ns: int
    frame_id: str
    angles_rad: FloatArray
    ranges_m: FloatArray
    range_max_m: float


@dataclass(frozen=True, slots=True, eq=False)
class PointsEvent:
    """Echoes (N, 2) [m], x forward, y to port; or (N, 3) of space in the frame's axes.

    Of the latter, those further than ``max_height_m`` above or below the sonar are no walls: the
    sea bed, the surface.
    """

    vehicle_id: str
    stamp_ns: int
    frame_id: str
    points: FloatArray
    max_height_m: float = math.inf


@dataclass(frozen=True, slots=True, eq=False)
class BeamsEvent:
    """Beams of a sonar that turns, each with its own time: one, a sector or a turn.

    ``beam_stamp_ns`` (B,) and ``bearing_rad`` (B,), counter-clockwise from the frame's x axis, in
    the order of time. Without ``intensity``, ``range_m`` (B,) is each beam's echo (inf: none up to
    ``range_max_m``). With ``intensity`` (R, B), ``range_m`` (R,) are the centres of its bins.
    ``stamp_ns`` is the first beam's.
    """

    vehicle_id: str
    stamp_ns: int
    frame_id: str
    beam_stamp_ns: NDArray[np.int64]
    bearing_rad: FloatArray
    range_m: FloatArray
    range_max_m: float
    intensity: NDArray[np.generic] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PoseEvent:
    """Where the vehicle's own filter believes that it is, in a frame that drifts.

    ``covariance`` (3, 3) of x, y, yaw or None; ``velocity_m_s`` (3,) over ground in
    ``child_frame_id`` or None; ``height_m`` is z in the frame, NaN where nobody fills it in.
    """

    vehicle_id: str
    stamp_ns: int
    frame_id: str
    child_frame_id: str
    T_frame_base: SE2
    covariance: FloatArray | None
    velocity_m_s: FloatArray | None = None
    height_m: float = math.nan


@dataclass(frozen=True, slots=True, eq=False)
class FixEvent:
    """An absolute position, of an acoustic or a satellite receiver.

    ``position`` (2,) is [x, y] in metres in ``frame_id``, or [latitude, longitude] in degrees
    when ``is_geodetic``. ``covariance`` (2, 2) [m^2] of [x, y] (east, north), or None.
    """

    vehicle_id: str
    stamp_ns: int
    frame_id: str
    position: FloatArray
    covariance: FloatArray | None
    is_geodetic: bool = False


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


Reading = (
    ImageEvent
    | ScanEvent
    | PointsEvent
    | BeamsEvent
    | VelocityEvent
    | ImuEvent
    | DepthEvent
    | PoseEvent
    | FixEvent
)
"""What an instrument's message becomes."""

PINGS = (ImageEvent, ScanEvent, PointsEvent, BeamsEvent)
"""Readings of a sonar."""

Event = Reading | TransformEvent | TruthEvent
