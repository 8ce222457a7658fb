"""One vehicle's mapping: sensor messages in, submaps, map and trajectory out."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.mapping.config import VehicleMapperConfig
from uw_dslam_ros2.core.mapping.mapper_state import HeldSubmaps, MapperState
from uw_dslam_ros2.core.mapping.scans.key_pings import KeyPings
from uw_dslam_ros2.core.mapping.submap_chain import MapperWatch, SubmapChain
from uw_dslam_ros2.core.mapping.vehicle_navigation import VehicleNavigation
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar import (
    BeamGatherer,
    Beams,
    Clouds,
    Detections,
    PlacedSweep,
    SonarImage,
    detect,
    detections_from_points,
    detections_from_scan,
    place_sweep,
)
from uw_dslam_ros2.core.sonar.turning import Sweep, beams_of_image, is_few_beams
from uw_dslam_ros2.core.submap import MAX_RUN_ID, Submap, Track

__all__ = ["MapperWatch", "VehicleMapper"]

FloatArray = NDArray[np.float64]
_TURN_MEMORY_S = 120.0
"""A turn takes up to 35 s, and its message may come when the next one is complete."""
_AHEAD_NS = 1_000_000_000
"""At the end, beams this much newer than all navigation are placed by its last velocity."""
_FAN_BEAM_RAD = 0.01
_Cloud = tuple[int, ArrayLike, SE2, FloatArray | None]


class VehicleMapper(VehicleNavigation):
    """Maps one vehicle's surroundings; every input is a method call with a stamp in nanoseconds.

    Messages are to come in the order of their stamps, a ping after the navigation of its moment:
    `io.feeding.in_stamp_order` and the mapper's node see to that. Navigation that is late all the
    same is put where it belongs, for the pings that follow; a ping that is late, or earlier than
    all navigation, is left out and counted. The odom frame begins where the vehicle does. A mapper
    is one run (`core.submap.Track`): who begins again makes a new one, with another ``run_id``.
    ``watch`` is called with all that enters a submap's grid; see `core.mapping.section.Watch`.
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
        super().__init__(config.navigation)
        self._own_config = config
        self._track, self._watch = Track(vehicle_id, run_id), watch
        self._suit(_FAN_BEAM_RAD)
        self._last_ping_ns: int | None = None
        self._is_resumed = False
        self._counts = {
            "num_pings": 0, "num_pings_dropped": 0, "num_pings_empty": 0, "num_detections_last": 0,
        }  # fmt: skip
        self._gatherer = BeamGatherer()
        self._clouds: Clouds[_Cloud] = Clouds()
        self._late_s = 0.0
        # Until it is known what kind of sonar there is.
        self._remember(_TURN_MEMORY_S)

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
        """Detections (N, 2) [m] that somebody else made, in the sonar's frame.

        The first wait until it is known whether they are of a fan or of a sonar that turns.
        """
        cloud = (stamp_ns, points, T_base_sonar, projection)
        return self._add_clouds(self._clouds.add(stamp_ns, points, cloud))

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
        issued = self._add_clouds(self._clouds.take())
        issued += self._add_sweeps(self._gatherer.take(None))
        if self._submaps.growing is None:
            return issued
        last_ns = int(self._submaps.growing.stamps_ns[-1])
        return issued + self._submaps.close(self._navigation.relative_at(last_ns)[1])

    def state(self, num_poses: int = 0, num_echoes: int = 0) -> MapperState | None:
        """All that is needed to go on but what was given away and drawn; None: no open submap.

        Of the open submap what has come after so many poses, and pings with echoes.
        """
        submaps, navigation = self._submaps, self._navigation
        if submaps.growing is None or self._last_ping_ns is None:
            return None
        dead = self._dead_reckoning
        return MapperState(
            self.run_id,
            self._beamwidth_rad,
            self._last_ping_ns,
            self._velocity_ns,
            navigation.state(),
            None if dead is None else dead.state(),
            np.array([pose.as_array() for pose in submaps.estimator.poses]),
            submaps.growing.covariance,
            submaps.growing.state(num_poses, num_echoes),
        )

    def resume(self, state: MapperState, held: HeldSubmaps) -> None:
        """Go on from a state in the place of a start: the run goes on.

        The next ping closes the submap that was open: the way that no ping has seen lies between
        two submaps, and its covariance is that of navigation over the time without messages.
        """
        self._resume_navigation(state.navigation, state.dead_reckoning, state.velocity_ns)
        self._suit(state.beamwidth_rad)
        self._last_ping_ns, self._is_resumed = state.last_ping_ns, True
        self._counts["num_pings"] = held.num_pings(state)
        self._submaps.resume(state, held, self._navigation.relative_at(state.last_ping_ns)[1])

    def issued(self, sequence: int) -> Submap | None:
        """A submap as it was given away last; None if there is none of this number."""
        return self._submaps.issued(sequence)

    def submaps(self) -> list[Submap]:
        """All closed submaps as they were given away last."""
        return self._submaps.submaps()

    def replace(self, drawn_anew: Sequence[Submap]) -> None:
        """Take all submaps as they were drawn and placed anew; only after `finish`.

        ``drawn_anew`` are `submaps`, in their order, as later revisions. Map, path and `issued`
        are by these from now on.
        """
        self._submaps.replace(drawn_anew)

    # --- results
    # ----------------

    @property
    def run_id(self) -> int:
        """Which run of its vehicle this is, see `core.submap.Track`."""
        return self._track.run_id

    @property
    def vehicle_id(self) -> str:
        """Whose."""
        return self._track.vehicle_id

    @property
    def num_echoes(self) -> int:
        """Pings whose echoes the open submap keeps; see `state`."""
        return 0 if self._submaps.growing is None else self._submaps.growing.num_echoes

    @property
    def num_pings(self) -> int:
        """Pings mapped so far."""
        return self._counts["num_pings"]

    @property
    def T_odom_base(self) -> SE2:  # noqa: N802 (a motion)
        """Where the vehicle is now.

        Raises `InvalidInputError` before the first navigation message.
        """
        if self._submaps.is_empty:
            return self.T_smooth_base
        return self._submaps.T_odom_base(self._in_submap()[0])

    @property
    def pose_covariance(self) -> FloatArray:
        """Covariance (3, 3) of `T_odom_base`, order x, y, yaw, in odom."""
        if self._submaps.estimator.num_loops_believed == 0:
            return self.smooth_covariance
        return self._submaps.covariance(*self._in_submap())

    def trajectory(self) -> tuple[NDArray[np.int64], FloatArray]:
        """Stamps (K,) and poses (K, 3) of base_link in odom at every ping, as best known now."""
        return self._submaps.trajectory()

    def vehicle_map(self) -> OccupancyMap:
        """All submaps, the open one included, in odom: as they were last issued.

        Raises `InvalidInputError` before the first ping.
        """
        if self._submaps.is_empty:
            raise InvalidInputError("there is no map yet, expected a ping with navigation first")
        return self._submaps.occupancy()

    def diagnostics(self) -> dict[str, float | int | str]:
        """Counters and the filter's beliefs, by name."""
        estimator = self._submaps.estimator
        return {
            "vehicle_id": self._track.vehicle_id,
            "estimator": self._config.estimator,
            **self._counts,
            "num_key_pings": self._keys.num_pings,
            "num_matches": self._keys.num_matches,
            "match_overlap_last": self._keys.overlap_last,
            "num_submaps": len(self._submaps.closed),
            "num_submaps_not_drawn": self._submaps.num_not_drawn,
            "num_loops": estimator.num_loops,
            "num_loops_believed": estimator.num_loops_believed,
            **self.navigation_diagnostics(),
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
        oldest_ns, newest_ns = self._navigation.oldest_ns, self._navigation.stamp_ns
        # Of a moment that is forgotten no pose is known.
        if is_old or oldest_ns is None or newest_ns is None or detections.stamp_ns < oldest_ns:
            self._count("num_pings_dropped")
            return []
        # Points of a turn come when it is over, and may be stamped with its middle.
        is_turn = sweep is not None or detections.is_turn
        self._late_s = max(self._late_s, (newest_ns - detections.stamp_ns) * 1e-9)
        memory_s = _TURN_MEMORY_S if is_turn else min(_TURN_MEMORY_S, 4.0 * self._late_s)
        self._remember(memory_s)
        if self._last_ping_ns is None:
            # Echoes of a fan are as near to each other as its settings say.
            self._suit(detections.beamwidth_rad if is_turn else _FAN_BEAM_RAD)
        self._last_ping_ns = detections.stamp_ns
        return self._process(detections, T_base_sonar, sweep)

    def _add_clouds(self, clouds: list[_Cloud]) -> list[Submap]:
        issued: list[Submap] = []
        spacing_rad = self._clouds.turn_spacing_rad or 0.0
        for stamp_ns, points, T_base_sonar, projection in clouds:
            found = detections_from_points(stamp_ns, points, self._config.sonar, spacing_rad)
            issued += self._add(found, T_base_sonar, projection)
        return issued

    def _suit(self, beamwidth_rad: float) -> None:
        """Take settings that are left to the sonar from the first that is known of it."""
        self._beamwidth_rad = beamwidth_rad
        self._config = self._own_config.suited(beamwidth_rad)
        self._submaps = SubmapChain(self._config, self._track, self._watch)
        self._keys = KeyPings(self._config, self._navigation)

    def _in_submap(self) -> tuple[SE2, FloatArray]:
        """Where the vehicle is in the submap that is open, and its covariance (3, 3)."""
        return self._navigation.relative_at(self._now_ns())

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
        self._counts[name] += 1

    def _process(
        self, detections: Detections, T_base_sonar: SE2, sweep: PlacedSweep | None
    ) -> list[Submap]:
        issued: list[Submap] = []
        stamp_ns = detections.stamp_ns
        self._count("num_pings")
        self._counts["num_detections_last"] = len(detections.points)
        if not len(detections.points):
            self._count("num_pings_empty")
        submaps, navigation = self._submaps, self._navigation
        if self._is_resumed:
            issued += self._close_resumed(stamp_ns)
        elif submaps.growing is None:
            submaps.begin(*navigation.pose_at(stamp_ns))
            navigation.clone(stamp_ns)
        if self._keys.is_due(stamp_ns):
            self._keys.match(detections, T_base_sonar)
        T_submap_base, covariance = navigation.relative_at(stamp_ns)
        # At the submap's own start the covariance is zero, which may come out as a trace below it.
        sigma_m = math.sqrt(max(0.0, float(np.linalg.eigvalsh(covariance[:2, :2])[-1])))
        T_dead_base = self.dead_reckoning_at(stamp_ns)
        assert submaps.growing is not None
        if submaps.growing.should_close(stamp_ns, sigma_m, self.velocity_silence_s(stamp_ns)):
            issued += submaps.close(covariance)
            self._go_on(stamp_ns, T_submap_base, covariance)
            T_submap_base = SE2()
        if sweep is None:
            submaps.growing.add(detections, T_submap_base, T_base_sonar, T_dead_base)
        else:
            submaps.growing.add_sweep(sweep, T_submap_base, T_dead_base)
        return issued

    def _close_resumed(self, stamp_ns: int) -> list[Submap]:
        """Of a mapper that was resumed, at its first ping."""
        self._is_resumed, submaps = False, self._submaps
        issued: list[Submap] = []
        if submaps.growing is not None:
            if submaps.growing.num_pings < self._config.submap.min_pings:
                return issued
            last_ns = int(submaps.growing.stamps_ns[-1])
            issued = submaps.close(self._navigation.relative_at(last_ns)[1])
        self._go_on(stamp_ns, *self._navigation.relative_at(stamp_ns))
        return issued

    def _go_on(self, stamp_ns: int, T_submap_base: SE2, covariance: FloatArray) -> None:
        """Open the next submap where the vehicle is in the one before."""
        self._submaps.go_on(T_submap_base, covariance)
        self._keys.rebase(T_submap_base.inverse())
        self._navigation.clone(stamp_ns)
