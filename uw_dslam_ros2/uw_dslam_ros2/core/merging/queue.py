"""The map queue: submaps in, questions out, answers in, one global map out."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging.asking.growing import make_growing_plan
from uw_dslam_ros2.core.merging.asking.pairwise import make_pairwise_plan
from uw_dslam_ros2.core.merging.asking.plan import Plan, make_plan
from uw_dslam_ros2.core.merging.checks.soundness import contradicting_track, implausible_submaps
from uw_dslam_ros2.core.merging.config import LOG_ODDS_MAX, MapQueueConfig
from uw_dslam_ros2.core.merging.global_map import GlobalMap, pinned_lattice, undrawable
from uw_dslam_ros2.core.merging.graph.answers import Answer, Query, QueryKey
from uw_dslam_ros2.core.merging.graph.components import Component, LoopError, loop_errors
from uw_dslam_ros2.core.merging.graph.library import Library, Memory
from uw_dslam_ros2.core.merging.graph.submap_groups import StoredSubmap
from uw_dslam_ros2.core.merging.records import constraints_of, records_of
from uw_dslam_ros2.core.merging.state import QueueState
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

_MAX_REVISION_LEAP = 10_000
"""A vehicle that settles its graph after each submap for hours does not come so far."""


class MapQueue:
    """Collects the submaps of all vehicles and says which maps to register next.

    Sans-IO: the caller carries the requests to registration servers and brings back the results,
    in any order and at any time. The global frame "map" is that of a vehicle's first submap, whose
    cells are the lattice of the global map: of ``config.anchor_vehicle``, else of the vehicle
    whose name comes first; among several groups of joined vehicles, of the largest group. So it
    does not depend on the order of arrival. It moves only while no vehicles are joined in it.

    What cannot be right is set aside, see `soundness`.
    """

    def __init__(self, config: MapQueueConfig | None = None) -> None:
        self._config = config or MapQueueConfig()
        self._submaps: dict[SubmapId, StoredSubmap] = {}
        self._withdrawn: set[SubmapId] = set()
        self._anchor: SubmapId | None = None
        self._is_pinned = False  # for good: vehicles are joined in it
        self._aside: dict[SubmapId, str] = {}
        self._implausible: dict[SubmapId, str] = {}
        self._contradicting: list[Track] = []
        self._notices: list[str] = []
        self._undrawn: tuple[Plan | None, dict[SubmapId, str]] = (None, {})
        self._tracks: list[Track] = []
        self._lacking: set[SubmapId] = set()
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
        leap = submap.revision - (0 if held is None else held.submap.revision)
        if leap > _MAX_REVISION_LEAP:
            raise InvalidInputError(
                f"submap {submap.submap_id} leaps to revision {submap.revision}, expected at most "
                f"{_MAX_REVISION_LEAP} more than were received before"
            )
        self._submaps[submap.submap_id] = stored
        self._lacking.discard(submap.submap_id)
        if submap.submap_id.track not in self._tracks:
            self._tracks.append(submap.submap_id.track)
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
        plan = self._plan()
        return records_of(
            self._submaps,
            self._withdrawn,
            plan,
            self._anchor,
            answers,
            self._aside,
            self._undrawable(),
        )

    def take_notices(self) -> list[str]:
        """What a person should know of, since the last call: frames that moved."""
        self._plan()
        notices, self._notices = self._notices, []
        return notices

    def missing(self, max_per_track: int = 100) -> dict[Track, list[int]]:
        """Sequence numbers of each run that never came, though they were heard of; the first few.

        That is: later ones came, or somebody spoke of them, see `note_missing`.
        """
        held: dict[Track, list[int]] = {}
        lacking = [i for i in self._lacking if i not in self._submaps]
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
        for submap_id in lacking:
            numbers = found.setdefault(submap_id.track, [])
            if submap_id.sequence not in numbers and len(numbers) < max_per_track:
                numbers.append(submap_id.sequence)
        return found

    def note_missing(self, submap_id: SubmapId) -> None:
        """There is such a submap, and it did not come."""
        self._lacking.add(submap_id)

    def submap(self, submap_id: SubmapId) -> Submap | None:
        """A submap as it was last received; None if it never came."""
        held = self._submaps.get(submap_id)
        return None if held is None else held.submap

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
        components = self._plan().components
        return components[0] if components and self._anchor in components[0] else {}

    def _current_library(self) -> Library:
        if self._library is None:
            self._implausible = implausible_submaps(
                self._submaps, self._config.max_speed_m_s, self._memory
            )
            kept = {i: s for i, s in self._submaps.items() if i not in self._implausible}
            self._library = Library(kept, frozenset(self._withdrawn), self._memory)
        return self._library

    def _change(self) -> None:
        self._library = None
        self._plan_cache = None
        self._is_drawn = False

    def _plan(self) -> Plan:
        if self._plan_cache is None:
            if not self._submaps:
                return Plan([], [], [], [])
            library = self._current_library()
            if self._anchor is None or self._anchor not in library.submaps:
                self._move_frame(library, ())
            plan = self._sound_plan(library)
            self._standing = frozenset(
                constraint.key for constraint in plan.constraints if constraint.is_inlier
            )
            self._plan_cache = plan
            if self._settle_frame(plan):
                self._plan_cache = None
                return self._plan()
        return self._plan_cache

    def _sound_plan(self, library: Library) -> Plan:
        """A plan without the runs that others agree better without."""
        plan = self._plan_with(library)
        if not self._is_growing and not plan.wanted:
            self._contradicting = []
            whole, sound = plan, library
            while len(self._contradicting) < len(self._tracks) and not plan.wanted:
                track = contradicting_track(sound, plan.constraints, min(sound.submaps))
                if track is None:
                    break
                self._contradicting.append(track)
                sound = self._without(library, self._contradicting)
                plan = self._plan_with(sound)
            plan = dataclasses.replace(plan, wanted=[*whole.wanted, *plan.wanted])
        elif held := [track for track in self._contradicting if track in self._tracks]:
            # While questions are open, what was judged before goes on to hold.
            wanted = plan.wanted
            plan = self._plan_with(self._without(library, held))
            known = {query.key for query in wanted}
            wanted += [query for query in plan.wanted if query.key not in known]
            plan = dataclasses.replace(plan, wanted=wanted)
        self._aside = self._implausible | {
            i: _CONTRADICTS for i in library.submaps if i.track in self._contradicting
        }
        return plan

    def _without(self, library: Library, tracks: Sequence[Track]) -> Library:
        kept = {i: s for i, s in library.submaps.items() if i.track not in tracks}
        return Library(kept, frozenset(self._withdrawn), self._memory)

    def _plan_with(self, library: Library) -> Plan:
        anchor = self._anchor if self._anchor in library.submaps else min(library.submaps)
        assert anchor is not None
        if self._config.mode == "pairwise":
            tracks = [
                track for track in self._tracks if any(i.track == track for i in library.submaps)
            ]
            return make_pairwise_plan(
                library, tracks, self._answers, anchor, is_growing=self._is_growing
            )
        make = make_growing_plan if self._is_growing else make_plan
        return make(library, self._answers, self._standing, anchor, self._config)

    def _settle_frame(self, plan: Plan) -> bool:
        """Have the frame where the class says; True if that moves it."""
        placed = {i for part in plan.components for i in part}
        joined = [part for part in plan.components if len({i.track for i in part}) > 1]
        is_open = self._is_growing or bool(plan.wanted) or bool(self._in_flight)
        if self._anchor in placed:
            if self._is_pinned or any(self._anchor in part for part in joined):
                self._is_pinned |= not is_open
                return False
            if joined and is_open:
                return False  # what is joined now may come apart
        return self._move_frame(self._current_library(), joined)

    def _move_frame(self, library: Library, joined: Sequence[Component]) -> bool:
        """Pin the frame to the first submap of the run that has to hold it; True if it moves."""
        starts: dict[Track, SubmapId] = {}
        for submap_id in sorted(i for i in library.submaps if i not in self._aside):
            starts.setdefault(submap_id.track, submap_id)
        by_name = sorted(
            starts, key=lambda t: (t.vehicle_id, self._submaps[starts[t]].submap.stamp_ns, t)
        )
        wanted = self._config.anchor_vehicle
        if wanted:
            by_name = [track for track in by_name if track.vehicle_id == wanted]
        elif joined:
            rank = {track: index for index, track in enumerate(by_name)}

            def worth(part: Component) -> tuple[int, int, int]:
                tracks = {i.track for i in part}
                return len(tracks), len(part), -min(rank[track] for track in tracks)

            largest = {i.track for i in max(joined, key=worth)}
            by_name = [track for track in by_name if track in largest]
        if not by_name or starts[by_name[0]] == self._anchor:
            return False
        if self._anchor is not None:
            self._notices.append(
                f"the global frame is now that of {starts[by_name[0]]}; it was that of "
                f"{self._anchor}, whose group goes on in a frame of its own"
            )
        self._is_pinned = False
        self._pin(starts[by_name[0]])
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

    def _undrawable(self) -> dict[SubmapId, str]:
        merged = self._merged()
        if self._lattice is None:
            return {}
        if self._undrawn[0] is not self._plan_cache:
            self._undrawn = (
                self._plan_cache,
                undrawable(self._lattice, self._submaps, merged),
            )
        return self._undrawn[1]

    def _drawn(self) -> GlobalMap | None:
        """The global map, up to date: draws only what is new or has moved."""
        merged = self._merged()  # may move the frame, hence first
        if self._lattice is None:
            return None
        if self._global_map is None:
            self._global_map = GlobalMap(self._lattice, LOG_ODDS_MAX)
        if not self._is_drawn:
            left_out = self._withdrawn | self._undrawable().keys()
            shown = {i: T for i, T in merged.items() if i not in left_out}
            self._global_map.draw(self._submaps, shown)
            self._is_drawn = True
        return self._global_map


_CONTRADICTS = "set aside with its whole run, which contradicts the others' maps"


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
