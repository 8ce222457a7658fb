"""ROS messages to plain core values.

Every function takes any object with the fields of the message: one of rclpy's, or one that
`rosbags` made. So nodes and bags share one interpretation. Malformed content raises
`InvalidInputError` that names the field.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.mounting import rotation_of_quaternion
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar.types import SonarImage

__all__ = [
    "DATA_ORDERS",
    "depth_of_pressure",
    "matrix_of_transform",
    "points_of_cloud",
    "pose_of_odometry",
    "readings_of_imu",
    "scan_of_laser_scan",
    "sonar_image_of",
    "stamp_of",
    "velocity_of_dvl",
    "velocity_of_twist",
]

FloatArray = NDArray[np.float64]

DATA_ORDERS = ("range_major", "beam_major")
"""The slowest index of a sonar image's bytes: range (index = range * beams + beam), or beam."""

# By the constants of marine_acoustic_msgs/SonarImageData.
_PIXEL_TYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")
# By the constants of sensor_msgs/PointField.
_POINT_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_DVL_MODE_WATER = 2
_MIN_DVL_BEAMS = 3
_ATMOSPHERE_PA = 101325.0
_GRAVITY_M_S2 = 9.80665


def stamp_of(msg: Any) -> int:
    """Time of a message's header [ns]."""
    stamp = msg.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def sonar_image_of(msg: Any, data_order: str = "range_major") -> SonarImage:
    """Image of a ``marine_acoustic_msgs/ProjectedSonarImage``, a [range, beam] view of its bytes.

    The message's frame is z forward, x up, y to starboard, hence bearing = atan2(-y, z), positive
    to port.
    """
    if data_order not in DATA_ORDERS:
        raise InvalidInputError(f"data_order is {data_order!r}, expected one of {DATA_ORDERS}")
    range_m = np.asarray(msg.ranges, dtype=np.float64)
    if not (np.isfinite(range_m).all() and (np.diff(range_m) > 0.0).all()):
        raise InvalidInputError("ranges are not finite and rising")
    directions = np.array([(d.x, d.y, d.z) for d in msg.beam_directions]).reshape(-1, 3)
    num_beams, num_ranges = int(msg.image.beam_count), len(range_m)
    if len(directions) != num_beams:
        raise InvalidInputError(
            f"beam_directions has {len(directions)} entries, expected beam_count = {num_beams}"
        )
    in_plane = np.hypot(directions[:, 1], directions[:, 2])
    if not (np.isfinite(directions).all() and (in_plane > 0.1).all()):
        raise InvalidInputError(
            "beam_directions holds a vector without a bearing (y, z both near 0)"
        )
    shape = (num_ranges, num_beams) if data_order == "range_major" else (num_beams, num_ranges)
    pixels = _pixels(msg.image, num_ranges * num_beams).reshape(shape)
    return SonarImage(
        stamp_ns=stamp_of(msg),
        intensity=pixels if data_order == "range_major" else pixels.T,
        range_m=range_m,
        bearing_rad=np.arctan2(-directions[:, 1], directions[:, 2]),
    )


def _pixels(image: Any, num_pixels: int) -> NDArray[np.generic]:
    code = int(image.dtype)
    if not 0 <= code < len(_PIXEL_TYPES):
        raise InvalidInputError(f"image.dtype is {code}, expected 0 to {len(_PIXEL_TYPES) - 1}")
    dtype = np.dtype((">" if image.is_bigendian else "<") + _PIXEL_TYPES[code])
    data = np.frombuffer(_as_buffer(image.data), dtype=np.uint8)
    expected = num_pixels * dtype.itemsize
    if len(data) != expected:
        raise InvalidInputError(
            f"image.data has {len(data)} bytes, expected {expected} "
            f"(ranges x beams = {num_pixels} pixels of {dtype.itemsize} bytes)"
        )
    # Kernels want the machine's own byte order.
    return data.view(dtype).astype(dtype.newbyteorder("="), copy=False)


def _as_buffer(data: Any) -> Any:
    """Take what rclpy hands out, arrays or bytes; a plain list of integers becomes bytes."""
    return bytes(data) if isinstance(data, list) else data


def readings_of_imu(msg: Any) -> tuple[FloatArray | None, float | None, FloatArray | None]:
    """``(quaternion, variance of yaw [rad^2], rates (3,) [rad/s])`` of an Imu, or None.

    The message says "no orientation" and "no rates" by -1 in the first element of the covariance;
    an all-zero quaternion is taken for the same. A variance of 0 means unknown.
    """
    q = msg.orientation
    orientation: FloatArray | None = None
    variance: float | None = None
    if float(msg.orientation_covariance[0]) != -1.0 and any((q.x, q.y, q.z, q.w)):
        orientation = np.array([q.x, q.y, q.z, q.w], dtype=np.float64)
        rotation_of_quaternion(orientation)  # refuses what is no rotation
        value = float(msg.orientation_covariance[8])
        variance = value if value > 0.0 else None
    turning = msg.angular_velocity
    rates = np.array([turning.x, turning.y, turning.z], dtype=np.float64)
    has_rates = float(msg.angular_velocity_covariance[0]) != -1.0
    if has_rates and not math.isfinite(rates[2]):
        raise InvalidInputError(f"angular_velocity.z is {rates[2]}, expected a finite number")
    return orientation, variance, rates if has_rates else None


def velocity_of_dvl(msg: Any) -> tuple[FloatArray, FloatArray | None] | None:
    """Velocity (3,) [m/s] and covariance (3, 3) or None of a ``marine_acoustic_msgs/Dvl``.

    In the instrument's frame, x forward, z down. None without a velocity over ground: bottom lock
    lost, fewer than three good beams, or measured against the water.
    """
    velocity = np.array([msg.velocity.x, msg.velocity.y, msg.velocity.z], dtype=np.float64)
    num_beams = int(msg.num_good_beams)
    # Some drivers leave the count at 0; then only a velocity that is exactly 0 means "none".
    is_counted_out = 0 < num_beams < _MIN_DVL_BEAMS or (num_beams == 0 and not velocity[:2].any())
    if (
        int(msg.velocity_mode) == _DVL_MODE_WATER
        or is_counted_out
        or not np.isfinite(velocity[:2]).all()
    ):
        return None
    covariance = np.asarray(msg.velocity_covar, dtype=np.float64).reshape(3, 3)
    return np.nan_to_num(velocity), _covariance_or_none(covariance)


def velocity_of_twist(msg: Any) -> tuple[FloatArray, FloatArray | None]:
    """Velocity (3,) [m/s] and covariance of a ``TwistWithCovarianceStamped``, in its FLU frame."""
    linear = msg.twist.twist.linear
    velocity = np.array([linear.x, linear.y, linear.z], dtype=np.float64)
    if not np.isfinite(velocity).all():
        raise InvalidInputError(f"twist.linear is {velocity.tolist()}, expected finite numbers")
    covariance = np.asarray(msg.twist.covariance, dtype=np.float64).reshape(6, 6)[:3, :3]
    return velocity, _covariance_or_none(covariance)


def _covariance_or_none(covariance: FloatArray) -> FloatArray | None:
    is_usable = np.isfinite(covariance).all() and (np.diag(covariance)[:2] > 0.0).all()
    return covariance.copy() if is_usable else None


def depth_of_pressure(msg: Any, water_density_kg_m3: float = 1025.0) -> float:
    """Depth [m] of a ``sensor_msgs/FluidPressure`` (Pa, absolute) under one atmosphere."""
    pressure = float(msg.fluid_pressure)
    if not math.isfinite(pressure):
        raise InvalidInputError(f"fluid_pressure is {pressure}, expected a finite number of Pa")
    return (pressure - _ATMOSPHERE_PA) / (water_density_kg_m3 * _GRAVITY_M_S2)


def scan_of_laser_scan(msg: Any) -> tuple[FloatArray, FloatArray, float]:
    """``(angles (N,) [rad], ranges (N,) [m], range_max [m])`` of a ``sensor_msgs/LaserScan``.

    Ranges keep their meaning: inf or beyond the maximum is no echo, NaN or below ``range_min``
    (made NaN) is invalid.
    """
    ranges = np.array(msg.ranges, dtype=np.float64)
    values = (float(msg.angle_min), float(msg.angle_increment), float(msg.range_max))
    if not np.isfinite(values).all() or len(ranges) == 0:
        raise InvalidInputError(
            f"angle_min, angle_increment, range_max are {values} with {len(ranges)} ranges, "
            "expected finite numbers and at least one range"
        )
    ranges[ranges < float(msg.range_min)] = np.nan
    angles = values[0] + values[1] * np.arange(len(ranges), dtype=np.float64)
    return angles, ranges, values[2]


def points_of_cloud(msg: Any) -> FloatArray:
    """Points (N, 2) [m] [x, y] of a ``sensor_msgs/PointCloud2``, without those not finite."""
    fields = {f.name: f for f in msg.fields}
    order = ">" if msg.is_bigendian else "<"
    num_rows, num_cols = int(msg.height), int(msg.width)
    point_step, row_step = int(msg.point_step), int(msg.row_step)
    data = np.frombuffer(_as_buffer(msg.data), dtype=np.uint8)
    if len(data) != num_rows * row_step or row_step < num_cols * point_step:
        raise InvalidInputError(
            f"data has {len(data)} bytes, expected height x row_step = {num_rows} x {row_step}, "
            f"each row holding width x point_step = {num_cols} x {point_step}"
        )
    rows = data.reshape(num_rows, row_step)[:, : num_cols * point_step]
    cells = np.ascontiguousarray(rows).reshape(-1, point_step)
    columns = []
    for name in ("x", "y"):
        if name not in fields or int(fields[name].datatype) not in _POINT_TYPES:
            raise InvalidInputError(
                f"no field {name!r} of a known type; there are {sorted(fields)}"
            )
        dtype = np.dtype(order + _POINT_TYPES[int(fields[name].datatype)])
        offset = int(fields[name].offset)
        if offset + dtype.itemsize > point_step:
            raise InvalidInputError(
                f"field {name!r} at offset {offset} exceeds point_step {point_step}"
            )
        chunk = np.ascontiguousarray(cells[:, offset : offset + dtype.itemsize])
        columns.append(chunk.view(dtype)[:, 0].astype(np.float64))
    points = np.stack(columns, axis=1) if len(cells) else np.empty((0, 2))
    return points[np.isfinite(points).all(axis=1)]


def matrix_of_transform(transform: Any) -> FloatArray:
    """``T_parent_child`` (4, 4) of a ``geometry_msgs/Transform``."""
    t, q = transform.translation, transform.rotation
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_of_quaternion((q.x, q.y, q.z, q.w))
    matrix[:3, 3] = (t.x, t.y, t.z)
    if not np.isfinite(matrix).all():
        raise InvalidInputError(
            f"translation is {matrix[:3, 3].tolist()}, expected finite numbers"
        )
    return matrix


def pose_of_odometry(msg: Any) -> SE2:
    """Horizontal pose of a ``nav_msgs/Odometry`` in its header's frame."""
    position, q = msg.pose.pose.position, msg.pose.pose.orientation
    rotation = rotation_of_quaternion((q.x, q.y, q.z, q.w))
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    return SE2(float(position.x), float(position.y), yaw)
