"""A hand on the queue: what people decide and instruments say, and the plan that follows."""

from __future__ import annotations

from collections.abc import Sequence

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.merging.arrivals import Arrivals
from uw_dslam_ros2.core.merging.asking.plan import Plan
from uw_dslam_ros2.core.merging.config import MapQueueConfig
from uw_dslam_ros2.core.merging.drawn.global_map import GlobalMap
from uw_dslam_ros2.core.merging.graph.answers import Answer, QueryKey
from uw_dslam_ros2.core.merging.requests import Requests
from uw_dslam_ros2.core.merging.standing import Standing
from uw_dslam_ros2.core.merging.steering.by_hand import check_decision, remarks, stated_pose
from uw_dslam_ros2.core.merging.steering.decisions import (
    Decision,
    DecisionKind,
    DecisionLog,
    DecisionRecord,
)
from uw_dslam_ros2.core.merging.steering.georeference import Fix, Georeference
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId

__all__ = ["SteeredQueue"]


class SteeredQueue:
    """What a queue holds, and how it is steered; `MapQueue` is the whole of it."""

    def __init__(self, config: MapQueueConfig | None = None) -> None:
        self._config = config or MapQueueConfig()
        self._arrivals = Arrivals(self._config.max_submap_cells)
        self._submaps = self._arrivals.submaps
        self._now = Standing(self._config, self._arrivals)
        self._requests = Requests()

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
        check_decision(decision, self._submaps, self._config.mode)
        is_undone = decision.kind is DecisionKind.UNDO
        self._now.set_decisions(self._decisions.added(decision), keeps=not is_undone)
        self._requests.questions = []
        return list(self._decisions)[-1]

    def take_decisions(self, log: DecisionLog) -> None:
        """Have another log in the place of the own one; submaps that it names may come later.

        Raises
        ------
        InvalidInputError
            If it holds what this queue's mode does not have.
        """
        for decision in log:
            check_decision(decision, None, self._config.mode)
        if tuple(log) != tuple(self._decisions):
            self._now.set_decisions(log, keeps=False)
            self._requests.questions = []

    def stated_pose(self, source: SubmapId, target: SubmapId) -> tuple[SE2, float, float]:
        """What the answers say of two submaps, for a person to confirm; see `by_hand`."""
        return stated_pose(self._answers.values(), source, target)

    def decisions(self) -> list[DecisionRecord]:
        """All decisions in order, and what became of each."""
        if not len(self._decisions):
            return []
        plan, found = self._plan(), self._georeference()
        doubts, library = self._now.planning.doubts, self._now.library()
        told = remarks(self._decisions, library, plan, self._answers, found, doubts)
        return [
            DecisionRecord(d, self._decisions.undone_by(d.number) is None, told[d.number])
            for d in self._decisions
        ]

    @property
    def decision_log(self) -> DecisionLog:
        """All decisions, those included that are undone."""
        return self._decisions

    @property
    def num_decisions(self) -> int:
        """How many these are."""
        return len(self._decisions)

    def add_fixes(self, fixes: Sequence[Fix]) -> bool:
        """Take what instruments say of where submaps lie on earth; fixes of people are decisions.

        What they said of the same submaps before does not hold any more. True if this says
        something else.

        Raises
        ------
        InvalidInputError
            If one names a submap that never came.
        """
        for fix in fixes:
            if fix.submap_id not in self._submaps:
                raise InvalidInputError(
                    f"fix.submap_id is {fix.submap_id}, which was never received"
                )
        anew = {fix.submap_id for fix in fixes}
        now = (*(f for f in self._now.fixes if f.submap_id not in anew), *fixes)
        if now == self._now.fixes:
            return False
        self._now.fixes = now
        self._change()
        return True

    def georeference(self) -> Georeference | None:
        """Where "map" lies on earth; None where the fixes do not say it."""
        found = self._georeference()
        return None if isinstance(found, str) else found

    def why_no_georeference(self) -> str:
        """Why that is not known; empty where it is."""
        found = self._georeference()
        return found if isinstance(found, str) else ""

    def withdraw(self, submap_id: SubmapId, who: str = "", stamp_ns: int = 0) -> bool:
        """Take a submap out of the map and out of matching until `restore`, also when sent again.

        False if there is no such submap.
        """
        return self._switch(DecisionKind.WITHDRAW, submap_id, who, stamp_ns)

    def restore(self, submap_id: SubmapId, who: str = "", stamp_ns: int = 0) -> bool:
        """Undo `withdraw`. False if there is no such submap."""
        return self._switch(DecisionKind.RESTORE, submap_id, who, stamp_ns)

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

    @property
    def _decisions(self) -> DecisionLog:
        return self._now.decisions

    @property
    def _answers(self) -> dict[QueryKey, Answer]:
        return self._now.answers

    def _merged(self) -> dict[SubmapId, SE2]:
        return self._now.merged(self._plan())

    def _change_submaps(self) -> None:
        self._now.change_submaps()
        self._requests.questions = []

    def _change(self) -> None:
        self._now.change()
        self._requests.questions = []

    def _plan(self) -> Plan:
        plan = self._now.plan(len(self._requests))
        self._requests.questions = plan.wanted
        return plan

    def _drawn(self) -> GlobalMap | None:
        return self._now.drawn(self._plan())
