"""What follows from all that came in: the plan, and the map drawn by it, worked out on demand."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any

from uw_dslam_ros2.core.merging.arrivals import Arrivals
from uw_dslam_ros2.core.merging.asking.plan import Plan
from uw_dslam_ros2.core.merging.config import MapQueueConfig
from uw_dslam_ros2.core.merging.drawn.drawing import Drawing
from uw_dslam_ros2.core.merging.drawn.frame import GlobalFrame
from uw_dslam_ros2.core.merging.drawn.global_map import GlobalMap
from uw_dslam_ros2.core.merging.graph.answers import Answer, QueryKey
from uw_dslam_ros2.core.merging.graph.library import Library
from uw_dslam_ros2.core.merging.graph.submap_groups import StoredSubmap
from uw_dslam_ros2.core.merging.planning import Planning
from uw_dslam_ros2.core.merging.steering.decisions import DecisionLog
from uw_dslam_ros2.core.merging.steering.georeference import Fix
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId

__all__ = ["Standing"]


class Standing:
    """Where everything stands now.

    Its owner changes what goes in, and says so by `change`, or by `change_submaps` where more than
    answers changed.
    """

    def __init__(self, config: MapQueueConfig, arrivals: Arrivals) -> None:
        self._arrivals = arrivals
        self.decisions = DecisionLog()
        self.fixes: tuple[Fix, ...] = ()
        """Of instruments; those of people are in the log."""
        self.answers: dict[QueryKey, Answer] = {}
        self.held: frozenset[QueryKey] = frozenset()
        """Answers that hold in the graph."""
        self.is_growing = False
        self.frame = GlobalFrame(config.anchor_vehicle, config.resolution_m)
        self.planning = Planning(config)
        self.drawing = Drawing()
        self._library: Library | None = None
        self._plan: Plan | None = None
        self._worked_out: dict[str, Any] = {}

    def set_decisions(self, log: DecisionLog, *, keeps: bool) -> None:
        """Have another log; `keeps`: what stood because of the one before goes on to stand."""
        before, self.decisions = self.decisions, log
        if before.pin is not None and log.pin is None:
            self.frame.release()
        if not keeps:
            self.held = frozenset()
        self.change_submaps()

    def change_submaps(self) -> None:
        """Submaps or decisions changed."""
        self._library = None
        self.change()

    def change(self) -> None:
        """Something changed."""
        self._plan = None
        self._worked_out.clear()
        self.drawing.note_change()

    def library(self) -> Library:
        """The submaps, and what is known of them."""
        if self._library is None:
            self._library = self.planning.library(self._arrivals.submaps, self.decisions)
        return self._library

    def plan(self, num_in_flight: int) -> Plan:
        """Where everything is, and what to ask; requests in flight may still change it."""
        if self._plan is None:
            if not self._arrivals.submaps:
                return Plan([], [], [], [])
            library, pin = self.library(), self.decisions.pin
            if self.frame.anchor not in library.submaps:
                self._note_frame(self.frame.choose(self._sound(library)))
            plan = self.planning.plan(
                library,
                self._arrivals.tracks,
                self.answers,
                self.held,
                self.frame.anchor,
                [*self.decisions.fixes, *self.fixes],
                is_growing=self.is_growing,
            )
            self.held = frozenset(
                constraint.key for constraint in plan.constraints if constraint.is_inlier
            )
            self._plan = plan
            is_open = self.is_growing or bool(plan.wanted) or num_in_flight > 0
            sound = self._sound(library)
            if pin is not None and pin in sound:
                has_moved = self.frame.hold(pin, sound[pin])
            else:
                has_moved = self.frame.settle(plan, sound, is_open)
            if self._note_frame(has_moved):
                self._plan = None
                return self.plan(num_in_flight)
        return self._plan

    def merged(self, plan: Plan) -> dict[SubmapId, SE2]:
        """Poses of what is joined in "map"."""
        components = plan.components
        return components[0] if components and self.frame.anchor in components[0] else {}

    def undrawable(self, plan: Plan) -> dict[SubmapId, str]:
        """What is joined and cannot be drawn, and why."""
        lattice, merged = self.frame.lattice, self.merged(plan)
        if lattice is None:
            return {}
        return self.drawing.left_out(lattice, self._arrivals.submaps, merged)

    def drawn(self, plan: Plan) -> GlobalMap | None:
        """The map of what is joined; None before there is a frame."""
        lattice, merged = self.frame.lattice, self.merged(plan)
        if lattice is None:
            return None
        withdrawn = self.decisions.withdrawn(merged)
        return self.drawing.drawn(lattice, self._arrivals.submaps, merged, withdrawn)

    def once[T](self, what: str, work_out: Callable[[], T]) -> T:
        """What follows from the plan and all else, worked out once between two changes."""
        if what not in self._worked_out:
            self._worked_out[what] = work_out()
        found: T = self._worked_out[what]
        return found

    def digest(self, plan: Plan) -> bytes:
        """Of what the map is drawn from (8 bytes)."""
        merged = self.merged(plan)
        withdrawn = self.decisions.withdrawn(merged)
        hasher = hashlib.blake2b(repr(self.frame.lattice).encode(), digest_size=8)
        for submap_id, T in sorted(merged.items()):
            hasher.update(repr((submap_id, submap_id in withdrawn, *T.as_array())).encode())
            hasher.update(self._arrivals.submaps[submap_id].fingerprint)
        return hasher.digest()

    def _sound(self, library: Library) -> dict[SubmapId, StoredSubmap]:
        """What the frame may be pinned to."""
        aside = self.planning.aside
        return {i: stored for i, stored in library.submaps.items() if i not in aside}

    def _note_frame(self, has_moved: bool) -> bool:
        if has_moved:
            self.drawing.restart()
        return has_moved
