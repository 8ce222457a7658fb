"""The map queue: submaps in, questions out, answers in, one global map out."""

from __future__ import annotations

from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging.asking.plan import Plan
from uw_dslam_ros2.core.merging.config import MapQueueConfig
from uw_dslam_ros2.core.merging.drawn.trajectories import Trajectory, trajectories_of
from uw_dslam_ros2.core.merging.graph.answers import Answer, Query, QueryKey
from uw_dslam_ros2.core.merging.graph.components import LoopError
from uw_dslam_ros2.core.merging.records import constraints_of, records_of
from uw_dslam_ros2.core.merging.state import QueueState
from uw_dslam_ros2.core.merging.steered_queue import SteeredQueue
from uw_dslam_ros2.core.merging.steering.decisions import DecisionLog
from uw_dslam_ros2.core.merging.types import (
    Constraint,
    MapProvenance,
    MatchRequest,
    SubmapRecord,
)
from uw_dslam_ros2.core.registration.result import RegistrationResult
from uw_dslam_ros2.core.run_names import RunNames
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sparse_cells import Window
from uw_dslam_ros2.core.submap import Submap, SubmapId, Track

__all__ = ["MapQueue"]


class MapQueue(SteeredQueue):
    """Collects the submaps of all vehicles and says which maps to register next.

    Sans-IO: the caller carries the requests to registration servers and brings back the results,
    in any order and at any time. Which submap's frame is the global one, "map", does not depend on
    the order of arrival, see `GlobalFrame`. What cannot be right is set aside, see `soundness`.
    """

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
        asked = self._requests.keys()
        requests: list[MatchRequest] = []
        still_open = self._requests.unanswered(self._answers, len(self._submaps))
        for query in still_open or self._plan().wanted:
            if len(requests) >= max_requests:
                break
            if query.key not in asked:
                asked.add(query.key)
                requests.append(self._requests.make(query, self._now.library()))
        return requests

    def add_result(self, request_id: int, result: RegistrationResult) -> None:
        """Take the answer to a request; one that is not in flight changes nothing."""
        query = self._requests.end(request_id)
        if query is not None:
            self._answers[query.key] = Answer.of(query, result)
            self._now.change()

    def correct_answer(self, key: QueryKey, result: RegistrationResult) -> None:
        """Put another answer in the place of one that was had; no such one: nothing changes."""
        held = self._answers.get(key)
        if held is not None:
            self._answers[key] = Answer.of(held.query, result)
            self._now.planning.forget()
            self._change_submaps()

    def cancel_request(self, request_id: int) -> None:
        """Forget that a request was asked (its server died); it will be asked again."""
        self._requests.end(request_id)

    def forget_answers(self, vehicle_id: str) -> None:
        """Forget what was found about a vehicle's map: it is not any more what it was."""
        about = [key for key, answer in self._answers.items() if answer.is_of(vehicle_id)]
        if about:
            for key in about:
                del self._answers[key]
            self._now.held -= set(about)
            self._change()

    @property
    def is_growing(self) -> bool:
        """Whether more submaps are expected soon; False at first.

        True: only what may change something now is asked, see `growing`. False: all that is left
        is asked, and what comes out depends on the submaps alone and not on their order.
        """
        return self._now.is_growing

    @is_growing.setter
    def is_growing(self, value: bool) -> None:
        if value != self._now.is_growing:
            self._now.is_growing = value
            self._change()

    @property
    def num_in_flight(self) -> int:
        """Requests asked and not answered yet."""
        return len(self._requests)

    @property
    def num_registrations(self) -> int:
        """Answers had so far."""
        return len(self._answers)

    def submaps(self) -> list[SubmapRecord]:
        """All submaps, by vehicle, run and sequence."""
        plan = self._plan()
        return list(self._now.once("submaps", lambda: self._records(plan)))

    def take_notices(self) -> list[str]:
        """What a person should know of, since the last call: frames that moved."""
        self._plan()
        return self._now.frame.take_notices()

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

    def in_words(self, text: str) -> str:
        """A sentence with runs counted, ``auv_1#2/0``, instead of by numbers drawn at random."""
        if "#" not in text:
            return text
        return RunNames(held.submap for held in self._submaps.values()).in_text(text)

    def answers(self) -> list[tuple[Answer, bool]]:
        """All answers, by target and source, and whether each holds in the pose graph."""
        used = {constraint.key for constraint in self._plan().constraints if constraint.is_inlier}
        by_question = sorted(
            self._answers.values(),
            key=lambda a: (a.query.target.ids, a.query.source.ids, a.query.key),
        )
        return [(answer, answer.query.key in used) for answer in by_question]

    @property
    def is_settled(self) -> bool:
        """Whether nothing more is expected, and nothing is left to ask."""
        return not (self.is_growing or self._plan().wanted or self.num_in_flight)

    def settled_answers(self) -> list[Answer]:
        """Answers that the map rests on; none until all is settled."""
        if not self.is_settled:
            return []
        return [self._answers[key] for key in sorted(self._plan().visited) if key in self._answers]

    def map_digest(self) -> bytes:
        """Of what the global map is drawn from (8 bytes): who has the same has the same map."""
        plan = self._plan()
        return self._now.once("digest", lambda: self._now.digest(plan))

    def _records(self, plan: Plan) -> list[SubmapRecord]:
        return records_of(
            self._submaps,
            self._decisions.withdrawn(self._submaps),
            plan,
            self._now.frame.anchor,
            list(self._answers.values()),
            self._now.planning.aside,
            self._now.undrawable(plan),
            [decision.edge() for decision in self._now.library().confirmed],
        )

    def maps_of(self, query: Query) -> tuple[OccupancyMap, OccupancyMap]:
        """Source and target of a question, whose submaps are held."""
        library = self._now.library()
        return library.render(query.source), library.render(query.target)

    def constraints(self) -> list[Constraint]:
        """All edges of the pose graph with what is left of them after optimisation."""
        plan = self._plan()
        confirmed = [decision.edge() for decision in self._now.library().confirmed]
        return list(self._now.once("constraints", lambda: constraints_of(plan, confirmed)))

    def loops(self) -> list[LoopError]:
        """Cycles of three and more submaps in the graph, and by how much each fails to close."""
        # networkx is large, and not every node that starts has something to solve.
        from uw_dslam_ros2.core.merging.graph.solving import loop_errors

        plan = self._plan()
        held = [constraint for constraint in plan.constraints if constraint.is_inlier]
        return list(self._now.once("loops", lambda: loop_errors(plan.odometry, held)))

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
            self._now.frame.anchor,
            self._now.frame.lattice,
            tuple(self._arrivals.tracks),
            self._requests.next_id,
            self._now.held,
            self._now.frame.is_pinned,
            self._now.fixes,
        )

    @classmethod
    def from_state(cls, state: QueueState, config: MapQueueConfig | None = None) -> MapQueue:
        """Go on from a state: same map, same questions; what was in flight is asked again."""
        queue = cls(config)
        for submap in state.submaps:
            queue._arrivals.put(submap)
        now, frame = queue._now, queue._now.frame
        now.decisions = DecisionLog(state.decisions)
        now.answers.update((answer.query.key, answer) for answer in state.answers)
        now.held, now.fixes = frozenset(state.standing), state.fixes
        frame.anchor, frame.lattice, frame.is_pinned = state.anchor, state.lattice, state.is_pinned
        queue._arrivals.tracks = list(state.tracks)
        queue._requests.next_id = state.next_request_id
        return queue
