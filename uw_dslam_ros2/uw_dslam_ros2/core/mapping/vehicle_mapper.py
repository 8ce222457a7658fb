"""One vehicle's mapping: sensor messages in, submaps, map and trajectory out."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.mapping.config import VehicleMapperConfig
from uw_dslam_ros2.core.mapping.estimators import make_estimator
from uw_dslam_ros2.core.mapping.key_pings import KeyPings
from uw_dslam_ros2.core.mapping.section import ClosedSection, OpenSection
from uw_dslam_ros2.core.mapping.vehicle_map import VehicleMap, path_of
from uw_dslam_ros2.core.navigation import NavigationFilter
from uw_dslam_ros2.core.navigation.pose_differences import PoseDifferences
from uw_dslam_ros2.core.pose_graph import chained_covariance
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar import (
    BeamGatherer,
    Beams,
    Detections,
    PlacedSweep,
    SonarImage,
    detect,
    detections_from_points,
    detections_from_scan,
    place_sweep,
)
from uw_dslam_ros2.core.sonar.turning import Sweep, beams_of_image, is_few_beams
from uw_dslam_ros2.core.submap import MAX_RUN_ID, Submap, SubmapId

__all__ = ["MapperWatch", "VehicleMapper"]

FloatArray = NDArray[np.float64]
MapperWatch = Callable[[SubmapId, Detections, SE2], None]
_REISSUE_M, _REISSUE_RAD = 0.02, 0.002
"""A submap that moved by more is given away again."""
_ATTITUDE_NS = 500_000_000
"""A vehicle rolls and pitches within seconds: older angles are not used."""
_TURN_MEMORY_S = 120.0
"""A turn takes up to 35 s, and its message may come when the next one is complete."""
_AHEAD_NS = 1_000_000_000
"""At the end, beams this much newer than all navigation are placed by its last velocity."""
_FAN_BEAM_RAD = 0.01


class VehicleMapper:
    """Maps one vehicle's surroundings; every input is a method call with a stamp in nanoseconds.

    Messages are to come in the order of their stamps, a ping after the navigation of its moment:
    `io.feeding.in_stamp_order` and the mapper's node see to that. Navigation that is late all the
    same is put where it belongs, for the pings that follow; a ping that is late, or earlier than
    all navigation, is left out and counted. The odom frame begins where the vehicle does. A mapper
    is one run (`core.submap.Track`): who begins again makes a new one, with another ``run_id``.
    ``watch`` is called with all that enters a submap's grid, and its ``T_submap_sonar``.
    """

    def __init__(
        self,
        config: VehicleMapperConfig,
        vehicle_id: str,
        run_id: int = 1,
        watch: MapperWatch | None = None,
    ) -> None:
        if not vehicle_id:
            raise InvalidInputError("vehicle_id is empty, expected a name")
        if not 0 < run_id <= MAX_RUN_ID:
            raise InvalidInputError(f"run_id is {run_id}, expected 1 to {MAX_RUN_ID}")
        self._own_config = config
        self._vehicle_id, self._run_id = vehicle_id, run_id
        self._watch = watch
        self._navigation = NavigationFilter(config.navigation)
        self._suit(_FAN_BEAM_RAD)
        self._map = VehicleMap(config.occupancy)
        self._closed: list[ClosedSection] = []
        self._open: OpenSection | None = None
        self._last_ping_ns: int | None = None
        self._counts: dict[str, float | int | str] = {
            "num_pings": 0, "num_pings_dropped": 0, "num_pings_empty": 0,
            "num_detections_last": 0, "depth_m": math.nan,
        }  # fmt: skip
        self._velocity_ns: int | None = None
        self._pose_differences = PoseDifferences()
        self._attitude: tuple[int, FloatArray | None] = (0, None)
        self._gatherer = BeamGatherer()
        # Until it is known what kind of sonar there is.
        self._navigation.remember(_TURN_MEMORY_S)

    # --- navigation in
    # -------------------------------------------------------------------------------------------

    def add_imu(
        self,
        stamp_ns: int,
        yaw_rad: float | None,
        yaw_rate_rad_s: float | None,
        yaw_sigma_rad: float | None = None,
    ) -> None:
        """Yaw and yaw rate of base_link, counter-clockwise; None where not measured.

        Yaw may have an unknown constant offset.
        """
        if yaw_rate_rad_s is not None:
            self._navigation.add_yaw_rate(stamp_ns, yaw_rate_rad_s)
        if yaw_rad is not None:
            self._navigation.add_yaw(stamp_ns, yaw_rad, yaw_sigma_rad)

    def add_velocity(
        self,
        stamp_ns: int,
        v_body_m_s: ArrayLike,
        covariance: ArrayLike | None = None,
        T_base_sensor: SE2 = SE2(),
    ) -> None:
        """Velocity (2,) along the instrument's axes (forward, left) with covariance (2, 2)."""
        self._navigation.add_velocity(stamp_ns, v_body_m_s, covariance, T_base_sensor)
        if np.isfinite(np.asarray(v_body_m_s, dtype=np.float64)).all():
            self._velocity_ns = max(stamp_ns, self._velocity_ns or stamp_ns)

    def add_pose(self, stamp_ns: int, T_frame_base: SE2) -> None:
        """Pose that the vehicle's own filter gives; only the motion between poses is used."""
        self._navigation.add_yaw(stamp_ns, T_frame_base.yaw)
        if (difference := self._pose_differences.add(stamp_ns, T_frame_base)) is not None:
            self.add_velocity(*difference)

    def add_attitude(self, stamp_ns: int, R_level_base: FloatArray | None) -> None:
        """Roll and pitch (3, 3), from base_link to the level frame of the same yaw."""
        self._attitude = (stamp_ns, R_level_base)

    def attitude_at(self, stamp_ns: int) -> FloatArray | None:
        """Roll and pitch (3, 3) as last measured; None where that is not known or long ago."""
        measured_ns, R_level_base = self._attitude
        return R_level_base if abs(stamp_ns - measured_ns) <= _ATTITUDE_NS else None

    def add_depth(self, stamp_ns: int, depth_m: float) -> None:  # noqa: ARG002 (one form for all inputs)
        """Depth below the surface [m], positive down.

        Kept for the diagnostics: the map is flat.
        """
        if math.isfinite(depth_m):
            self._counts["depth_m"] = float(depth_m)

    # --- sonar in
    # ----------------

    def add_image(
        self, image: SonarImage, T_base_sonar: SE2, projection: FloatArray | None = None
    ) -> list[Submap]:
        """A sonar image; returns submaps that closed, or whose pose has moved, by now.

        ``projection`` (2, 2) takes points of a fan that is not level to the plane, before
        ``T_base_sonar``: see `core.mounting.FanMount`.
        """
        if is_few_beams(image):
            return self.add_beams(beams_of_image(image), T_base_sonar, projection)
        return self._add(detect(image, self._config.sonar), T_base_sonar, projection)

    def add_scan(
        self,
        stamp_ns: int,
        angles_rad: ArrayLike,
        ranges_m: ArrayLike,
        range_max_m: float,
        T_base_sonar: SE2,
        projection: FloatArray | None = None,
    ) -> list[Submap]:
        """A scan: angles (B,), ranges (B,), infinity where a beam met nothing."""
        found = detections_from_scan(
            stamp_ns, angles_rad, ranges_m, range_max_m, self._config.sonar
        )
        return self._add(found, T_base_sonar, projection)

    def add_points(
        self,
        stamp_ns: int,
        points: ArrayLike,
        T_base_sonar: SE2,
        projection: FloatArray | None = None,
    ) -> list[Submap]:
        """Detections (N, 2) [m] that somebody else made, in the sonar's frame."""
        found = detections_from_points(stamp_ns, points, self._config.sonar)
        return self._add(found, T_base_sonar, projection)

    def add_beams(
        self, beams: Beams, T_base_sonar: SE2, projection: FloatArray | None = None
    ) -> list[Submap]:
        """Beams of a sonar that turns, each with its own time.

        They are mapped once their sweep is complete and navigation has come to its end.
        """
        self._gatherer.add(beams, T_base_sonar, projection)
        self._counts["num_beams_dropped"] = self._gatherer.num_late
        newest_ns = self._navigation.stamp_ns
        return [] if newest_ns is None else self._add_sweeps(self._gatherer.take(newest_ns))

    def finish(self) -> list[Submap]:
        """Close the open submap, and settle the graph; no ping may follow."""
        issued = self._add_sweeps(self._gatherer.take(None))
        if self._open is None:
            return issued
        last_ns = int(self._open.stamps_ns[-1])
        return issued + self._close(self._navigation.relative_at(last_ns)[1])

    def issued(self, sequence: int) -> Submap | None:
        """A submap as it was given away last; None if there is none of this number."""
        for section in self._closed:
            if section.sequence == sequence:
                return self._submap_of(section, section.T_odom_issued)
        return None

    # --- results
    # ----------------

    @property
    def is_started(self) -> bool:
        """Whether there is a pose."""
        return self._navigation.is_started

    @property
    def run_id(self) -> int:
        """Which run of its vehicle this is, see `core.submap.Track`."""
        return self._run_id

    @property
    def num_pings(self) -> int:
        """Pings mapped so far."""
        return int(self._counts["num_pings"])

    @property
    def stamp_ns(self) -> int | None:
        """Time of `T_odom_base`: of the newest navigation message; None before the first."""
        return self._navigation.stamp_ns

    @property
    def T_odom_base(self) -> SE2:  # noqa: N802 (a motion)
        """Where the vehicle is now.

        Raises `InvalidInputError` before the first navigation message.
        """
        stamp_ns = self._navigation.stamp_ns
        if stamp_ns is None:
            raise InvalidInputError("there is no pose yet, expected navigation messages first")
        if self._open is None:
            if self._closed:
                last = self._closed[-1]
                return self._estimator.poses[-1] @ SE2.from_array(last.trajectory[-1])
            return self._navigation.pose_at(stamp_ns)[0]
        return self._estimator.poses[-1] @ self._navigation.relative_at(stamp_ns)[0]

    @property
    def T_smooth_base(self) -> SE2:  # noqa: N802 (a motion)
        """Where the vehicle is now, in a frame that loop closures do not move: it drifts.

        Raises `InvalidInputError` before the first navigation message.
        """
        stamp_ns = self._navigation.stamp_ns
        if stamp_ns is None:
            raise InvalidInputError("there is no pose yet, expected navigation messages first")
        return self._navigation.pose_at(stamp_ns)[0]

    @property
    def smooth_covariance(self) -> FloatArray:
        """Covariance (3, 3) of `T_smooth_base`, order x, y, yaw."""
        stamp_ns = self._navigation.stamp_ns
        if stamp_ns is None:
            raise InvalidInputError("there is no pose yet, expected navigation messages first")
        return self._navigation.pose_at(stamp_ns)[1]

    @property
    def velocity_covariance(self) -> FloatArray:
        """Covariance (3, 3) of `velocity`: forward, left [m/s], yaw rate [rad/s]."""
        stamp_ns = self._navigation.stamp_ns
        if stamp_ns is None:
            raise InvalidInputError("there is no velocity yet, expected navigation messages first")
        return self._navigation.velocity_covariance_at(stamp_ns)

    @property
    def depth_m(self) -> float:
        """Depth below the surface as last measured; NaN where it is not."""
        return float(self._counts["depth_m"])

    @property
    def pose_covariance(self) -> FloatArray:
        """Covariance (3, 3) of `T_odom_base`, order x, y, yaw, in odom."""
        stamp_ns = self._navigation.stamp_ns
        if stamp_ns is None:
            raise InvalidInputError("there is no pose yet, expected navigation messages first")
        if self._estimator.num_loops_believed == 0:
            return self._navigation.pose_at(stamp_ns)[1]
        T_odom_submap = self._estimator.poses[-1]
        T_submap_base, own = SE2(), np.zeros((3, 3))
        if self._open is not None:
            T_submap_base, own = self._navigation.relative_at(stamp_ns)
        return chained_covariance(T_odom_submap, self._estimator.covariance(), T_submap_base, own)

    @property
    def velocity(self) -> tuple[FloatArray, float]:
        """Body velocity (2,) [m/s] over ground and yaw rate [rad/s] now."""
        stamp_ns = self._navigation.stamp_ns
        if stamp_ns is None:
            raise InvalidInputError("there is no velocity yet, expected navigation messages first")
        return self._navigation.velocity_at(stamp_ns)

    def trajectory(self) -> tuple[NDArray[np.int64], FloatArray]:
        """Stamps (K,) and poses (K, 3) of base_link in odom at every ping, as best known now."""
        return path_of(self._closed, self._open, self._estimator.poses)

    def vehicle_map(self) -> OccupancyMap:
        """All submaps, the open one included, in odom: as they were last issued.

        Raises `InvalidInputError` before the first ping.
        """
        if not self._closed and self._open is None:
            raise InvalidInputError("there is no map yet, expected a ping with navigation first")
        T_odom_newest = self._estimator.poses[-1]
        return self._map.draw(self._closed, self._open, T_odom_newest)

    def diagnostics(self) -> dict[str, float | int | str]:
        """Counters and the filter's beliefs, by name."""
        navigation = self._navigation
        newest_ns = navigation.stamp_ns
        age_s = math.nan
        if newest_ns is not None and self._velocity_ns is not None:
            age_s = (newest_ns - self._velocity_ns) * 1e-9
        return {
            "vehicle_id": self._vehicle_id,
            "estimator": self._config.estimator,
            **self._counts,
            "num_key_pings": self._keys.num_pings,
            "num_matches": self._keys.num_matches,
            "match_overlap_last": self._keys.overlap_last,
            "num_submaps": len(self._closed),
            "num_submaps_not_drawn": self._map.num_left_out,
            "num_loops": self._estimator.num_loops,
            "num_loops_believed": self._estimator.num_loops_believed,
            "velocity_age_s": age_s,
            "num_navigation_late": navigation.num_late,
            "num_navigation_invalid": navigation.num_invalid,
            "num_navigation_outliers": navigation.num_outliers,
            **navigation.counts(),
            **navigation.sensor_errors(),
        }

    # --- inside
    # ----------------

    def _add(
        self,
        detections: Detections,
        T_base_sonar: SE2,
        projection: FloatArray | None = None,
        sweep: PlacedSweep | None = None,
    ) -> list[Submap]:
        if projection is not None:
            detections = detections.projected(projection)
        is_old = self._last_ping_ns is not None and detections.stamp_ns <= self._last_ping_ns
        if is_old or not self._navigation.is_started:
            self._count("num_pings_dropped")
            return []
        if self._last_ping_ns is None:
            # Points of a turn come when it is over, and may be stamped with its middle.
            is_turn = sweep is not None or detections.is_turn
            self._navigation.remember(_TURN_MEMORY_S if is_turn else 0.0)
            # Echoes of a fan are as near to each other as its settings say, and come at once.
            self._suit(detections.beamwidth_rad if is_turn else _FAN_BEAM_RAD)
        self._last_ping_ns = detections.stamp_ns
        return self._process(detections, T_base_sonar, sweep)

    def _suit(self, beamwidth_rad: float) -> None:
        """Take settings that are left to the sonar from the first that is known of it."""
        self._config = self._own_config.suited(beamwidth_rad)
        self._estimator = make_estimator(self._config)
        self._keys = KeyPings(self._config, self._navigation)

    def _add_sweeps(self, sweeps: list[Sweep]) -> list[Submap]:
        issued: list[Submap] = []
        navigation = self._navigation
        for whole in sweeps:
            oldest_ns, newest_ns = navigation.oldest_ns, navigation.stamp_ns
            if oldest_ns is None or newest_ns is None:
                self._count("num_pings_dropped")
                continue
            sweep = whole.since(oldest_ns).until(newest_ns + _AHEAD_NS)
            if not sweep.beams:
                self._count("num_pings_dropped")
                continue
            stamps_ns = sweep.stamp_ns
            # Of the middle beam: the others are placed relative to it, the farther the less sure.
            stamp_ns = int(stamps_ns[len(stamps_ns) // 2])
            T_base_odom = navigation.pose_at(stamp_ns)[0].inverse()
            poses = [T_base_odom @ navigation.pose_at(int(t))[0] for t in stamps_ns]
            placed = place_sweep(sweep, poses, stamp_ns, self._config.sonar)
            issued += self._add(placed.detections, SE2(), sweep=placed)
        return issued

    def _count(self, name: str) -> None:
        self._counts[name] = int(self._counts[name]) + 1

    def _process(
        self, detections: Detections, T_base_sonar: SE2, sweep: PlacedSweep | None
    ) -> list[Submap]:
        issued: list[Submap] = []
        stamp_ns = detections.stamp_ns
        self._count("num_pings")
        self._counts["num_detections_last"] = len(detections.points)
        if not len(detections.points):
            self._count("num_pings_empty")
        if self._open is None:
            self._begin(stamp_ns)
        assert self._open is not None
        if self._keys.is_due(stamp_ns):
            self._keys.match(detections, T_base_sonar)
        T_submap_base, covariance = self._navigation.relative_at(stamp_ns)
        # At the submap's own start the covariance is zero, which may come out as a trace below it.
        sigma_m = math.sqrt(max(0.0, float(np.linalg.eigvalsh(covariance[:2, :2])[-1])))
        if self._open.should_close(stamp_ns, sigma_m, self._velocity_ns is None):
            issued = self._close(covariance)
            self._begin(stamp_ns, T_submap_base, covariance)
            T_submap_base = SE2()
        if sweep is None:
            self._open.add(detections, T_submap_base, T_base_sonar)
        else:
            self._open.add_sweep(sweep, T_submap_base)
        return issued

    def _begin(
        self,
        stamp_ns: int,
        T_previous_new: SE2 | None = None,
        covariance: FloatArray | None = None,
    ) -> None:
        """Open a submap at the vehicle's pose of now."""
        T_odom_base, odom_covariance = self._navigation.pose_at(stamp_ns)
        index = len(self._closed)
        if T_previous_new is None or covariance is None:
            covariance = odom_covariance
            self._estimator.add_first(T_odom_base, odom_covariance)
        else:
            self._estimator.add_next(T_previous_new, covariance)
            self._keys.rebase(T_previous_new.inverse())
        watch = None
        if self._watch is not None:
            submap_id = SubmapId(self._vehicle_id, self._run_id, index)
            watch = functools.partial(self._watch, submap_id)
        self._open = OpenSection(self._config, index, covariance, watch)
        self._navigation.clone(stamp_ns)

    def _close(self, drift: FloatArray) -> list[Submap]:
        """Close the open submap, look for loops, and say which submaps are new or have moved."""
        assert self._open is not None
        poses = self._estimator.poses
        section = self._open.close(poses[-1], drift)
        self._closed.append(section)
        self._open = None
        self._estimator.close_loops(self._closed)
        return self._issue(new=section)

    def _issue(self, new: ClosedSection | None = None) -> list[Submap]:
        issued = []
        for section, T_odom_submap in zip(self._closed, self._estimator.poses, strict=False):
            distance, turn = section.T_odom_issued.distance_to(T_odom_submap)
            has_moved = distance > _REISSUE_M or turn > _REISSUE_RAD
            if section is not new:
                if not has_moved:
                    continue
                section.revision += 1
            section.T_odom_issued = T_odom_submap
            issued.append(self._submap_of(section, T_odom_submap))
        return issued

    def _submap_of(self, section: ClosedSection, T_odom_submap: SE2) -> Submap:
        log_odds_max = self._config.occupancy.log_odds_max
        return section.to_submap(self._vehicle_id, self._run_id, T_odom_submap, log_odds_max)
