"""The map queue: submaps in, questions out, answers in, one global map out."""

from __future__ import annotations

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging.arrivals import Arrivals
from uw_dslam_ros2.core.merging.asking.plan import Plan
from uw_dslam_ros2.core.merging.by_hand import remarks, stated_pose
from uw_dslam_ros2.core.merging.config import MapQueueConfig
from uw_dslam_ros2.core.merging.decisions import (
    Decision,
    DecisionKind,
    DecisionLog,
    DecisionRecord,
)
from uw_dslam_ros2.core.merging.drawing import Drawing
from uw_dslam_ros2.core.merging.frame import GlobalFrame
from uw_dslam_ros2.core.merging.georeference import Georeference
from uw_dslam_ros2.core.merging.global_map import GlobalMap
from uw_dslam_ros2.core.merging.graph.answers import Answer, Query, QueryKey
from uw_dslam_ros2.core.merging.graph.components import LoopError
from uw_dslam_ros2.core.merging.graph.library import Library
from uw_dslam_ros2.core.merging.graph.submap_groups import StoredSubmap
from uw_dslam_ros2.core.merging.planning import Planning
from uw_dslam_ros2.core.merging.records import constraints_of, records_of
from uw_dslam_ros2.core.merging.state import QueueState
from uw_dslam_ros2.core.merging.trajectories import Trajectory, trajectories_of
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

_REPLAN_SHARE = 0.125
"""Of a plan's questions: so many are answered before `next_requests` makes another plan."""
_NOT_PAIRWISE = DecisionKind.FORBID, DecisionKind.CONFIRM, DecisionKind.REGISTER
"""The paper's queue of maps takes nothing back, and has no graph to put a constraint into."""


class MapQueue:
    """Collects the submaps of all vehicles and says which maps to register next.

    Sans-IO: the caller carries the requests to registration servers and brings back the results,
    in any order and at any time. Which submap's frame is the global one, "map", does not depend on
    the order of arrival, see `GlobalFrame`. What cannot be right is set aside, see `soundness`.
    """

    def __init__(self, config: MapQueueConfig | None = None) -> None:
        self._config = config or MapQueueConfig()
        self._arrivals = Arrivals(self._config.max_submap_cells)
        self._submaps = self._arrivals.submaps
        self._decisions = DecisionLog()
        self._frame = GlobalFrame(self._config.anchor_vehicle, self._config.resolution_m)
        self._planning = Planning(self._config)
        self._drawing = Drawing()
        self._answers: dict[QueryKey, Answer] = {}
        self._standing: frozenset[QueryKey] = frozenset()
        self._library: Library | None = None
        self._questions: list[Query] = []  # of the last plan
        self._in_flight: dict[int, Query] = {}
        self._next_request_id = 1
        self._plan_cache: Plan | None = None
        self._is_growing = False

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
        is_new = self._arrivals.add(submap)
        if is_new:
            self._change_submaps()
        return is_new

    def next_requests(self, max_requests: int) -> list[MatchRequest]:
        """Give up to so many registrations to ask for now, most useful first.

        Each stays in flight until `add_result` or `cancel_request`.
        """
        asked = {query.key for query in self._in_flight.values()}
        requests: list[MatchRequest] = []
        for query in self._open_questions():
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
        self._plan_cache = None
        self._drawing.note_change()

    def correct_answer(self, key: QueryKey, result: RegistrationResult) -> None:
        """Put another answer in the place of one that was had; no such one: nothing changes."""
        held = self._answers.get(key)
        if held is not None:
            self._answers[key] = Answer.of(held.query, result)
            self._planning.forget()
            self._change_submaps()

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

    def decide(self, decision: Decision) -> Decision:
        """Write down what a person decided; what follows is worked out anew.

        Returns
        -------
        Decision
            With its number.

        Raises
        ------
        InvalidInputError
            If it names a submap that never came, or undoes what is not in force.
        """
        for name in ("source", "target"):
            end = getattr(decision, name)
            if end is not None and end not in self._submaps:
                raise InvalidInputError(f"decision.{name} is {end}, which was never received")
        if self._config.mode == "pairwise" and decision.kind in _NOT_PAIRWISE:
            raise InvalidInputError(
                f"decision.kind is {decision.kind.name}, expected another in mode pairwise"
            )
        before, self._decisions = self._decisions, self._decisions.added(decision)
        if before.pin is not None and self._decisions.pin is None:
            self._frame.release()
        if decision.kind is DecisionKind.UNDO:
            # What stood because of it would go on to stand.
            self._standing = frozenset()
        self._change_submaps()
        return list(self._decisions)[-1]

    def stated_pose(self, source: SubmapId, target: SubmapId) -> tuple[SE2, float, float]:
        """What the answers say of two submaps, for a person to confirm; see `by_hand`."""
        return stated_pose(self._answers.values(), source, target)

    def decisions(self) -> list[DecisionRecord]:
        """All decisions in order, and what became of each."""
        if not len(self._decisions):
            return []
        plan, found = self._plan(), self._georeference()
        doubts = self._planning.doubts
        library = self._current_library()
        told = remarks(self._decisions, library, plan, self._answers, found, doubts)
        return [
            DecisionRecord(d, self._decisions.undone_by(d.number) is None, told[d.number])
            for d in self._decisions
        ]

    @property
    def num_decisions(self) -> int:
        """Decisions so far, those included that are undone."""
        return len(self._decisions)

    def georeference(self) -> Georeference | None:
        """Where "map" lies on earth; None where the fixes do not say it."""
        found = self._georeference()
        return None if isinstance(found, str) else found

    def withdraw(self, submap_id: SubmapId, who: str = "", stamp_ns: int = 0) -> bool:
        """Take a submap out of the map and out of matching until `restore`, also when sent again.

        False if there is no such submap.
        """
        return self._switch(DecisionKind.WITHDRAW, submap_id, who, stamp_ns)

    def restore(self, submap_id: SubmapId, who: str = "", stamp_ns: int = 0) -> bool:
        """Undo `withdraw`. False if there is no such submap."""
        return self._switch(DecisionKind.RESTORE, submap_id, who, stamp_ns)

    def submaps(self) -> list[SubmapRecord]:
        """All submaps, by vehicle, run and sequence."""
        answers = list(self._answers.values())
        plan, library = self._plan(), self._current_library()
        return records_of(
            self._submaps,
            self._decisions.withdrawn(self._submaps),
            plan,
            self._frame.anchor,
            answers,
            self._planning.aside,
            self._undrawable(),
            [decision.edge() for decision in library.confirmed],
        )

    def take_notices(self) -> list[str]:
        """What a person should know of, since the last call: frames that moved."""
        self._plan()
        return self._frame.take_notices()

    def missing(self, max_per_track: int = 100) -> dict[Track, list[int]]:
        """Sequence numbers of each run that never came, though they were heard of; the first few.

        That is: later ones came, or somebody spoke of them, see `note_missing`.
        """
        return self._arrivals.missing(max_per_track)

    def note_missing(self, submap_id: SubmapId) -> None:
        """There is such a submap, and it did not come."""
        self._arrivals.note_missing(submap_id)

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
        plan = self._plan()
        return constraints_of(plan, [d.edge() for d in self._current_library().confirmed])

    def loops(self) -> list[LoopError]:
        """Cycles of three and more submaps in the graph, and by how much each fails to close."""
        # networkx is large, and not every node that starts has something to solve.
        from uw_dslam_ros2.core.merging.graph.solving import loop_errors

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
        return self._arrivals.newest_run(vehicle_id)

    def trajectories(self) -> dict[str, Trajectory]:
        """Of each vehicle in "map"; all its runs that are merged are in it."""
        return trajectories_of(self._submaps, self._merged())

    def to_state(self) -> QueueState:
        """Everything that has to be kept to go on later; see `from_state`."""
        return QueueState(
            tuple(self._submaps[i].submap for i in sorted(self._submaps)),
            tuple(self._decisions),
            tuple(self._answers[key] for key in sorted(self._answers)),
            self._frame.anchor,
            self._frame.lattice,
            tuple(self._arrivals.tracks),
            self._next_request_id,
            self._standing,
            self._frame.is_pinned,
        )

    @classmethod
    def from_state(cls, state: QueueState, config: MapQueueConfig | None = None) -> MapQueue:
        """Go on from a state: same map, same questions; what was in flight is asked again."""
        queue = cls(config)
        for submap in state.submaps:
            queue._arrivals.put(submap)
        queue._decisions = DecisionLog(state.decisions)
        queue._answers = {answer.query.key: answer for answer in state.answers}
        queue._standing = frozenset(state.standing)
        queue._frame.anchor, queue._frame.lattice = state.anchor, state.lattice
        queue._frame.is_pinned = state.is_pinned
        queue._arrivals.tracks = list(state.tracks)
        queue._next_request_id = state.next_request_id
        return queue

    def _switch(self, kind: DecisionKind, submap_id: SubmapId, who: str, stamp_ns: int) -> bool:
        if submap_id not in self._submaps:
            return False
        submap_id = SubmapId(*submap_id)
        is_out = bool(self._decisions.withdrawn([submap_id]))
        if is_out != (kind is DecisionKind.WITHDRAW):
            self.decide(Decision(kind, who, stamp_ns, submap_id))
        return True

    def _georeference(self) -> Georeference | str:
        return self._plan().georeference if self._merged() else "nothing is in the map"

    def _merged(self) -> dict[SubmapId, SE2]:
        components = self._plan().components
        return components[0] if components and self._frame.anchor in components[0] else {}

    def _current_library(self) -> Library:
        if self._library is None:
            self._library = self._planning.library(self._submaps, self._decisions)
        return self._library

    def _change_submaps(self) -> None:
        self._library = None
        self._change()

    def _change(self) -> None:
        self._plan_cache, self._questions = None, []
        self._drawing.note_change()

    def _open_questions(self) -> list[Query]:
        """Of the last plan while few of its questions are answered, else of a new one.

        A plan costs as much as many answers where there are many submaps, and a few answers change
        little of it.
        """
        still_open = [query for query in self._questions if query.key not in self._answers]
        num_answered = len(self._questions) - len(still_open)
        if still_open and num_answered <= _REPLAN_SHARE * len(self._questions):
            return still_open
        return self._plan().wanted

    def _plan(self) -> Plan:
        if self._plan_cache is None:
            if not self._submaps:
                return Plan([], [], [], [])
            library = self._current_library()
            pin = self._decisions.pin
            if self._frame.anchor not in library.submaps:
                self._note_frame(self._frame.choose(self._sound(library)))
            plan = self._planning.plan(
                library,
                self._arrivals.tracks,
                self._answers,
                self._standing,
                self._frame.anchor,
                self._decisions.fixes,
                is_growing=self._is_growing,
            )
            self._standing = frozenset(
                constraint.key for constraint in plan.constraints if constraint.is_inlier
            )
            self._plan_cache, self._questions = plan, plan.wanted
            is_open = self._is_growing or bool(plan.wanted) or bool(self._in_flight)
            sound = self._sound(library)
            if pin is not None and pin in sound:
                has_moved = self._frame.hold(pin, sound[pin])
            else:
                has_moved = self._frame.settle(plan, sound, is_open)
            if self._note_frame(has_moved):
                self._plan_cache = None
                return self._plan()
        return self._plan_cache

    def _sound(self, library: Library) -> dict[SubmapId, StoredSubmap]:
        """What the frame may be pinned to."""
        aside = self._planning.aside
        return {i: stored for i, stored in library.submaps.items() if i not in aside}

    def _note_frame(self, has_moved: bool) -> bool:
        if has_moved:
            self._drawing.restart()
        return has_moved

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
            query.key,
        )

    def _undrawable(self) -> dict[SubmapId, str]:
        merged = self._merged()  # may move the frame, hence first
        lattice = self._frame.lattice
        return {} if lattice is None else self._drawing.left_out(lattice, self._submaps, merged)

    def _drawn(self) -> GlobalMap | None:
        merged = self._merged()  # may move the frame, hence first
        if self._frame.lattice is None:
            return None
        withdrawn = self._decisions.withdrawn(merged)
        return self._drawing.drawn(self._frame.lattice, self._submaps, merged, withdrawn)
