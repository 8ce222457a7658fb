"""What vehicles can merge of what has crossed a link by some time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from uw_dslam_ros2.cli.studies._fleet_missions import FleetMission
from uw_dslam_ros2.cli.studies.merging import merged_largest, placing_error
from uw_dslam_ros2.core.link.coding.answers import question_digest
from uw_dslam_ros2.core.merging import MatchRequest
from uw_dslam_ros2.core.registration import register_grids
from uw_dslam_ros2.core.registration.result import RegistrationResult
from uw_dslam_ros2.core.submap import Submap, SubmapId
from uw_dslam_ros2.sim.missions.link_mission import LinkRun

__all__ = ["Joining", "Merged", "known_by"]


@dataclass(frozen=True, slots=True)
class Merged:
    """The largest group of vehicles that a merge joins."""

    num_vehicles: int
    rmse_m: float
    """Of its trajectories."""


@dataclass(slots=True, eq=False)
class Joining:
    """Merges of one mission; what was registered once is not registered again."""

    mission: FleetMission
    _answers: dict[bytes, RegistrationResult] = field(default_factory=dict)

    def merged(self, submaps: Sequence[Submap]) -> Merged:
        """Merge submaps of the mission, as they are."""
        known = FleetMission(self.mission.name, tuple(submaps), self.mission.truth)
        placing, _ = merged_largest(known, self._match)
        vehicles = {submap_id.vehicle_id for submap_id in placing}
        return Merged(len(vehicles), placing_error(known, placing))

    def first_join_s(self, played: LinkRun, vehicle: str) -> float | None:
        """When a vehicle could first join another one [s]; None if never.

        Found by bisection: who has joined with some submaps is taken to do so with more.
        """
        times = sorted({at_s for at_s, _ in played.known[vehicle]})
        low, high = 0, len(times)
        while low < high:
            middle = (low + high) // 2
            known = known_by(played, [vehicle], times[middle])
            if len({s.vehicle_id for s in known}) > 1 and self.merged(known).num_vehicles > 1:
                high = middle
            else:
                low = middle + 1
        return times[low] if low < len(times) else None

    def _match(self, request: MatchRequest) -> RegistrationResult:
        question = question_digest(request.source, request.target, request.prior)
        if question not in self._answers:
            found = register_grids(request.source, request.target, prior=request.prior)
            self._answers[question] = found
        return self._answers[question]


def known_by(played: LinkRun, vehicles: Sequence[str], at_s: float) -> list[Submap]:
    """Submaps that all of some vehicles had by a time, as whoever knew least of each had it."""
    common: dict[SubmapId, Submap] | None = None
    for vehicle in vehicles:
        newest = _newest(played.known[vehicle], at_s)
        if common is None:
            common = dict(newest)
            continue
        common = {
            submap_id: min(submap, newest[submap_id], key=lambda s: s.revision)
            for submap_id, submap in common.items()
            if submap_id in newest
        }
    return [] if common is None else [common[submap_id] for submap_id in sorted(common)]


def _newest(events: Sequence[tuple[float, Submap]], at_s: float) -> Mapping[SubmapId, Submap]:
    newest: dict[SubmapId, Submap] = {}
    for event_s, submap in events:
        held = newest.get(submap.submap_id)
        if event_s <= at_s and (held is None or submap.revision > held.revision):
            newest[submap.submap_id] = submap
    return newest
