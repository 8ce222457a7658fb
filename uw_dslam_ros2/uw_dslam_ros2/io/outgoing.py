"""Core values to messages for bags; `drivers` is the way back."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rosbags.typesys.store import Typestore

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar.types import SonarImage

__all__ = ["MessageFactory"]

FloatArray = NDArray[np.float64]

_PIXEL_CODES = {
    np.dtype(name): code
    for code, name in enumerate(("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8"))
}
_POINT_FLOAT32 = 7
_DVL_MODE_BOTTOM = 1
_ATMOSPHERE_PA = 101325.0
_GRAVITY_M_S2 = 9.80665


class MessageFactory:
    """Builds messages of the classes of one typestore (that of a `BagWriter`)."""

    def __init__(self, typestore: Typestore) -> None:
        self._types = typestore.types
        # A sonar's beams are the same ping after ping.
        self._beams: tuple[bytes, list[Any]] = (b"", [])

    def make(self, msgtype: str, **fields: Any) -> Any:
        """Build a message; every field of the type must be given."""
        return self._types[msgtype](**fields)

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        """``std_msgs/Header``."""
        sec, nanosec = divmod(int(stamp_ns), 1_000_000_000)
        stamp = self.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)

    def vector(self, x: float, y: float, z: float) -> Any:
        """``geometry_msgs/Vector3``."""
        return self.make("geometry_msgs/msg/Vector3", x=float(x), y=float(y), z=float(z))

    def quaternion(self, values: Sequence[float]) -> Any:
        """``geometry_msgs/Quaternion`` of [x, y, z, w]."""
        x, y, z, w = map(float, values)
        return self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def yaw_quaternion(self, yaw: float) -> Any:
        """``geometry_msgs/Quaternion`` of a turn about z."""
        return self.quaternion((0.0, 0.0, math.sin(yaw / 2.0), math.cos(yaw / 2.0)))

    def sonar_image(
        self,
        frame_id: str,
        image: SonarImage,
        *,
        beam_width_rad: float = 0.0,
        frequency_hz: float = 0.0,
        sound_speed_m_s: float = 0.0,
        data_order: str = "range_major",
    ) -> Any:
        """``marine_acoustic_msgs/ProjectedSonarImage``; 0 means unknown."""
        pixels = image.intensity
        if pixels.dtype.newbyteorder("=") not in _PIXEL_CODES:
            raise InvalidInputError(f"intensity has type {pixels.dtype}, which has no code")
        ordered = pixels if data_order == "range_major" else pixels.T
        data = np.ascontiguousarray(ordered, dtype=pixels.dtype.newbyteorder("<"))
        widths = np.full(
            len(image.bearing_rad) if beam_width_rad else 0, beam_width_rad, dtype=np.float32
        )
        return self.make(
            "marine_acoustic_msgs/msg/ProjectedSonarImage",
            header=self.header(image.stamp_ns, frame_id),
            ping_info=self.make(
                "marine_acoustic_msgs/msg/PingInfo",
                frequency=frequency_hz,
                sound_speed=sound_speed_m_s,
                tx_beamwidths=np.empty(0, np.float32),
                rx_beamwidths=widths,
            ),
            beam_directions=self._directions(image.bearing_rad),
            ranges=image.range_m.astype(np.float32),
            image=self.make(
                "marine_acoustic_msgs/msg/SonarImageData",
                is_bigendian=False,
                dtype=_PIXEL_CODES[pixels.dtype.newbyteorder("=")],
                beam_count=len(image.bearing_rad),
                data=data.view(np.uint8).reshape(-1),
            ),
        )

    def _directions(self, bearing_rad: FloatArray) -> list[Any]:
        """Unit vectors, z forward and y to starboard: bearings to port have negative y."""
        key = bearing_rad.tobytes()
        if key != self._beams[0]:
            vectors = [self.vector(0.0, -math.sin(b), math.cos(b)) for b in bearing_rad.tolist()]
            self._beams = (key, vectors)
        return self._beams[1]

    def imu(
        self,
        stamp_ns: int,
        frame_id: str,
        yaw: float | None,
        yaw_variance: float,
        yaw_rate_rad_s: float | None,
        yaw_rate_variance: float,
    ) -> Any:
        """``sensor_msgs/Imu`` without acceleration; None leaves out orientation or rates."""
        orientation_covariance = np.diag([1e-4, 1e-4, yaw_variance]).reshape(-1)
        rate_covariance = np.diag([1e-6, 1e-6, yaw_rate_variance]).reshape(-1)
        acceleration_covariance = np.zeros(9)
        acceleration_covariance[0] = -1.0
        if yaw is None:
            orientation_covariance[0] = -1.0
        if yaw_rate_rad_s is None:
            rate_covariance[0] = -1.0
        return self.make(
            "sensor_msgs/msg/Imu",
            header=self.header(stamp_ns, frame_id),
            orientation=self.yaw_quaternion(yaw or 0.0),
            orientation_covariance=orientation_covariance,
            angular_velocity=self.vector(0.0, 0.0, yaw_rate_rad_s or 0.0),
            angular_velocity_covariance=rate_covariance,
            linear_acceleration=self.vector(0.0, 0.0, 0.0),
            linear_acceleration_covariance=acceleration_covariance,
        )

    def dvl(
        self,
        stamp_ns: int,
        frame_id: str,
        velocity_flu_m_s: Sequence[float] | FloatArray | None,
        variance: float,
        altitude_m: float,
    ) -> Any:
        """``marine_acoustic_msgs/Dvl`` of a velocity (2,) or (3,) in FLU axes; None: no lock."""
        is_locked = velocity_flu_m_s is not None
        forward = left = down = math.nan
        if velocity_flu_m_s is not None:
            forward, left, *upwards = velocity_flu_m_s
            down = -upwards[0] if upwards else 0.0
        covariance = np.diag([variance] * 3).reshape(-1) if is_locked else np.full(9, -1.0)
        return self.make(
            "marine_acoustic_msgs/msg/Dvl",
            header=self.header(stamp_ns, frame_id),
            velocity_mode=_DVL_MODE_BOTTOM,
            dvl_type=0,
            velocity=self.vector(forward, -left, down),
            velocity_covar=covariance,
            altitude=float(altitude_m) if is_locked else math.nan,
            course_gnd=math.atan2(-left, forward),
            speed_gnd=math.hypot(forward, left),
            num_good_beams=4 if is_locked else 0,
            sound_speed=1500.0,
            beam_ranges_valid=False,
            beam_velocities_valid=False,
            beam_unit_vec=[self.vector(0.0, 0.0, 0.0)] * 4,
            range=np.zeros(4),
            range_covar=np.zeros(4, np.float32),
            beam_quality=np.zeros(4, np.float32),
            beam_velocity=np.zeros(4, np.float32),
            beam_velocity_covar=np.full(4, -1.0, np.float32),
        )

    def twist(
        self,
        stamp_ns: int,
        frame_id: str,
        velocity_flu_m_s: Sequence[float] | FloatArray,
        yaw_rate_rad_s: float,
        covariance: ArrayLike,
    ) -> Any:
        """``geometry_msgs/TwistWithCovarianceStamped``; covariance (6, 6), order as in ROS."""
        twist = self.make(
            "geometry_msgs/msg/Twist",
            linear=self.vector(velocity_flu_m_s[0], velocity_flu_m_s[1], 0.0),
            angular=self.vector(0.0, 0.0, yaw_rate_rad_s),
        )
        values = np.asarray(covariance, dtype=np.float64).reshape(36)
        with_covariance = self.make(
            "geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=values
        )
        return self.make(
            "geometry_msgs/msg/TwistWithCovarianceStamped",
            header=self.header(stamp_ns, frame_id),
            twist=with_covariance,
        )

    def pressure(
        self,
        stamp_ns: int,
        frame_id: str,
        depth_m: float,
        depth_sigma_m: float,
        water_density_kg_m3: float = 1025.0,
    ) -> Any:
        """``sensor_msgs/FluidPressure`` [Pa, absolute] at a depth, under one atmosphere."""
        pa_per_m = water_density_kg_m3 * _GRAVITY_M_S2
        return self.make(
            "sensor_msgs/msg/FluidPressure",
            header=self.header(stamp_ns, frame_id),
            fluid_pressure=_ATMOSPHERE_PA + depth_m * pa_per_m,
            variance=(depth_sigma_m * pa_per_m) ** 2,
        )

    def points(self, stamp_ns: int, frame_id: str, points: ArrayLike) -> Any:
        """``sensor_msgs/PointCloud2`` (x, y, z float32) of points (N, 2) or (N, 3) [m]; z is 0."""
        given = np.asarray(points, dtype=np.float64)
        given = given if given.ndim == 2 else given.reshape(-1, 2)
        flat = np.zeros((len(given), 3), dtype="<f4")
        flat[:, : given.shape[1]] = given
        point_field = self._types["sensor_msgs/msg/PointField"]
        fields = [
            point_field(name=name, offset=4 * i, datatype=_POINT_FLOAT32, count=1)
            for i, name in enumerate("xyz")
        ]
        return self.make(
            "sensor_msgs/msg/PointCloud2",
            header=self.header(stamp_ns, frame_id),
            height=1,
            width=len(flat),
            fields=fields,
            is_bigendian=False,
            point_step=12,
            row_step=12 * len(flat),
            data=flat.view(np.uint8).reshape(-1),
            is_dense=True,
        )

    def laser_scan(
        self,
        stamp_ns: int,
        frame_id: str,
        *,
        angle_min_rad: float,
        angle_increment_rad: float,
        time_increment_s: float,
        ranges_m: ArrayLike,
        range_limits_m: tuple[float, float],
    ) -> Any:
        """``sensor_msgs/LaserScan`` of ranges (N,) [m]; the stamp is the first beam's."""
        ranges = np.asarray(ranges_m, dtype=np.float32)
        return self.make(
            "sensor_msgs/msg/LaserScan",
            header=self.header(stamp_ns, frame_id),
            angle_min=angle_min_rad,
            angle_max=angle_min_rad + angle_increment_rad * (len(ranges) - 1),
            angle_increment=angle_increment_rad,
            time_increment=time_increment_s,
            scan_time=time_increment_s * len(ranges),
            range_min=range_limits_m[0],
            range_max=range_limits_m[1],
            ranges=ranges,
            intensities=np.empty(0, np.float32),
        )

    def odometry(
        self,
        stamp_ns: int,
        frame_id: str,
        child_frame_id: str,
        pose: SE2,
        depth_m: float,
        velocity_flu_m_s: Sequence[float] | FloatArray,
        yaw_rate_rad_s: float,
    ) -> Any:
        """``nav_msgs/Odometry``: pose at height -depth, velocity in the child's axes."""
        position = self.make("geometry_msgs/msg/Point", x=pose.x, y=pose.y, z=-float(depth_m))
        orientation = self.yaw_quaternion(pose.yaw)
        twist = self.make(
            "geometry_msgs/msg/Twist",
            linear=self.vector(velocity_flu_m_s[0], velocity_flu_m_s[1], 0.0),
            angular=self.vector(0.0, 0.0, yaw_rate_rad_s),
        )
        return self.make(
            "nav_msgs/msg/Odometry",
            header=self.header(stamp_ns, frame_id),
            child_frame_id=child_frame_id,
            pose=self.make(
                "geometry_msgs/msg/PoseWithCovariance",
                pose=self.make(
                    "geometry_msgs/msg/Pose", position=position, orientation=orientation
                ),
                covariance=np.zeros(36),
            ),
            twist=self.make(
                "geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)
            ),
        )

    def transforms(
        self,
        stamp_ns: int,
        parent_frame_id: str,
        children: Sequence[tuple[str, Sequence[float], Sequence[float]]],
    ) -> Any:
        """``tf2_msgs/TFMessage`` of (child frame, translation [m], quaternion [x, y, z, w])."""
        items = [
            self.make(
                "geometry_msgs/msg/TransformStamped",
                header=self.header(stamp_ns, parent_frame_id),
                child_frame_id=child,
                transform=self.make(
                    "geometry_msgs/msg/Transform",
                    translation=self.vector(*translation),
                    rotation=self.quaternion(rotation),
                ),
            )
            for child, translation, rotation in children
        ]
        return self.make("tf2_msgs/msg/TFMessage", transforms=items)
