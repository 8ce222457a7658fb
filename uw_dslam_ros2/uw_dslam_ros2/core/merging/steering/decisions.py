"""What people decide about a merge: one ordered log, which can be undone, and what it means.

A decision is never changed or taken out of the log: to undo one is a decision of its own, and can
be undone. What follows depends on the log and on the names of submaps, and not on when a submap
came or how often: so it holds for what is sent again, for revisions and after a restart.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.merging.steering.georeference import Fix
from uw_dslam_ros2.core.merging.types import Edge
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId

__all__ = ["Decision", "DecisionKind", "DecisionLog", "DecisionRecord"]

_MAX_WHO_LENGTH = 100


class DecisionKind(enum.IntEnum):
    """What is decided; the numbers are those of ``uw_dslam_msgs/Decision``."""

    WITHDRAW = 1
    """`source` is taken out of the map and out of matching."""
    RESTORE = 2
    """`source` is taken in again."""
    FORBID = 3
    """`source` and `target` are not matched with each other, and no match of them is used."""
    CONFIRM = 4
    """`source` lies in `target` as `T_target_source` says, whatever the matches say."""
    REGISTER = 5
    """`source` is matched with `target` within a window around `T_target_source`."""
    PIN = 6
    """The global frame is that of `source`."""
    FIX = 7
    """A point of `source` lies at `place` on earth."""
    UNDO = 8
    """Decision number `undone` does not hold."""


_NEEDS: dict[DecisionKind, tuple[str, ...]] = {
    DecisionKind.WITHDRAW: ("source",),
    DecisionKind.RESTORE: ("source",),
    DecisionKind.FORBID: ("source", "target"),
    DecisionKind.CONFIRM: ("source", "target", "T_target_source"),
    DecisionKind.REGISTER: ("source", "target", "T_target_source"),
    DecisionKind.PIN: ("source",),
    DecisionKind.FIX: ("source", "place"),
    DecisionKind.UNDO: (),
}
_OF_RUNS = DecisionKind.WITHDRAW, DecisionKind.RESTORE, DecisionKind.FORBID, DecisionKind.REGISTER


@dataclass(frozen=True, slots=True)
class Decision:
    """One entry of the log; as in ``uw_dslam_msgs/Decision``.

    Raises
    ------
    InvalidInputError
        Naming the field, its value and what is expected.
    """

    kind: DecisionKind
    who: str = ""
    stamp_ns: int = 0
    """When, by the clock of who writes it down."""
    source: SubmapId | None = None
    target: SubmapId | None = None
    is_run: bool = False
    """`source` and `target` stand for all submaps of their runs."""
    T_target_source: SE2 | None = None
    """Between the frames of the two submaps; middle of the window of REGISTER."""
    sigma_m: float = 0.0
    """Standard deviation of a pose that is confirmed, or of a fix in x and y each."""
    sigma_rad: float = 0.0
    """The same of the yaw; infinite where a fix says nothing of it."""
    half_width_m: float = 0.0
    """Of the window of REGISTER, in x and y each."""
    half_width_rad: float = 0.0
    point: tuple[float, float] = (0.0, 0.0)
    """[m] in the frame of `source`, that of FIX is about."""
    place: SE2 | None = None
    """Where that point lies in `earth_frame`, and the yaw of the submap's frame there."""
    earth_frame: str = ""
    """Name of the coordinates of FIX, such as EPSG:32632."""
    undone: int = 0
    number: int = 0
    """Place in the log, from 1; 0 before it is written down."""

    def __post_init__(self) -> None:
        kind = self.kind.name
        if len(self.who) > _MAX_WHO_LENGTH:
            raise InvalidInputError(
                f"decision.who has {len(self.who)} characters, expected up to {_MAX_WHO_LENGTH}"
            )
        needs = _NEEDS[self.kind]
        for name in ("source", "target", "T_target_source", "place"):
            value = getattr(self, name)
            if (value is not None) != (name in needs):
                wanted = "one" if name in needs else "none"
                raise InvalidInputError(f"decision.{name} is {value}, a {kind} takes {wanted}")
        if self.is_run and self.kind not in _OF_RUNS:
            raise InvalidInputError(f"decision.is_run is True, a {kind} is about a submap")
        if self.source is not None and self.target is not None:
            ends = (self.source.track, self.target.track) if self.is_run else self.pair
            if ends[0] == ends[1]:
                raise InvalidInputError(
                    f"decision.target is {self.target}, expected another than the source"
                )
        self._check_numbers()

    def _check_numbers(self) -> None:
        wanted: tuple[tuple[str, float], ...] = ()
        if self.kind is DecisionKind.REGISTER:
            wanted = (("half_width_m", math.inf), ("half_width_rad", math.inf))
        elif self.kind is DecisionKind.CONFIRM:
            wanted = (("sigma_m", math.inf), ("sigma_rad", math.inf))
        elif self.kind is DecisionKind.FIX:
            wanted = (("sigma_m", math.inf),)
            if not self.sigma_rad > 0.0:
                raise InvalidInputError(
                    f"decision.sigma_rad is {self.sigma_rad}, expected > 0, infinite where the "
                    "yaw is not known"
                )
            if not self.earth_frame:
                raise InvalidInputError(
                    "decision.earth_frame is empty, expected a name such as EPSG:32632"
                )
            if not all(map(math.isfinite, self.point)):
                raise InvalidInputError(f"decision.point is {self.point}, expected finite")
        for name, limit in wanted:
            value = getattr(self, name)
            if not 0.0 < value < limit:
                raise InvalidInputError(f"decision.{name} is {value}, expected > 0 and finite")
        if (self.undone > 0) != (self.kind is DecisionKind.UNDO):
            raise InvalidInputError(
                f"decision.undone is {self.undone}, expected a number for an UNDO, 0 otherwise"
            )

    @property
    def pair(self) -> tuple[SubmapId, SubmapId]:
        """Source and target, of a decision that has both."""
        assert self.source is not None
        assert self.target is not None
        return self.source, self.target

    def covers(self, submap_id: SubmapId) -> bool:
        """Whether a decision about one side is about a submap."""
        return _is_of(self.source, submap_id, self.is_run)

    def joins(self, one: SubmapId, other: SubmapId) -> bool:
        """Whether a decision about two sides is about two submaps, whichever is which."""
        return any(
            _is_of(self.source, a, self.is_run) and _is_of(self.target, b, self.is_run)
            for a, b in ((one, other), (other, one))
        )

    def edge(self) -> Edge:
        """What a CONFIRM says."""
        assert self.T_target_source is not None
        variances = np.array([self.sigma_m, self.sigma_m, self.sigma_rad]) ** 2
        return Edge(*self.pair, self.T_target_source, np.diag(variances))

    def fix(self) -> Fix:
        """What a FIX says."""
        assert self.source is not None
        assert self.place is not None
        where = self.point, self.place, self.sigma_m, self.sigma_rad
        return Fix(self.source, *where, self.earth_frame, self.number)


@dataclass(frozen=True, slots=True)
class DecisionRecord:
    """A decision, and what became of it."""

    decision: Decision
    is_in_force: bool
    """Not undone."""
    remark: str
    """For people; empty where there is nothing to say."""


class DecisionLog:
    """All decisions in the order in which they were taken, and what they mean together.

    The later of two that contradict each other holds. It never changes: `added` gives another.
    """

    def __init__(self, decisions: Iterable[Decision] = ()) -> None:
        self._all = tuple(decisions)
        for index, decision in enumerate(self._all, start=1):
            if decision.number != index:
                raise InvalidInputError(
                    f"decision.number is {decision.number}, expected {index}: they are numbered "
                    "in order"
                )
            if decision.undone >= index:
                raise InvalidInputError(
                    f"decision.undone is {decision.undone}, expected less than its number {index}"
                )
        self._undone_by: dict[int, int] = {}
        for decision in reversed(self._all):
            if decision.kind is DecisionKind.UNDO and decision.number not in self._undone_by:
                self._undone_by.setdefault(decision.undone, decision.number)
        self._forbids = self.in_force(DecisionKind.FORBID)
        self.confirmed = self._standing(DecisionKind.CONFIRM)
        """Those that count: the newest about each pair, and none that was forbidden later."""
        self.windows = self._standing(DecisionKind.REGISTER)
        """The same of REGISTER."""
        pins = self.in_force(DecisionKind.PIN)
        self.pin = pins[-1].source if pins else None
        self.fixes = [decision.fix() for decision in self.in_force(DecisionKind.FIX)]

    def __iter__(self) -> Iterator[Decision]:
        return iter(self._all)

    def __len__(self) -> int:
        return len(self._all)

    def added(self, decision: Decision) -> DecisionLog:
        """The log with one more, which gets the next number.

        Raises
        ------
        InvalidInputError
            If it undoes what is not there, or is undone already.
        """
        if decision.kind is DecisionKind.UNDO:
            if not 1 <= decision.undone <= len(self._all):
                raise InvalidInputError(
                    f"decision.undone is {decision.undone}, expected 1 to {len(self._all)}"
                )
            if by := self._undone_by.get(decision.undone):
                raise InvalidInputError(f"decision {decision.undone} is undone by {by} already")
        return DecisionLog([*self._all, replace(decision, number=len(self._all) + 1)])

    def in_force(self, *kinds: DecisionKind) -> list[Decision]:
        """Those of some kinds that are not undone, in order."""
        return [d for d in self._all if d.kind in kinds and d.number not in self._undone_by]

    def undone_by(self, number: int) -> int | None:
        """Number of the decision that undoes another one; None if that is in force."""
        return self._undone_by.get(number)

    def withdrawn(self, ids: Iterable[SubmapId]) -> frozenset[SubmapId]:
        """Which of these submaps are taken out."""
        taken: set[SubmapId] = set()
        known = list(ids)
        for decision in self.in_force(DecisionKind.WITHDRAW, DecisionKind.RESTORE):
            covered = {submap_id for submap_id in known if decision.covers(submap_id)}
            taken = taken | covered if decision.kind is DecisionKind.WITHDRAW else taken - covered
        return frozenset(taken)

    def is_forbidden(self, one: SubmapId, other: SubmapId, since: int = 0) -> bool:
        """Whether a match of two submaps is not to be used; by decisions after `since` alone."""
        return any(d.number > since and d.joins(one, other) for d in self._forbids)

    def _standing(self, kind: DecisionKind) -> list[Decision]:
        newest: dict[object, Decision] = {}
        for decision in self.in_force(kind):
            ends = decision.pair
            key = frozenset(i.track for i in ends) if decision.is_run else frozenset(ends)
            newest[key] = decision
        return [d for d in newest.values() if not self.is_forbidden(*d.pair, since=d.number)]


def _is_of(what: SubmapId | None, submap_id: SubmapId, is_run: bool) -> bool:
    if what is None:
        return False
    return what.track == submap_id.track if is_run else what == submap_id
