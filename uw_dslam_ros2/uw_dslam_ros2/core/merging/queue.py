"""The map queue: submaps in, questions out, answers in, one global map out."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging.answers import Answer, Query, QueryKey
from uw_dslam_ros2.core.merging.components import LoopError, loop_errors
from uw_dslam_ros2.core.merging.config import LOG_ODDS_MAX, MapQueueConfig
from uw_dslam_ros2.core.merging.global_map import GlobalMap, pinned_lattice
from uw_dslam_ros2.core.merging.growing import make_growing_plan
from uw_dslam_ros2.core.merging.library import Library, Memory
from uw_dslam_ros2.core.merging.pairwise import make_pairwise_plan
from uw_dslam_ros2.core.merging.plan import Plan, make_plan
from uw_dslam_ros2.core.merging.records import constraints_of, records_of
from uw_dslam_ros2.core.merging.state import QueueState
from uw_dslam_ros2.core.merging.submap_groups import StoredSubmap
from uw_dslam_ros2.core.merging.types import (
    Constraint,
    MapProvenance,
    MatchRequest,
    SubmapRecord,
)
from uw_dslam_ros2.core.mosaic import Window
from uw_dslam_ros2.core.registration.result import RegistrationResult
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap, SubmapId, Track

__all__ = ["MapQueue"]


class MapQueue:
    """Collects the submaps of all vehicles and says which maps to register next.

    Sans-IO: the caller carries the requests to registration servers and brings back the results,
    in any order and at any time. The global frame "map" is the frame of the first submap that
    came in (or of the first one of ``config.anchor_vehicle``); that submap's cells are the lattice
    of the global map. Where the first vehicle stays alone while others are joined, the frame goes
    over to the largest group as soon as no question is left. Once vehicles are joined in it, it
    never moves.
    """

    def __init__(self, config: MapQueueConfig | None = None) -> None:
        self._config = config or MapQueueConfig()
        self._submaps: dict[SubmapId, StoredSubmap] = {}
        self._withdrawn: set[SubmapId] = set()
        self._anchor: SubmapId | None = None
        self._is_pinned = False  # for good: named by the settings, or vehicles are joined in it
        self._tracks: list[Track] = []
        self._answers: dict[QueryKey, Answer] = {}
        self._standing: frozenset[QueryKey] = frozenset()
        self._memory: Memory = {}
        self._library: Library | None = None
        self._in_flight: dict[int, Query] = {}
        self._next_request_id = 1
        self._plan_cache: Plan | None = None
        self._lattice: GridSpec | None = None
        self._global_map: GlobalMap | None = None
        self._is_growing = False
        self._is_drawn = False

    def add_submap(self, submap: Submap) -> bool:
        """Take a submap; a higher revision replaces, an equal or lower one changes nothing.

        Returns
        -------
        bool
            Whether it was new.

        Raises
        ------
        InvalidInputError
            Naming the submap, the field, its value and what was expected; also for two different
            submaps of one name and revision, which is what two vehicles of the same name send.
        """
        stored = StoredSubmap.of(submap, self._config.max_submap_cells)
        held = self._submaps.get(submap.submap_id)
        if held is not None and submap.revision <= held.submap.revision:
            is_other = held.fingerprint != stored.fingerprint
            if submap.revision == held.submap.revision and is_other:
                raise InvalidInputError(
                    f"submap {submap.submap_id} revision {submap.revision} "
                    "differs from the one received before: are there two vehicles of this name?"
                )
            return False
        self._submaps[submap.submap_id] = stored
        if submap.submap_id.track not in self._tracks:
            self._tracks.append(submap.submap_id.track)
        wanted = self._config.anchor_vehicle
        if self._anchor is None and wanted in ("", submap.vehicle_id):
            self._pin(submap.submap_id)
            self._is_pinned = bool(wanted)
        self._change()
        return True

    def next_requests(self, max_requests: int) -> list[MatchRequest]:
        """Give up to so many registrations to ask for now, most useful first.

        Each stays in flight until `add_result` or `cancel_request`.
        """
        asked = {query.key for query in self._in_flight.values()}
        requests: list[MatchRequest] = []
        for query in self._plan().wanted:
            if len(requests) >= max_requests:
                break
            if query.key not in asked:
                asked.add(query.key)
                requests.append(self._request(query))
        return requests

    def add_result(self, request_id: int, result: RegistrationResult) -> None:
        """Take the answer to a request; one that is not in flight changes nothing."""
        query = self._in_flight.pop(request_id, None)
        if query is None:
            return
        self._answers[query.key] = Answer.of(query, result)
        self._change()

    def cancel_request(self, request_id: int) -> None:
        """Forget that a request was asked (its server died); it will be asked again."""
        self._in_flight.pop(request_id, None)

    def forget_answers(self, vehicle_id: str) -> None:
        """Forget what was found about a vehicle's map: it is not any more what it was."""
        about = {
            key
            for key, answer in self._answers.items()
            if any(
                submap_id.vehicle_id == vehicle_id
                for group in (answer.query.source, answer.query.target)
                for submap_id in group.ids
            )
        }
        if about:
            self._answers = {k: a for k, a in self._answers.items() if k not in about}
            self._standing -= about
            self._change()

    @property
    def is_growing(self) -> bool:
        """Whether more submaps are expected soon; False at first.

        True: only what may change something now is asked, see `growing`. False: all that is left
        is asked, and what comes out depends on the submaps alone and not on their order.
        """
        return self._is_growing

    @is_growing.setter
    def is_growing(self, value: bool) -> None:
        if value != self._is_growing:
            self._is_growing = value
            self._change()

    @property
    def num_in_flight(self) -> int:
        """Requests asked and not answered yet."""
        return len(self._in_flight)

    @property
    def num_registrations(self) -> int:
        """Answers had so far."""
        return len(self._answers)

    def withdraw(self, submap_id: SubmapId) -> bool:
        """Take a submap out of the map and out of matching until `restore`, also when sent again.

        False if there is no such submap.
        """
        if submap_id not in self._submaps:
            return False
        if submap_id not in self._withdrawn:
            self._withdrawn.add(submap_id)
            self._change()
        return True

    def restore(self, submap_id: SubmapId) -> bool:
        """Undo `withdraw`. False if there is no such submap."""
        if submap_id not in self._submaps:
            return False
        if submap_id in self._withdrawn:
            self._withdrawn.discard(submap_id)
            self._change()
        return True

    def submaps(self) -> list[SubmapRecord]:
        """All submaps, by vehicle, run and sequence."""
        answers = list(self._answers.values())
        return records_of(self._submaps, self._withdrawn, self._plan(), self._anchor, answers)

    def missing(self, max_per_track: int = 100) -> dict[Track, list[int]]:
        """Sequence numbers of each run that never came, though later ones did; the first few."""
        held: dict[Track, list[int]] = {}
        for submap_id in sorted(self._submaps):
            held.setdefault(submap_id.track, []).append(submap_id.sequence)
        found: dict[Track, list[int]] = {}
        for track, sequences in held.items():
            gaps = (
                number
                for before, after in itertools.pairwise([-1, *sequences])
                for number in range(before + 1, after)
            )
            if first := list(itertools.islice(gaps, max_per_track)):
                found[track] = first
        return found

    def answers(self) -> list[tuple[Answer, bool]]:
        """All answers, by target and source, and whether each holds in the pose graph."""
        used = {constraint.key for constraint in self._plan().constraints if constraint.is_inlier}
        by_question = sorted(
            self._answers.values(),
            key=lambda a: (a.query.target.ids, a.query.source.ids, a.query.key),
        )
        return [(answer, answer.query.key in used) for answer in by_question]

    def constraints(self) -> list[Constraint]:
        """All edges of the pose graph with what is left of them after optimisation."""
        return constraints_of(self._plan())

    def loops(self) -> list[LoopError]:
        """Cycles of three and more submaps in the graph, and by how much each fails to close."""
        plan = self._plan()
        return loop_errors(
            plan.odometry, [constraint for constraint in plan.constraints if constraint.is_inlier]
        )

    def global_map(self) -> OccupancyMap | None:
        """The fused map in frame "map"; None before there is any evidence."""
        drawn = self._drawn()
        return None if drawn is None else drawn.occupancy()

    def provenance(self) -> MapProvenance | None:
        """Who saw what in the global map, and where they disagree; None without evidence."""
        drawn = self._drawn()
        return None if drawn is None else drawn.provenance()

    def changed_window(self) -> tuple[GridSpec, Window] | None:
        """What changed in the global map since the last call, or None.

        The rectangle's place as a grid, and the rectangle in cells of the pinned lattice.
        """
        drawn = self._drawn()
        return None if drawn is None else drawn.take_changed()

    def T_odom_submap(self, submap_id: SubmapId) -> SE2:  # noqa: N802 (notation of motions)
        """Pose of a submap that is held in its run's odom frame, by its newest revision."""
        return self._submaps[submap_id].submap.T_odom_submap

    def T_map_odom(self, vehicle_id: str) -> SE2 | None:  # noqa: N802 (notation of motions)
        """Place of the odom frame of a vehicle's newest run; None unless that run is merged."""
        merged = self._merged()
        track = Track(vehicle_id, self.newest_run(vehicle_id))
        newest = max((i for i in merged if i.track == track), default=None)
        if newest is None:
            return None
        return merged[newest] @ self._submaps[newest].submap.T_odom_submap.inverse()

    def newest_run(self, vehicle_id: str) -> int:
        """Run of a vehicle that was heard of last; 0 without any."""
        runs = [track.run_id for track in self._tracks if track.vehicle_id == vehicle_id]
        return runs[-1] if runs else 0

    def trajectories(self) -> dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]]:
        """Of each vehicle: stamps (K,) [ns] and poses (K, 3) [x, y, yaw] in "map".

        All its runs that are merged are in it.
        """
        merged = self._merged()
        parts: dict[str, list[tuple[NDArray[np.int64], NDArray[np.float64]]]] = {}
        for submap_id in sorted(merged):
            submap = self._submaps[submap_id].submap
            if len(submap.trajectory):
                poses = _moved(merged[submap_id], submap.trajectory)
                parts.setdefault(submap_id.vehicle_id, []).append(
                    (submap.trajectory_stamp_ns, poses)
                )
        return {vehicle: _by_time(pieces) for vehicle, pieces in parts.items()}

    def to_state(self) -> QueueState:
        """Everything that has to be kept to go on later; see `from_state`."""
        return QueueState(
            tuple(self._submaps[i].submap for i in sorted(self._submaps)),
            frozenset(self._withdrawn),
            tuple(self._answers[key] for key in sorted(self._answers)),
            self._anchor,
            self._lattice,
            tuple(self._tracks),
            self._next_request_id,
            self._standing,
            self._is_pinned,
        )

    @classmethod
    def from_state(cls, state: QueueState, config: MapQueueConfig | None = None) -> MapQueue:
        """Go on from a state: same map, same questions; what was in flight is asked again."""
        queue = cls(config)
        for submap in state.submaps:
            stored = StoredSubmap.of(submap, queue._config.max_submap_cells)
            queue._submaps[submap.submap_id] = stored
        queue._withdrawn = set(state.withdrawn)
        queue._answers = {answer.query.key: answer for answer in state.answers}
        queue._standing = frozenset(state.standing)
        queue._anchor, queue._lattice = state.anchor, state.lattice
        queue._is_pinned = state.is_pinned
        queue._tracks = list(state.tracks)
        queue._next_request_id = state.next_request_id
        return queue

    def _merged(self) -> dict[SubmapId, SE2]:
        return self._plan().components[0] if self._anchor is not None else {}

    def _current_library(self) -> Library:
        if self._library is None:
            self._library = Library(
                self._submaps,
                frozenset(self._withdrawn),
                self._memory,
            )
        return self._library

    def _change(self) -> None:
        self._library = None
        self._plan_cache = None
        self._is_drawn = False

    def _plan(self) -> Plan:
        if self._plan_cache is None:
            if not self._submaps:
                return Plan([], [], [], [])
            anchor = self._anchor or min(self._submaps)
            library = self._current_library()
            if self._config.mode == "pairwise":
                plan = make_pairwise_plan(
                    library,
                    self._tracks,
                    self._answers,
                    anchor,
                    is_growing=self._is_growing,
                )
            else:
                make = make_growing_plan if self._is_growing else make_plan
                plan = make(library, self._answers, self._standing, anchor, self._config)
            self._standing = frozenset(
                constraint.key for constraint in plan.constraints if constraint.is_inlier
            )
            self._plan_cache = plan
            if self._pin_for_good(plan):
                self._plan_cache = None
                return self._plan()
        return self._plan_cache

    def _pin_for_good(self, plan: Plan) -> bool:
        """Pin the frame where vehicles are joined, once nothing is open; True if that moves it."""
        if self._is_pinned or self._is_growing or plan.wanted or self._in_flight:
            return False
        joined = [part for part in plan.components if len({i.track for i in part}) > 1]
        if not joined:
            return False
        self._is_pinned = True
        if any(self._anchor in part for part in joined):
            return False
        largest = max(joined, key=lambda part: (len({i.track for i in part}), len(part)))
        self._pin(min(largest, key=lambda i: (self._tracks.index(i.track), i.sequence)))
        return True

    def _pin(self, submap_id: SubmapId) -> None:
        spec = self._submaps[submap_id].submap.grid.spec
        self._anchor = submap_id
        self._lattice = pinned_lattice(spec, self._config.resolution_m or spec.resolution_m)
        self._global_map = None
        self._is_drawn = False

    def _request(self, query: Query) -> MatchRequest:
        request_id = self._next_request_id
        self._next_request_id += 1
        self._in_flight[request_id] = query
        library = self._current_library()
        source, target = library.render(query.source), library.render(query.target)
        return MatchRequest(
            request_id,
            source,
            target,
            query.prior,
            query.source.ids,
            query.target.ids,
            query.source.reference,
            query.target.reference,
        )

    def _drawn(self) -> GlobalMap | None:
        """The global map, up to date: draws only what is new or has moved."""
        merged = self._merged()  # may move the frame, hence first
        if self._lattice is None:
            return None
        if self._global_map is None:
            self._global_map = GlobalMap(self._lattice, LOG_ODDS_MAX)
        if not self._is_drawn:
            shown = {i: T for i, T in merged.items() if i not in self._withdrawn}
            self._global_map.draw(self._submaps, shown)
            self._is_drawn = True
        return self._global_map


def _moved(motion: SE2, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    moved = np.empty_like(poses)
    moved[:, :2] = motion.apply(poses[:, :2])
    moved[:, 2] = (poses[:, 2] + motion.yaw + math.pi) % (2.0 * math.pi) - math.pi
    return moved


def _by_time(
    pieces: Iterable[tuple[NDArray[np.int64], NDArray[np.float64]]],
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    stamps, poses = (np.concatenate(part) for part in zip(*pieces, strict=True))
    # A ping at the seam belongs to two submaps: the later one's word counts.
    order = np.argsort(stamps, kind="stable")
    stamps, poses = stamps[order], poses[order]
    is_last = np.append(np.diff(stamps) > 0, True)
    return stamps[is_last], poses[is_last]
