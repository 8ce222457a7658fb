"""One vehicle of a simulated mission as readings in memory, without a bag."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.mounting import rotation_of_quaternion
from uw_dslam_ros2.core.sonar.types import SonarImage
from uw_dslam_ros2.io.readings import ImageEvent, ImuEvent, Reading, VelocityEvent
from uw_dslam_ros2.sim.missions.mission import T_BASE_DVL, T_BASE_SONAR, Mission, PingMaker

__all__ = ["MissionReadings", "mounting_of"]

IntArray = NDArray[np.int64]

_HALF = math.sqrt(0.5)


def mounting_of(reading: Reading) -> NDArray[np.float64]:
    """``T_base_sensor`` (4, 4) as the mission's bags have it in ``/tf_static``."""
    mounting = np.eye(4)
    if isinstance(reading, ImageEvent):
        mounting[:3, :3] = rotation_of_quaternion((_HALF, 0.0, _HALF, 0.0))
        mounting[:2, 3] = T_BASE_SONAR.x, T_BASE_SONAR.y
    elif isinstance(reading, VelocityEvent):
        mounting[:3, :3] = np.diag([1.0, -1.0, -1.0])
        mounting[:2, 3] = T_BASE_DVL.x, T_BASE_DVL.y
    return mounting


class MissionReadings:
    """Readings of a vehicle with an imaging sonar; images are made when first asked for."""

    def __init__(self, mission: Mission, vehicle: int = 0) -> None:
        self._maker = PingMaker(mission)
        self._vehicle = vehicle
        self._run = mission.runs[vehicle]
        self._images: dict[int, SonarImage] = {}
        log = self._run.navigation
        has_lock = np.isfinite(log.dvl_velocity_m_s).all(axis=1)
        self._velocity_m_s = log.dvl_velocity_m_s[has_lock]
        self.vehicle_id = self._run.vehicle_id
        self.stamps: dict[str, IntArray] = {
            "imu": log.imu_stamp_ns,
            "velocity": log.dvl_stamp_ns[has_lock],
            "sonar": self._run.ping_motion.stamp_ns,
        }

    def __call__(self, is_wanted: Callable[[str, int], bool]) -> Iterator[Reading]:
        """Those that are wanted by role and stamp, in order of their stamps."""
        makers: dict[str, Callable[[int, int], Reading]] = {
            "imu": self._imu,
            "velocity": self._velocity,
            "sonar": self._image,
        }
        rows = heapq.merge(
            *(
                [(int(stamp_ns), role, i) for i, stamp_ns in enumerate(stamps)]
                for role, stamps in self.stamps.items()
            )
        )
        for stamp_ns, role, index in rows:
            if is_wanted(role, stamp_ns):
                yield makers[role](stamp_ns, index)

    def _imu(self, stamp_ns: int, index: int) -> ImuEvent:
        half = 0.5 * float(self._run.navigation.yaw_rad[index])
        return ImuEvent(
            self.vehicle_id,
            stamp_ns,
            "imu",
            np.array([0.0, 0.0, math.sin(half), math.cos(half)]),
            None,
            np.array([0.0, 0.0, self._run.navigation.yaw_rate_rad_s[index]]),
        )

    def _velocity(self, stamp_ns: int, index: int) -> VelocityEvent:
        forward, left = self._velocity_m_s[index]
        velocity = np.array([forward, -left, 0.0])
        return VelocityEvent(self.vehicle_id, stamp_ns, "dvl", velocity, None, is_z_down=True)

    def _image(self, stamp_ns: int, index: int) -> ImageEvent:
        if index not in self._images:
            self._images[index] = self._maker.ping(self._vehicle, index)
        return ImageEvent(self.vehicle_id, stamp_ns, "sonar", self._images[index])
