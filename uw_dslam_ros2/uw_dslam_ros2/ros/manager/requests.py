"""What a queue wants registered, carried to the servers, and their answers back."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Protocol

from rclpy.node import Node
from uw_dslam_msgs.srv import RegisterMaps

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.merging import MapQueue, MatchRequest, StartPoses
from uw_dslam_ros2.core.merging.graph.answers import QueryKey
from uw_dslam_ros2.core.registration.result import PriorWindow, RegistrationResult, Verdict
from uw_dslam_ros2.core.submap import SubmapId
from uw_dslam_ros2.ros.convert.core_types import occupancy_to_msg, submap_frame_id
from uw_dslam_ros2.ros.convert.registration import options_to_msg, registration_from_msg
from uw_dslam_ros2.ros.manager.registration_clients import RegistrationClients
from uw_dslam_ros2.ros.manager.shared_answers import SharedAnswers
from uw_dslam_ros2.ros.plumbing.frames import WARNING_PERIOD_S
from uw_dslam_ros2.ros.plumbing.node_settings import MapQueueManagerConfig

__all__ = ["QueueRequests"]

_SEARCH_SHARE = 0.8
"""Of the time after which a request counts as lost, what a search may take."""


class _Owner(Protocol):
    @property
    def queue(self) -> MapQueue: ...

    def changed(self, message: str) -> None: ...

    def complain(self, text: str) -> None: ...


class QueueRequests:
    """Asks servers what a queue wants to know; all methods belong to one thread.

    Parameters
    ----------
    node
        Whose clients they are.
    owner
        Has the queue, and is told when an answer has changed it.
    config
        Which servers, how many requests, how long to wait.
    post
        Hands a function to the thread that owns this object.
    """

    def __init__(
        self,
        node: Node,
        owner: _Owner,
        config: MapQueueManagerConfig,
        post: Callable[[Callable[[], None]], None],
    ) -> None:
        self._node, self._owner = node, owner
        self._start_poses = StartPoses.of_texts(
            config.start_poses, config.start_error_m, config.start_error_rad
        )
        self._timeout_s = config.request_timeout_s
        self._asked: dict[int, MatchRequest] = {}
        self.counts: Counter[str] = Counter()
        """Answers by verdict, and requests that were asked again; for the diagnostics."""
        self._servers = RegistrationClients(
            node, config.servers, config.requests_per_server, config.request_timeout_s, post
        )
        self._shared = SharedAnswers(node, config.link, post, self._correct, owner.complain)

    def set_limits(self, config: MapQueueManagerConfig) -> None:
        """How many requests a server gets, and how long is waited, from the next one on."""
        self._timeout_s = config.request_timeout_s
        self._servers.set_limits(config.requests_per_server, config.request_timeout_s)

    @property
    def num_in_flight(self) -> int:
        """Requests that are not answered yet."""
        return len(self._asked)

    @property
    def num_servers(self) -> int:
        """Servers on the graph now."""
        return self._servers.num_ready

    def discover(self) -> None:
        """Look for new servers."""
        self._servers.discover()

    def forget_all(self) -> None:
        """Give up all that was asked: the queue is another one now."""
        self._servers.forget_all()
        self._asked.clear()

    def note_change(self) -> None:
        """The queue may have other questions than before."""
        self._shared.note_change()

    def look(self) -> None:
        """Ask again what was lost, and ask what there are servers for."""
        for request_id, reason in self._servers.take_lost():
            self._ask_again(request_id, reason)
        self._tell_settled()
        # What others have answered needs no server.
        num_free = self._servers.num_free() or self._shared.num_worth_a_look()
        if num_free > 0:
            for request in self._owner.queue.next_requests(num_free):
                self._ask(request)

    def _tell_settled(self) -> None:
        """Tell the others the answers that the map rests on, once nothing is open."""
        if self._asked or not self._shared.is_worth_telling:
            return
        queue = self._owner.queue
        answers = queue.settled_answers()
        if not answers:
            return
        for answer in answers:
            query = answer.query
            if not self._shared.knows(query.key):  # it is from a session
                ends = query.source.reference, query.target.reference
                self._shared.take_up(
                    answer, queue.maps_of(query), query.prior or self._start_prior(*ends)
                )
        self._shared.tell([answer.query.key for answer in answers])

    def _ask(self, request: MatchRequest) -> None:
        # A server's own time limit would let a busy machine refuse what a quiet one accepts; the
        # number of boxes decides, and this is for what never ends.
        max_seconds = _SEARCH_SHARE * self._timeout_s
        prior = self._prior(request)
        if (known := self._shared.find(request, prior)) is not None:
            self._take(request, known)
            return
        msg = RegisterMaps.Request(options=options_to_msg(prior, max_seconds))
        frames = (
            submap_frame_id(request.source_reference),
            submap_frame_id(request.target_reference),
        )
        msg.source = occupancy_to_msg(request.source, frames[0], 0)
        msg.target = occupancy_to_msg(request.target, frames[1], 0)
        if self._servers.ask(request.request_id, msg, self._on_answer):
            self._asked[request.request_id] = request
        else:
            self._owner.queue.cancel_request(request.request_id)

    def _prior(self, request: MatchRequest) -> PriorWindow | None:
        ends = request.source_reference, request.target_reference
        return request.prior or self._start_prior(*ends)

    def _start_prior(self, source: SubmapId, target: SubmapId) -> PriorWindow | None:
        """What the vehicles' start poses say of the maps of two submaps."""
        ends = source, target
        places = [(i.vehicle_id, self._owner.queue.T_odom_submap(i)) for i in ends]
        return self._start_poses.window(*places[0], *places[1])

    def _on_answer(self, request_id: int, response: RegisterMaps.Response) -> None:
        request = self._asked.get(request_id)
        if request is None:
            return
        if response.result == RegisterMaps.Response.BUSY:
            self._ask_again(request_id, "the server is busy")
            return
        del self._asked[request_id]
        if response.result == RegisterMaps.Response.DONE:
            try:
                result = registration_from_msg(response.registration)
                result = self._shared.settle(request, self._prior(request), result)
            except InvalidInputError as error:
                result = _unanswered(f"unusable answer: {error}")
        else:
            result = _unanswered(f"the server could not answer: {response.message}")
        self._take(request, result)

    def _take(self, request: MatchRequest, result: RegistrationResult) -> None:
        self.counts[f"num_{result.verdict.name.lower()}"] += 1
        self._owner.queue.add_result(request.request_id, result)
        pair = f"{_names(request.source_ids)} to {_names(request.target_ids)}"
        message = f"{pair}: {result.verdict.name}: {result.reason}"
        self._owner.changed(message)
        self._node.get_logger().info(self._owner.queue.in_words(message))

    def _correct(self, key: QueryKey, result: RegistrationResult) -> None:
        """Use the answer that all use, not the own one."""
        self._owner.queue.correct_answer(key, result)
        self._owner.changed("another vehicle's answer has replaced an own one")

    def _ask_again(self, request_id: int, reason: str) -> None:
        self._asked.pop(request_id, None)
        self._owner.queue.cancel_request(request_id)
        self.counts["num_asked_again"] += 1
        self._node.get_logger().warning(
            f"registration {request_id} is asked again: {reason}",
            throttle_duration_sec=WARNING_PERIOD_S,
        )


def _unanswered(reason: str) -> RegistrationResult:
    return RegistrationResult.refused(Verdict.BUDGET_EXHAUSTED, reason)


def _names(submap_ids: Sequence[SubmapId]) -> str:
    first = str(submap_ids[0])
    return first if len(submap_ids) == 1 else f"{first} and {len(submap_ids) - 1} more"
