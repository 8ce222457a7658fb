"""Registrations that were asked for, and have no answer yet."""

from __future__ import annotations

from collections.abc import Container

from uw_dslam_ros2.core.merging.graph.answers import Query, QueryKey
from uw_dslam_ros2.core.merging.graph.library import Library
from uw_dslam_ros2.core.merging.types import MatchRequest

__all__ = ["Requests"]

_REPLAN_SHARE = 0.125
"""Of a plan's questions: so many are answered before another plan is made."""
_REPLAN_PER_SUBMAP = 0.005
"""Or so many for each submap: a plan costs the more the more there are."""


class Requests:
    """Numbers them, and keeps what each one asked."""

    def __init__(self) -> None:
        self._in_flight: dict[int, Query] = {}
        self.next_id = 1
        self.questions: list[Query] = []
        """Of the last plan."""

    def __len__(self) -> int:
        return len(self._in_flight)

    def keys(self) -> set[QueryKey]:
        """What is asked already."""
        return {query.key for query in self._in_flight.values()}

    def unanswered(self, answers: Container[QueryKey], num_submaps: int) -> list[Query]:
        """Questions of the last plan, while few of them are answered; else none.

        A plan costs as much as many answers where there are many submaps, and a few answers change
        little of it.
        """
        still_open = [query for query in self.questions if query.key not in answers]
        num_answered = len(self.questions) - len(still_open)
        enough = max(_REPLAN_SHARE * len(self.questions), _REPLAN_PER_SUBMAP * num_submaps)
        return still_open if num_answered <= enough else []

    def make(self, query: Query, library: Library) -> MatchRequest:
        """Ask a question."""
        request_id, self.next_id = self.next_id, self.next_id + 1
        self._in_flight[request_id] = query
        return MatchRequest(
            request_id,
            library.render(query.source),
            library.render(query.target),
            query.prior,
            query.source.ids,
            query.target.ids,
            query.source.reference,
            query.target.reference,
            query.key,
        )

    def end(self, request_id: int) -> Query | None:
        """What a request asked, which is not in flight any more; None if it was not."""
        return self._in_flight.pop(request_id, None)
