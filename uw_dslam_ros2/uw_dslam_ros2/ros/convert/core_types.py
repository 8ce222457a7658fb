"""Messages to core types and back: geometry, maps, submaps.

`io.drivers` reads the instruments, `registration` what a registration asks and answers.

Our ``OccupancyGrid`` carries -1 for unknown and 0 (free) to 100 (occupied) percent. A rotated
origin is honoured; an origin that is not a rotation about z is refused. rclpy does not check field
types unless told to, so every number that goes into a message passes ``float()`` or ``int()``.
"""

from __future__ import annotations

import array
import dataclasses
import math

import numpy as np
from builtin_interfaces.msg import Time as TimeMsg
from geometry_msgs.msg import Point32, Pose, PoseStamped, PoseWithCovariance, Quaternion
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from numpy.typing import NDArray
from uw_dslam_msgs.msg import Submap as SubmapMsg
from uw_dslam_msgs.msg import Transform2D

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.mounting import rotation_of_quaternion
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap, SubmapId

__all__ = [
    "check_covariance",
    "covariance_to_list",
    "occupancy_from_msg",
    "occupancy_to_msg",
    "odometry_to_msg",
    "path_to_msg",
    "pose_from_msg",
    "pose_to_msg",
    "pose_with_covariance_to_msg",
    "quaternion_to_msg",
    "stamp_ns_from_msg",
    "stamp_to_msg",
    "submap_from_msg",
    "submap_id_of",
    "submap_to_msg",
    "transform2d_from_msg",
    "transform2d_to_msg",
]

FloatArray = NDArray[np.float64]
_PLANAR_ROWS = np.array([0, 1, 5])  # x, y, yaw in a covariance of x y z roll pitch yaw
_DEPTH_SIGMA_M = 0.1
_UNKNOWN_VARIANCE = 1e6
_MAX_TILT = 1e-3  # [rad]
_NORM_TOLERANCE = 1e-3
MAX_GRID_CELLS = 2**30


# --- time ------------------------------------------------------------------------------------


def stamp_ns_from_msg(msg: TimeMsg) -> int:
    """Nanoseconds of a stamp."""
    return int(msg.sec) * 1_000_000_000 + int(msg.nanosec)


def stamp_to_msg(stamp_ns: int) -> TimeMsg:
    """Stamp of nanoseconds."""
    sec, nanosec = divmod(int(stamp_ns), 1_000_000_000)
    return TimeMsg(sec=sec, nanosec=nanosec)


# --- motions ---------------------------------------------------------------------------------


def _finite(name: str, *values: float) -> None:
    for value in values:
        if not math.isfinite(value):
            raise InvalidInputError(f"{name} is {value}, expected a finite number")


def rotation_from_msg(msg: Quaternion, name: str) -> FloatArray:
    """Rotation matrix (3, 3); raises `InvalidInputError` unless the quaternion has norm 1."""
    values = (msg.x, msg.y, msg.z, msg.w)
    norm = math.sqrt(sum(value * value for value in values))
    if not abs(norm - 1.0) <= _NORM_TOLERANCE:  # also when NaN
        raise InvalidInputError(
            f"{name} is (x {msg.x}, y {msg.y}, z {msg.z}, w {msg.w}) with norm {norm:.4g}, "
            "expected norm 1"
        )
    return rotation_of_quaternion(values)


def quaternion_to_msg(yaw_rad: float) -> Quaternion:
    """Rotation about z."""
    return Quaternion(z=math.sin(0.5 * yaw_rad), w=math.cos(0.5 * yaw_rad))


def pose_from_msg(msg: Pose, name: str) -> SE2:
    """Planar pose; raises `InvalidInputError` for NaN, a quaternion not of norm 1, or a tilt."""
    _finite(f"{name}.position.x", msg.position.x)
    _finite(f"{name}.position.y", msg.position.y)
    rotation = rotation_from_msg(msg.orientation, f"{name}.orientation")
    tilt_rad = math.acos(min(1.0, max(-1.0, rotation[2, 2])))
    if tilt_rad > _MAX_TILT:
        raise InvalidInputError(
            f"{name}.orientation is tilted by {math.degrees(tilt_rad):.3g} degrees, "
            "expected a rotation about z"
        )
    return SE2(msg.position.x, msg.position.y, math.atan2(rotation[1, 0], rotation[0, 0]))


def pose_to_msg(T_frame_body: SE2) -> Pose:
    """Planar pose at z = 0."""
    msg = Pose()
    msg.position.x = T_frame_body.x
    msg.position.y = T_frame_body.y
    msg.orientation = quaternion_to_msg(T_frame_body.yaw)
    return msg


def pose_with_covariance_to_msg(T_frame_body: SE2, covariance: FloatArray) -> PoseWithCovariance:
    """Planar pose with a covariance (3, 3) of x, y, yaw."""
    full = np.zeros((6, 6))
    full[np.ix_(_PLANAR_ROWS, _PLANAR_ROWS)] = covariance
    msg = PoseWithCovariance(pose=pose_to_msg(T_frame_body))
    msg.covariance = full.ravel()
    return msg


def odometry_to_msg(
    T_odom_base: SE2,
    covariance: FloatArray,
    velocity_m_s: FloatArray,
    yaw_rate_rad_s: float,
    velocity_covariance: FloatArray,
    depth_m: float,
) -> Odometry:
    """Odometry without header and frames.

    Covariances (3, 3) are of x, y, yaw, and of forward and left velocity and yaw rate. Without a
    depth (NaN) z is 0 with a variance that says that nothing is known of it.
    """
    msg = Odometry(pose=pose_with_covariance_to_msg(T_odom_base, covariance))
    is_known = math.isfinite(depth_m)
    msg.pose.pose.position.z = -depth_m if is_known else 0.0
    full = np.asarray(msg.pose.covariance).reshape(6, 6)
    full[2, 2] = _DEPTH_SIGMA_M**2 if is_known else _UNKNOWN_VARIANCE
    msg.pose.covariance = full.ravel()
    msg.twist.twist.linear.x = float(velocity_m_s[0])
    msg.twist.twist.linear.y = float(velocity_m_s[1])
    msg.twist.twist.angular.z = float(yaw_rate_rad_s)
    full = np.diag([0.0, 0.0, *[_UNKNOWN_VARIANCE] * 3, 0.0])  # z, roll, pitch: not measured
    full[np.ix_(_PLANAR_ROWS, _PLANAR_ROWS)] = velocity_covariance
    msg.twist.covariance = full.ravel()
    return msg


def covariance_from_pose_msg(msg: PoseWithCovariance, name: str) -> FloatArray:
    """Covariance (3, 3) of x, y, yaw."""
    full = np.asarray(msg.covariance, dtype=np.float64).reshape(6, 6)
    covariance = full[np.ix_(_PLANAR_ROWS, _PLANAR_ROWS)]
    check_covariance(covariance, f"{name}.covariance")
    return covariance


def check_covariance(covariance: FloatArray, name: str) -> None:
    """Raise `InvalidInputError` unless a covariance (3, 3) is finite with no negative variance."""
    if not np.isfinite(covariance).all():
        raise InvalidInputError(
            f"{name} holds {covariance.ravel().tolist()}, expected finite numbers"
        )
    if (np.diag(covariance) < 0).any():
        raise InvalidInputError(
            f"{name} has variances {np.diag(covariance).tolist()} for x, y, yaw, "
            "expected none below 0"
        )


def covariance_to_list(covariance: FloatArray) -> list[float]:
    """Row-major values of a covariance (3, 3)."""
    return [float(value) for value in np.asarray(covariance, dtype=np.float64).ravel()]


def transform2d_from_msg(msg: Transform2D, name: str) -> SE2:
    """Rigid motion; raises `InvalidInputError` for NaN."""
    for field in ("x", "y", "yaw"):
        _finite(f"{name}.{field}", getattr(msg, field))
    return SE2(msg.x, msg.y, msg.yaw)


def transform2d_to_msg(T_target_source: SE2 | None) -> Transform2D:
    """Rigid motion as a message; all NaN where there is none."""
    if T_target_source is None:
        return Transform2D(x=math.nan, y=math.nan, yaw=math.nan)
    return Transform2D(x=T_target_source.x, y=T_target_source.y, yaw=T_target_source.yaw)


def path_to_msg(
    stamps_ns: NDArray[np.int64], poses: FloatArray, frame_id: str, stamp_ns: int, max_poses: int
) -> Path:
    """Path of poses (K, 3) [x, y, yaw]; a longer one is thinned evenly, its two ends stay."""
    msg = Path()
    msg.header.frame_id = frame_id
    msg.header.stamp = stamp_to_msg(stamp_ns)
    indices = np.arange(len(poses))
    if len(indices) > max_poses:
        indices = np.unique(np.linspace(0, len(poses) - 1, max_poses).round().astype(np.int64))
    msg.poses = [
        _pose_stamped(int(stamps_ns[i]), frame_id, SE2.from_array(poses[i])) for i in indices
    ]
    return msg


def _pose_stamped(stamp_ns: int, frame_id: str, T_frame_body: SE2) -> PoseStamped:
    msg = PoseStamped(pose=pose_to_msg(T_frame_body))
    msg.header.frame_id = frame_id
    msg.header.stamp = stamp_to_msg(stamp_ns)
    return msg


# --- maps ------------------------------------------------------------------------------------


def decimal_of_float32(value: float) -> float:
    """Shortest decimal that a float32 stands for: 0.05, as was sent, not 0.05000000074505806."""
    return float(str(np.float32(value)))


def occupancy_from_msg(msg: OccupancyGrid, name: str = "grid") -> OccupancyMap:
    """Occupancy map of a message; shares its memory.

    Raises
    ------
    InvalidInputError
        Naming the field, its value and what was expected: no cells, a resolution that is not
        positive, data of another
        length, a value outside -1..100, an origin that is not finite, not unit or tilted.
    """
    info = msg.info
    for field in ("width", "height"):
        if getattr(info, field) < 1:
            raise InvalidInputError(
                f"{name}.info.{field} is {getattr(info, field)} cells, expected at least 1"
            )
    resolution_m = decimal_of_float32(info.resolution)
    if not (math.isfinite(resolution_m) and resolution_m > 0.0):
        raise InvalidInputError(
            f"{name}.info.resolution is {resolution_m} m, expected a positive number"
        )
    num_rows, num_cols = int(info.height), int(info.width)
    if len(msg.data) != num_rows * num_cols:
        raise InvalidInputError(
            f"{name}.data has {len(msg.data)} values, expected height x width = "
            f"{num_rows} x {num_cols} = {num_rows * num_cols}"
        )
    T_frame_grid = pose_from_msg(info.origin, f"{name}.info.origin")
    values = np.frombuffer(msg.data, dtype=np.int8).reshape(num_rows, num_cols)
    low, high = int(values.min()), int(values.max())
    if low < -1 or high > 100:
        bad = low if low < -1 else high
        row, col = np.argwhere(values == bad)[0]
        raise InvalidInputError(
            f"{name}.data holds {bad} at row {row}, column {col}, expected -1 or 0..100"
        )
    return OccupancyMap(GridSpec(resolution_m, num_rows, num_cols, T_frame_grid), values)


def bytes_to_int8_array(values: NDArray[np.int8]) -> array.array[int]:
    """The quick way into an ``int8[]`` field: 250 times faster than a list."""
    data = array.array("b")
    data.frombytes(np.ascontiguousarray(values).data.cast("B"))
    return data


def occupancy_to_msg(occupancy: OccupancyMap, frame_id: str, stamp_ns: int) -> OccupancyGrid:
    """Message of an occupancy map whose ``T_frame_grid`` is in `frame_id`."""
    msg = OccupancyGrid()
    msg.header.frame_id = frame_id
    msg.header.stamp = stamp_to_msg(stamp_ns)
    msg.info.map_load_time = stamp_to_msg(stamp_ns)
    msg.info.resolution = float(occupancy.spec.resolution_m)
    msg.info.width = int(occupancy.spec.num_cols)
    msg.info.height = int(occupancy.spec.num_rows)
    msg.info.origin = pose_to_msg(occupancy.spec.T_frame_grid)
    msg.data = bytes_to_int8_array(occupancy.values)
    return msg


# --- submaps ---------------------------------------------------------------------------------


def submap_frame_id(submap_id: SubmapId) -> str:
    """Frame of a submap."""
    return f"{submap_id.vehicle_id}/submap_{submap_id.sequence}"


def submap_to_msg(submap: Submap, *, is_pose_only: bool = False) -> SubmapMsg:
    """Message of a submap; of its pose only, where all else was sent with an earlier revision."""
    frame_id = submap_frame_id(submap.submap_id)
    msg = SubmapMsg()
    msg.header.frame_id = frame_id
    msg.header.stamp = stamp_to_msg(submap.stamp_ns)
    msg.vehicle_id = submap.vehicle_id
    msg.run_id = int(submap.run_id)
    msg.sequence = int(submap.sequence)
    msg.revision = int(submap.revision)
    msg.is_final = bool(submap.is_final)
    msg.is_pose_only = is_pose_only
    msg.pose = pose_with_covariance_to_msg(submap.T_odom_submap, submap.covariance)
    if is_pose_only:
        return msg
    msg.grid = occupancy_to_msg(submap.grid, frame_id, submap.stamp_ns)
    msg.points = [Point32(x=float(x), y=float(y)) for x, y in submap.points]
    msg.trajectory = [
        _pose_stamped(int(stamp_ns), frame_id, SE2.from_array(pose))
        for stamp_ns, pose in zip(submap.trajectory_stamp_ns, submap.trajectory, strict=True)
    ]
    return msg


def submap_id_of(msg: SubmapMsg) -> SubmapId:
    """Which submap a message is about."""
    return SubmapId(msg.vehicle_id, int(msg.run_id), int(msg.sequence))


def submap_from_msg(msg: SubmapMsg, held: Submap | None = None) -> Submap:
    """Submap of a message; raises `InvalidInputError` naming the field that is wrong.

    `held` is the submap as it was last received: a message that only moves it says no more.
    """
    if not msg.vehicle_id or msg.vehicle_id != msg.vehicle_id.strip("/"):
        raise InvalidInputError(
            f"submap.vehicle_id is {msg.vehicle_id!r}, expected a name without slashes at its ends"
        )
    name = f"submap {msg.vehicle_id}/{msg.sequence}"
    if msg.is_pose_only:
        if held is None or held.submap_id != submap_id_of(msg):
            raise InvalidInputError(f"{name}: only its pose came, expected the submap before")
        return dataclasses.replace(
            held,
            revision=int(msg.revision),
            is_final=bool(msg.is_final),
            stamp_ns=stamp_ns_from_msg(msg.header.stamp),
            T_odom_submap=pose_from_msg(msg.pose.pose, f"{name}.pose.pose"),
            covariance=covariance_from_pose_msg(msg.pose, f"{name}.pose"),
        )
    points = np.array([(p.x, p.y) for p in msg.points], dtype=np.float64).reshape(-1, 2)
    if not np.isfinite(points).all():
        raise InvalidInputError(f"{name}.points hold a number that is not finite, expected metres")
    trajectory = [
        pose_from_msg(p.pose, f"{name}.trajectory[{i}].pose").as_array()
        for i, p in enumerate(msg.trajectory)
    ]
    stamps_ns = [stamp_ns_from_msg(p.header.stamp) for p in msg.trajectory]
    return Submap(
        vehicle_id=msg.vehicle_id,
        sequence=int(msg.sequence),
        revision=int(msg.revision),
        is_final=bool(msg.is_final),
        stamp_ns=stamp_ns_from_msg(msg.header.stamp),
        T_odom_submap=pose_from_msg(msg.pose.pose, f"{name}.pose.pose"),
        covariance=covariance_from_pose_msg(msg.pose, f"{name}.pose"),
        grid=occupancy_from_msg(msg.grid, f"{name}.grid"),
        points=points,
        trajectory=np.array(trajectory, dtype=np.float64).reshape(-1, 3),
        trajectory_stamp_ns=np.array(stamps_ns, dtype=np.int64),
        run_id=int(msg.run_id),
    )
