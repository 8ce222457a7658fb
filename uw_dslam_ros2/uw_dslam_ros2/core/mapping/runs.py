"""A vehicle's mapping as a row of runs: where dead reckoning would be blind a new one begins."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.mapping.config import VehicleMapperConfig
from uw_dslam_ros2.core.mapping.mapper_state import HeldSubmaps, MapperState
from uw_dslam_ros2.core.mapping.vehicle_mapper import MapperWatch, VehicleMapper
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap

__all__ = ["RunBreak", "VehicleRuns"]

_DOUBT_S = 3.0
"""Without a heading for so long a ping is not mapped: it might be drawn anywhere around."""
_DOUBT_PERIODS = 5.0
_AT_REST_M_S = 0.1
"""Slower than that, a vehicle that says no more how fast it is is taken to stay where it is."""
_FAR_M = 4.0
"""Two windows of the scan matcher: what went no farther unseen finds back by its echoes."""


@dataclass(frozen=True, slots=True)
class RunBreak:
    """Why a run ended, and when the next one began."""

    role: str
    """What was missing: "imu" or "velocity"; "" for a clock that jumped."""
    start_ns: int
    end_ns: int

    @property
    def seconds(self) -> float:
        """How long it was missing."""
        return (self.end_ns - self.start_ns) * 1e-9


@dataclass(slots=True)
class _Stream:
    """When a kind of navigation was heard: newest and first time, and how often."""

    newest_ns: int
    first_ns: int
    num: int = 1

    @property
    def period_s(self) -> float:
        return (self.newest_ns - self.first_ns) * 1e-9 / max(1, self.num - 1)


class VehicleRuns:
    """Gives each run a `VehicleMapper` of its own.

    A heading that is missing for long, or the velocity of a vehicle that may have come far
    meanwhile, leaves it at a place that nobody knows: what comes after is a new run, which
    registration may join to what was before. Pings without a heading are left out meanwhile.

    Parameters
    ----------
    config
        Of the mappers.
    vehicle_id
        Whose.
    next_run_id
        Gives each run its number, see `core.submap.Track`.
    watch
        As of a `VehicleMapper`.
    """

    def __init__(
        self,
        config: VehicleMapperConfig,
        vehicle_id: str,
        next_run_id: Callable[[], int],
        watch: MapperWatch | None = None,
    ) -> None:
        self._config, self._vehicle_id, self._next_run_id = config, vehicle_id, next_run_id
        self._watch = watch
        self.mapper = self._new_mapper()
        self.breaks: list[RunBreak] = []
        self.num_pings_blind = 0
        self._heard: dict[str, _Stream] = {}
        self._speed_m_s = 0.0
        self._before: list[tuple[NDArray[np.int64], NDArray[np.float64]]] = []
        self._earlier: dict[int, VehicleMapper] = {}
        self._counts: list[dict[str, float | int | str]] = []

    def note_heading(self, stamp_ns: int) -> list[Submap]:
        """Yaw or yaw rate of this time is about to come; see `begin` for what is returned."""
        return self._note("imu", stamp_ns)

    def note_velocity(self, stamp_ns: int, speed_m_s: float) -> list[Submap]:
        """A velocity of this time is about to come; see `begin` for what is returned."""
        issued = self._note("velocity", stamp_ns)
        self._speed_m_s = speed_m_s
        return issued

    def is_blind(self, stamp_ns: int) -> bool:
        """Whether a ping of this time is to be left out, for want of a heading; counts it."""
        heading = self._heard.get("imu")
        if heading is None or heading.num < 2:
            return False
        doubt_s = max(_DOUBT_S, _DOUBT_PERIODS * heading.period_s)
        is_blind = (stamp_ns - heading.newest_ns) * 1e-9 > doubt_s
        self.num_pings_blind += is_blind
        return is_blind

    def begin(self, reason: RunBreak) -> list[Submap]:
        """End the run, and begin the next one; returns what the old one still had to give."""
        self._heard.clear()
        if not self.mapper.num_pings:
            self.mapper = self._new_mapper()  # nothing was mapped yet: it is no run
            return []
        issued = self.mapper.finish()
        self._before.append(self.trajectory_of_run())
        self._counts.append(self.mapper.diagnostics())
        self._earlier[self.mapper.run_id] = self.mapper
        self.breaks.append(reason)
        self.mapper = self._new_mapper()
        return issued

    def resume(self, state: MapperState, held: HeldSubmaps) -> None:
        """Go on with a run of an earlier process, before anything has come; see the mapper."""
        mapper = VehicleMapper(self._config, self._vehicle_id, state.run_id, self._watch)
        mapper.resume(state, held)
        self.mapper = mapper

    def issued(self, run_id: int, sequence: int) -> Submap | None:
        """A submap of any run as it was given away last; 0: of the run that goes on."""
        if run_id in (0, self.mapper.run_id):
            return self.mapper.issued(sequence)
        earlier = self._earlier.get(run_id)
        return None if earlier is None else earlier.issued(sequence)

    def mappers(self) -> list[VehicleMapper]:
        """Of all runs, in their order."""
        return [*self._earlier.values(), self.mapper]

    def finish(self) -> list[Submap]:
        """End the last run; no ping may follow."""
        return self.mapper.finish()

    def diagnostics(self) -> dict[str, float | int | str]:
        """Of the mapper (see there), with the counters of earlier runs added."""
        values = self.mapper.diagnostics()
        for earlier in self._counts:
            for name, value in earlier.items():
                if name.startswith("num_") and not name.endswith("_last"):
                    values[name] = int(values.get(name, 0)) + int(value)
        return {
            **values,
            "num_runs": 1 + len(self.breaks),
            "num_pings_blind": self.num_pings_blind,
        }

    def trajectory_of_run(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Of this run: stamps (K,) [ns] and poses (K, 3) [x, y, yaw] in its odom frame."""
        return self.mapper.trajectory()

    def trajectory(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Of all runs, each laid where the one before ended: for lengths of ways, not for maps."""
        stamps, poses = [np.empty(0, np.int64)], [np.empty((0, 3))]
        T_first_odom = SE2()
        for run_stamps, run_poses in (*self._before, self.trajectory_of_run()):
            if not len(run_poses):
                continue
            if len(poses[-1]):
                T_first_odom = (
                    SE2.from_array(poses[-1][-1]) @ SE2.from_array(run_poses[0]).inverse()
                )
            moved = np.column_stack(
                [T_first_odom.apply(run_poses[:, :2]), run_poses[:, 2] + T_first_odom.yaw]
            )
            stamps.append(run_stamps)
            poses.append(moved)
        return np.concatenate(stamps), np.vstack(poses)

    def _new_mapper(self) -> VehicleMapper:
        return VehicleMapper(self._config, self._vehicle_id, self._next_run_id(), self._watch)

    def _note(self, role: str, stamp_ns: int) -> list[Submap]:
        held = self._heard.get(role)
        if held is None:
            self._heard[role] = _Stream(stamp_ns, stamp_ns)
            return []
        silence_s = (stamp_ns - held.newest_ns) * 1e-9
        longest_s = max(self._config.max_gap_s, _DOUBT_PERIODS * held.period_s)
        is_lost = role == "imu" or self._may_be_far(silence_s)
        if is_lost and silence_s > longest_s:
            issued = self.begin(RunBreak(role, held.newest_ns, stamp_ns))
            self._heard[role] = _Stream(stamp_ns, stamp_ns)
            return issued
        held.newest_ns, held.num = max(held.newest_ns, stamp_ns), held.num + 1
        return []

    def _may_be_far(self, silence_s: float) -> bool:
        """Whether it may be far from where its last velocity leads.

        It is not where that was slow, nor where the vehicle is known to change its velocity
        little.
        """
        if self._speed_m_s <= _AT_REST_M_S:
            return False
        # A random walk of the velocity, summed: three standard deviations of the place.
        walk_m_s = self._config.navigation.velocity_walk_m_s
        error_m = 3.0 * walk_m_s * silence_s * math.sqrt(silence_s / 3.0)
        return min(self._speed_m_s * silence_s, error_m) > _FAR_M
