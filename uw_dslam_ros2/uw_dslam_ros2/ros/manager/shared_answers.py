"""Answers of registrations that managers tell each other over an acoustic link."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from rclpy.node import Node
from std_msgs.msg import UInt8MultiArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.link.coding.answers import (
    AnswerExchange,
    decode_answer,
    encode_answer,
    question_digest,
)
from uw_dslam_ros2.core.merging import MatchRequest
from uw_dslam_ros2.core.merging.graph.answers import Answer, QueryKey
from uw_dslam_ros2.core.registration.result import PriorWindow, RegistrationResult
from uw_dslam_ros2.ros.manager.link_topic import link_topic

__all__ = ["SharedAnswers"]

_ALL = 1000


class SharedAnswers:
    """A question that somebody has answered is not searched again, and all use the same bytes.

    Own answers are told once the map rests on them and nothing is open: while maps grow, every
    vehicle asks about what it has just got, and hardly two the same. Without a link it does
    nothing.

    Parameters
    ----------
    node
        Whose topics they are.
    link
        Namespace of the acoustic link's node; empty: there is none.
    post
        Hands a function to the thread that owns this object.
    on_correction
        Called with a question of the queue that has another answer than it was given, and that
        answer.
    complain
        Called with what is wrong with a message.
    """

    def __init__(
        self,
        node: Node,
        link: str,
        post: Callable[[Callable[[], None]], None],
        on_correction: Callable[[QueryKey, RegistrationResult], None],
        complain: Callable[[str], None],
    ) -> None:
        self._on_correction, self._complain = on_correction, complain
        self._exchange = AnswerExchange()
        self._used: dict[bytes, tuple[QueryKey, bytes]] = {}
        self._questions: dict[QueryKey, bytes] = {}
        self._told: set[bytes] = set()  # answers that were told, by whomever
        self._is_worth_a_look, self._is_changed = False, True  # a session may have some
        self._output = link_topic(node, link, "answers", post, self._take)

    def note_change(self) -> None:
        """There may be new questions, which others have answered."""
        self._is_worth_a_look = self._is_changed = True

    @property
    def is_worth_telling(self) -> bool:
        """Whether there may be answers to tell, since `tell` was called last."""
        return self._output is not None and self._is_changed

    def num_worth_a_look(self) -> int:
        """How many open questions others may have answered, if no server is free to be asked."""
        if self._output is None or not self._is_worth_a_look:
            return 0
        self._is_worth_a_look = False
        return _ALL

    def find(self, request: MatchRequest, prior: PriorWindow | None) -> RegistrationResult | None:
        """What somebody has answered to a request in this window."""
        if self._output is None:
            return None
        question = question_digest(request.source, request.target, prior)
        found = self._exchange.find(question)
        if found is not None:
            self._use(request.key, question)
        return found

    def settle(
        self, request: MatchRequest, prior: PriorWindow | None, result: RegistrationResult
    ) -> RegistrationResult:
        """Keep an own answer, unless a better one was heard; returns what all are to use."""
        if self._output is None:
            return result
        question = question_digest(request.source, request.target, prior)
        settled = self._exchange.settle(question, result)
        self._use(request.key, question)
        return settled

    def knows(self, key: QueryKey) -> bool:
        """Whether it was told which answer the queue has to a question."""
        return key in self._questions

    def take_up(
        self, answer: Answer, maps: tuple[OccupancyMap, OccupancyMap], prior: PriorWindow | None
    ) -> None:
        """Go on with an answer that the queue had before: to these maps, in this window."""
        question = question_digest(*maps, prior)
        data = encode_answer(question, answer)
        self._exchange.take(data)
        self._use(answer.query.key, question)
        if (settled := self._exchange.data(question)) != data:
            self._on_correction(answer.query.key, decode_answer(settled)[1])

    def tell(self, keys: Iterable[QueryKey]) -> None:
        """Tell the answers to questions that a settled map rests on, if nobody has told them."""
        self._is_changed = False
        for key in keys:
            _, data = self._used[self._questions[key]]
            if self._output is not None and data not in self._told:
                self._told.add(data)
                self._output.publish(UInt8MultiArray(data=data))

    def _use(self, key: QueryKey, question: bytes) -> None:
        self._used[question] = key, self._exchange.data(question)
        self._questions[key] = question

    def _take(self, data: bytes) -> None:
        try:
            question, _ = decode_answer(data)
            self._exchange.take(data)
        except InvalidInputError as error:
            self._complain(f"answer refused: {error}")
            return
        self._told.add(data)
        self._is_worth_a_look = self._is_changed = True
        if question not in self._used:
            return
        key, used = self._used[question]
        if self._exchange.data(question) != used:
            self._used[question] = key, self._exchange.data(question)
            self._on_correction(key, decode_answer(self._exchange.data(question))[1])
