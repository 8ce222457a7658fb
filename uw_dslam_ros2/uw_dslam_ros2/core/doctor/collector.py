"""Takes readings as a vehicle mapper does, and keeps them as arrays."""

from __future__ import annotations

import math
import re
from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.doctor.judging.odometry import OdometrySample
from uw_dslam_ros2.core.doctor.samples.sample import NavigationSample, PingSample
from uw_dslam_ros2.core.doctor.samples.speckle import decibels_per_count, patch_levels, quantity_of
from uw_dslam_ros2.core.doctor.turning.turns import BeamSample
from uw_dslam_ros2.core.navigation.pose_differences import PoseDifferences
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar import (
    BeamGatherer,
    Beams,
    Detections,
    SonarConfig,
    SonarImage,
    detect,
    detections_from_points,
    detections_from_scan,
)
from uw_dslam_ros2.core.sonar.silence import silent_beams
from uw_dslam_ros2.core.sonar.turning import beams_of_image, is_few_beams
from uw_dslam_ros2.core.submap import Submap

__all__ = ["SampleCollector"]

FloatArray = NDArray[np.float64]

_NUM_SPECKLE_IMAGES = 20
_MIN_IMAGES, _ALWAYS = 10, 0.9


class SampleCollector:
    """Has the inputs of a `VehicleMapper`, so that `io.feeding.feed` serves both alike.

    What arrives is in base_link's axes, whatever the instruments' mountings and messages.
    """

    def __init__(self, sonar: SonarConfig = SonarConfig()) -> None:  # noqa: B008 (frozen)
        self._sonar = sonar
        self._imu: list[tuple[int, float, float]] = []
        self._velocity: list[tuple[int, float, float]] = []
        self._T_base_dvl = SE2()
        self._poses: list[tuple[int, SE2, float]] = []
        self._odometry_frame = ""
        self._pings: list[tuple[int, FloatArray]] = []
        self._beams: list[tuple[Beams, SE2, FloatArray | None]] = []
        self._T_base_sonar = SE2()
        self._tilt_rad = 0.0
        self._levels: list[FloatArray] = []
        self._num_images = 0
        self._num_beams = 0
        self._silent: Counter[float] = Counter()

    @property
    def start_ns(self) -> int:
        """What seconds are counted from: the first reading."""
        stamps = [
            rows[0][0] for rows in (self._imu, self._velocity, self._poses, self._pings) if rows
        ]
        return min(stamps, default=0)

    def attitude_at(self, stamp_ns: int) -> None:  # noqa: ARG002 (as a mapper has it)
        """Nothing is known of roll and pitch here: the vehicle counts as level."""
        return

    def add_imu(
        self,
        stamp_ns: int,
        yaw_rad: float | None,
        yaw_rate_rad_s: float | None,
        *_: Any,
        **__: Any,
    ) -> None:
        """As a mapper's; only yaw and yaw rate are kept."""
        nan = math.nan
        self._imu.append(
            (
                stamp_ns,
                nan if yaw_rad is None else yaw_rad,
                nan if yaw_rate_rad_s is None else yaw_rate_rad_s,
            )
        )

    def add_velocity(
        self,
        stamp_ns: int,
        v_body_m_s: ArrayLike,
        covariance: ArrayLike | None = None,  # noqa: ARG002 (as a mapper has it)
        T_base_sensor: SE2 = SE2(),
    ) -> None:
        """As a mapper's."""
        velocity = T_base_sensor.rotation() @ np.asarray(v_body_m_s, dtype=np.float64)
        if np.isfinite(velocity).all():
            self._velocity.append((stamp_ns, float(velocity[0]), float(velocity[1])))
            self._T_base_dvl = T_base_sensor

    def add_attitude(self, *_: Any) -> None:
        """Of the attitude only the yaw counts here, which `add_imu` has too."""

    def add_depth(self, stamp_ns: int, depth_m: float) -> None:
        """Depth says nothing of conventions in the plane."""

    def add_pose(self, stamp_ns: int, T_frame_base: SE2) -> None:
        """As a mapper's: a pose of the vehicle's own filter."""
        self._poses.append((stamp_ns, T_frame_base, math.nan))

    def note_frame(self, frame_id: str, height_m: float) -> None:
        """Keep the frame of the last pose, and its z in it."""
        if self._poses:
            self._poses[-1] = (*self._poses[-1][:2], height_m)
            self._odometry_frame = frame_id

    def add_beams(
        self, beams: Beams, T_base_sonar: SE2, projection: FloatArray | None = None
    ) -> list[Submap]:
        """As a mapper's: beams of a sonar that turns."""
        self._beams.append((beams, T_base_sonar, projection))
        return []

    def add_image(
        self, image: SonarImage, T_base_sonar: SE2, projection: FloatArray | None = None
    ) -> list[Submap]:
        """As a mapper's."""
        if is_few_beams(image):
            return self.add_beams(beams_of_image(image), T_base_sonar, projection)
        if len(self._levels) < _NUM_SPECKLE_IMAGES:
            self._levels.append(patch_levels(image.intensity))
        self._num_images += 1
        self._num_beams = len(image.bearing_rad)
        self._silent.update(image.bearing_rad[silent_beams(image.intensity)].tolist())
        return self._add(detect(image, self._sonar), T_base_sonar, projection)

    def add_scan(
        self,
        stamp_ns: int,
        angles_rad: ArrayLike,
        ranges_m: ArrayLike,
        range_max_m: float,
        T_base_sonar: SE2,
        projection: FloatArray | None = None,
    ) -> list[Submap]:
        """As a mapper's."""
        found = detections_from_scan(stamp_ns, angles_rad, ranges_m, range_max_m, self._sonar)
        return self._add(found, T_base_sonar, projection)

    def add_points(
        self,
        stamp_ns: int,
        points: ArrayLike,
        T_base_sonar: SE2,
        projection: FloatArray | None = None,
    ) -> list[Submap]:
        """As a mapper's."""
        found = detections_from_points(stamp_ns, points, self._sonar)
        return self._add(found, T_base_sonar, projection)

    def _add(
        self, detections: Detections, T_base_sonar: SE2, projection: FloatArray | None
    ) -> list[Submap]:
        if projection is not None:
            detections = detections.projected(projection)
            # What is left of the forward axis, seen from above.
            self._tilt_rad = math.acos(min(1.0, float(np.hypot(*projection[:, 0]))))
        self._pings.append((detections.stamp_ns, detections.points))
        self._T_base_sonar = T_base_sonar
        return []

    def navigation(self) -> NavigationSample:
        """What the IMU and the DVL said, in order of stamps."""
        imu, velocity = _sorted(self._imu), _sorted(self._velocity)
        mount = self._T_base_dvl
        return NavigationSample(
            self.seconds([row[0] for row in imu]),
            np.array([row[1] for row in imu]),
            np.array([row[2] for row in imu]),
            self.seconds([row[0] for row in velocity]),
            np.array([row[1:] for row in velocity]).reshape(-1, 2),
            (mount.x, mount.y),
        )

    def odometry(self) -> OdometrySample:
        """What the vehicle's own filter said, in order of stamps."""
        poses = sorted(self._poses, key=lambda pose: pose[0])
        differences = PoseDifferences()
        moved = [differences.add(stamp_ns, pose) for stamp_ns, pose, _ in poses]
        velocity = [found for found in moved if found is not None]
        return OdometrySample(
            self.seconds([stamp_ns for stamp_ns, _, _ in poses]),
            np.array([pose.yaw for _, pose, _ in poses]),
            self.seconds([stamp_ns for stamp_ns, _ in velocity]),
            np.array([v for _, v in velocity]).reshape(-1, 2),
            np.array([height_m for _, _, height_m in poses]),
            "ned" in re.split("[^a-z]+", self._odometry_frame.lower()),
        )

    def pings(self) -> PingSample:
        """What the sonar said, in order of stamps."""
        pings = sorted(self._pings, key=lambda ping: ping[0])
        return PingSample(
            self.seconds([stamp_ns for stamp_ns, _ in pings]),
            tuple(points for _, points in pings),
            self._T_base_sonar,
            quantity_of(self._levels),
            self._sonar.intensity,
            decibels_per_count(self._levels),
            self._tilt_rad,
            self.start_ns * 1e-9,
            self._silent_share(),
            self._silent_rad(),
        )

    def _silent_rad(self) -> tuple[float, ...]:
        """Bearings at which nearly no image holds anything, rising."""
        least = max(_MIN_IMAGES, _ALWAYS * self._num_images)
        return tuple(sorted(b for b, count in self._silent.items() if count >= least))

    def _silent_share(self) -> float:
        return len(self._silent_rad()) / max(1, self._num_beams)

    @property
    def is_turning(self) -> bool:
        """Whether single beams came."""
        return bool(self._beams)

    def beams(self) -> BeamSample:
        """Echoes of a sonar that turns, in the order of time: beams, or turns of one moment."""
        gatherer, mount = BeamGatherer(), self._T_base_sonar
        for beams, T_base_sonar, projection in sorted(
            self._beams, key=lambda item: int(item[0].stamp_ns[0])
        ):
            gatherer.add(beams, T_base_sonar, projection)
            mount = T_base_sonar
        stamps, polar = [np.empty(0, np.int64)], [np.empty((0, 2))]
        for sweep in gatherer.take(None):
            found = sweep.echoes(self._sonar)
            stamps.append(sweep.stamp_ns[found.beam])
            polar.append(np.column_stack([sweep.bearing_rad[found.beam], found.range_m]))
        if not self._beams:
            for stamp_ns, points in sorted(self._pings, key=lambda ping: ping[0]):
                stamps.append(np.full(len(points), stamp_ns, np.int64))
                bearing = np.arctan2(points[:, 1], points[:, 0])
                polar.append(np.column_stack([bearing, np.hypot(points[:, 0], points[:, 1])]))
        bearing, range_m = np.vstack(polar).T
        return BeamSample(self.seconds(np.concatenate(stamps)), bearing, range_m, mount)

    def seconds(self, stamps_ns: ArrayLike) -> FloatArray:
        """Stamps [ns] as times from the first reading [s]."""
        seconds = (np.asarray(stamps_ns, dtype=np.int64) - self.start_ns) * 1e-9
        return np.asarray(seconds, dtype=np.float64)


def _sorted(rows: list[tuple[int, float, float]]) -> list[tuple[int, float, float]]:
    return sorted(rows, key=lambda row: row[0])
