"""What is shown at one moment: from a queue's submaps, constraints and answers to the page."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.merging import (
    Constraint,
    DecisionRecord,
    MapQueue,
    SubmapRecord,
    SubmapState,
)
from uw_dslam_ros2.core.merging.graph.answers import Answer
from uw_dslam_ros2.core.merging.graph.submap_groups import StoredSubmap, SubmapGroup
from uw_dslam_ros2.core.registration.result import RegistrationResult
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap, SubmapId
from uw_dslam_ros2.view import registering
from uw_dslam_ros2.view.drawn import Drawn
from uw_dslam_ros2.view.overview import (
    Names,
    constraint_row,
    decision_row,
    outline_of,
    registration_row,
    submap_row,
    track_piece,
    vehicle_rows,
)
from uw_dslam_ros2.view.pairs import Pair, pair_of, rendered

__all__ = ["Showing"]

FloatArray = NDArray[np.float64]

_GAP_SHARE = 0.08  # of the longest side of a group, between groups that stand side by side
_ROW_ASPECT = 1.6  # a row of groups is so much longer than the square that would hold all


@dataclass(frozen=True, slots=True, eq=False)
class _SubmapShown:
    """What was made of a submap, and of what."""

    submap: Submap
    key: tuple[Hashable, ...]
    row: dict[str, Any]
    track: list[list[float]]


class Showing:
    """One state of a merge; a new state keeps what it can of the one before.

    Parameters
    ----------
    records, constraints
        As `MapQueue` gives them.
    answers
        Each answer, and whether it holds in the graph.
    before
        The state shown until now.
    decisions
        What people decided, and what became of it.
    georeference
        Name of coordinates on earth, and where the global map lies in them.
    """

    def __init__(
        self,
        records: Sequence[SubmapRecord],
        constraints: Sequence[Constraint],
        answers: Sequence[tuple[Answer, bool]] = (),
        before: Showing | None = None,
        decisions: Sequence[DecisionRecord] = (),
        georeference: tuple[str, SE2] | None = None,
    ) -> None:
        self.records = list(records)
        self.names = Names(self.records)
        self.constraints = list(constraints)
        self.decisions, self.georeference = list(decisions), georeference
        self._answers = list(answers)
        self._stored: dict[SubmapId, StoredSubmap] = dict(before._stored) if before else {}
        self._outlines: dict[SubmapId, FloatArray] = dict(before._outlines) if before else {}
        # The newest, and another moment: who goes back in time must not cost the others.
        self._drawn: Drawn = before._drawn if before else Drawn()
        self._past: Drawn = before._past if before else Drawn()
        for record in self.records:
            submap, key = record.submap, record.submap.submap_id
            held = self._stored.get(key)
            if held is None or held.submap is not submap:
                self._stored[key] = StoredSubmap.of(submap, submap.grid.values.size)
                self._outlines[key] = outline_of(submap.grid)
        self._by_time = sorted(
            (r for r in self.records if r.state is not SubmapState.WITHDRAWN),
            key=lambda r: (r.submap.stamp_ns, r.submap.submap_id),
        )
        self._rows: dict[SubmapId, _SubmapShown] = before._rows if before else {}
        self._boxes = self._boxes_of_groups()
        self._T_view_group = self._side_by_side()
        self.version = self._fingerprint()

    @classmethod
    def of_queue(cls, queue: MapQueue, before: Showing | None = None) -> Showing:
        """What a queue holds now."""
        found = queue.georeference()
        return cls(
            queue.submaps(),
            queue.constraints(),
            queue.answers(),
            before,
            queue.decisions(),
            None if found is None else (found.earth_frame, found.T_earth_map),
        )

    @property
    def num_moments(self) -> int:
        """Places of the time slider: so many submaps can be shown, oldest first."""
        return len(self._by_time)

    def scene(self) -> dict[str, Any]:
        """Everything but the maps' cells, as plain values; lengths in metres of the page."""
        places = {
            r.submap.submap_id: (
                r.component,
                self._T_view_group[r.component] @ r.T_component_submap,
            )
            for r in self.records
            if r.state is not SubmapState.WITHDRAWN
        }
        rows = {record.submap.submap_id: self._submap_shown(record) for record in self.records}
        constraints = (constraint_row(c, places, self.names) for c in self.constraints)
        return {
            "version": self.version,
            "moments": [
                {
                    "submap": self.names.submap(r.submap.submap_id),
                    "stamp_s": r.submap.stamp_ns * 1e-9,
                }
                for r in self._by_time
            ],
            "groups": self._group_rows(),
            "vehicles": vehicle_rows(
                self.records, {i: shown.track for i, shown in rows.items()}, self.names
            ),
            "submaps": [shown.row for shown in rows.values()],
            "constraints": [row for row in constraints if row is not None],
            "decisions": [decision_row(record, places, self.names) for record in self.decisions],
            "earth": self.georeference
            and {
                "frame": self.georeference[0],
                "pose": self.georeference[1].as_array().round(6).tolist(),
            },
            "registrations": [
                registration_row(number, answer, is_used, self._sides(answer), self.names)
                for number, (answer, is_used) in enumerate(self._answers, start=1)
            ],
        }

    def tile(self, moment: int | None, zoom: int, col: int, row: int) -> bytes | None:
        """Picture of the first `moment` submaps (None: all), as `tile_png`."""
        return self._shown(moment).tile(zoom, col, row)

    def map_of(self, group: int) -> OccupancyMap | None:
        """One group's map in its own frame; None where nothing was seen."""
        return self._shown(None).map_of(group)

    def cell(self, x_m: float, y_m: float) -> dict[str, Any] | None:
        """What is known of the cell under a place of the page; None where nothing is."""
        for group, T_view_group in self._T_view_group.items():
            place = T_view_group.inverse().apply(np.array([[x_m, y_m]]))
            seen_by, points = {}, {}
            for record in self.records:
                if record.component != group or record.state is SubmapState.WITHDRAWN:
                    continue
                value = _value_at(record, place)
                if value is not None:
                    submap_id = record.submap.submap_id
                    own = record.T_component_submap.inverse().apply(place[0])
                    seen_by[self.names.submap(submap_id)] = value
                    points[self.names.submap(submap_id)] = [list(submap_id), own.tolist()]
            if seen_by:
                votes = [value > 50 for value in seen_by.values()]
                return {
                    "group": group,
                    "x_m": round(float(place[0, 0]), 3),
                    "y_m": round(float(place[0, 1]), 3),
                    "percent": seen_by,
                    "points": points,
                    "num_occupied": sum(votes),
                    "num_free": len(votes) - sum(votes),
                }
        return None

    def pair(self, number: int, rival: int | None = None) -> Pair:
        """Both maps of an answer laid on each other, as the answer or one of its rivals says.

        Raises
        ------
        InvalidInputError
            If there is no such answer, or no pose in it.
        """
        answer = self.answer(number)
        motion = answer.T_target_source
        if rival is not None:
            others = self.result(number).rivals
            if not 0 <= rival < len(others):
                raise InvalidInputError(
                    f"rival is {rival}, registration {number} has {len(others)}"
                )
            motion = others[rival].T_target_source
        if motion is None:
            raise InvalidInputError(f"registration {number} has no pose: {answer.why}")
        return pair_of(answer.query, motion, self._stored)

    def result(self, number: int) -> RegistrationResult:
        """Register the pair of an answer once more, for what an answer does not keep: rivals."""
        query = self.answer(number).query
        maps = self.rendered(query.source), self.rendered(query.target)
        return registering.register_by_engine(*maps, query.prior)

    def stored(self, submap_id: SubmapId) -> StoredSubmap:
        """A submap that is shown."""
        return self._stored[submap_id]

    def answer(self, number: int) -> Answer:
        """A registration by its number, counted from 1."""
        if not 1 <= number <= len(self._answers):
            raise InvalidInputError(
                f"registration is {number}, there are {len(self._answers)}, counted from 1"
            )
        return self._answers[number - 1][0]

    def rendered(self, group: SubmapGroup) -> OccupancyMap:
        """The map of a group; an error where its submaps are not here, or empty."""
        return rendered(group, self._stored)

    def _submap_shown(self, record: SubmapRecord) -> _SubmapShown:
        """What the page has of a submap, as before where nothing changed: most of its bytes."""
        submap_id, group = record.submap.submap_id, self._T_view_group[record.component]
        name = self.names.submap(submap_id)
        key = name, record.state, record.component, record.T_component_submap, record.reason, group
        held = self._rows.get(submap_id)
        if held is None or held.submap is not record.submap or held.key != key:
            row = submap_row(record, self._outlines[submap_id], group, self.names)
            held = _SubmapShown(record.submap, key, row, track_piece(record, group))
            self._rows[submap_id] = held
        return held

    def _shown(self, moment: int | None) -> Drawn:
        count = self.num_moments if moment is None else max(0, min(moment, self.num_moments))
        drawn = self._drawn if count == self.num_moments else self._past
        groups: dict[int, dict[SubmapId, SE2]] = {group: {} for group in self._T_view_group}
        for record in self._by_time[:count]:
            groups[record.component][record.submap.submap_id] = record.T_component_submap
        drawn.show((self.version, count), self._stored, groups, self._T_view_group)
        return drawn

    def _side_by_side(self) -> dict[int, SE2]:
        """Where each group's frame lies on the page: the first as it is, others in rows beside."""
        sizes = {g: (x_1 - x_0, y_1 - y_0) for g, (x_0, y_0, x_1, y_1) in self._boxes.items()}
        gap = _GAP_SHARE * max((side for size in sizes.values() for side in size), default=0.0)
        area = sum((width + gap) * (height + gap) for width, height in sizes.values())
        row_m = _ROW_ASPECT * math.sqrt(area)
        placed: dict[int, SE2] = {}
        x_m = top_m = left_m = height_m = 0.0
        for group, (low_x, _, _, high_y) in self._boxes.items():
            width, height = sizes[group]
            if not placed:
                x_m = left_m = low_x
                top_m = high_y
            elif x_m > left_m and x_m + width > left_m + row_m:
                x_m, top_m, height_m = left_m, top_m - height_m - gap, 0.0
            placed[group] = SE2(x_m - low_x, top_m - high_y)
            x_m, height_m = x_m + width + gap, max(height_m, height)
        for record in self.records:  # withdrawn ones may be alone in theirs
            placed.setdefault(record.component, SE2())
        return placed

    def _boxes_of_groups(self) -> dict[int, tuple[float, float, float, float]]:
        """Rectangle around each group in its own frame, ``x_min, y_min, x_max, y_max``."""
        corners: dict[int, list[FloatArray]] = {}
        for r in self._by_time:
            spec = r.submap.grid.spec
            corners.setdefault(r.component, []).append(r.T_component_submap.apply(spec.corners()))
        boxes = {}
        for group in sorted(corners):
            points = np.concatenate(corners[group])
            (low_x, low_y), (high_x, high_y) = points.min(axis=0), points.max(axis=0)
            boxes[group] = float(low_x), float(low_y), float(high_x), float(high_y)
        return boxes

    def _group_rows(self) -> list[dict[str, Any]]:
        rows = []
        for group in sorted({record.component for record in self._by_time}):
            own = [r for r in self._by_time if r.component == group]
            low_x, low_y, high_x, high_y = self._boxes[group]
            shift = self._T_view_group[group]
            rows.append(
                {
                    "group": group,
                    "frame": "map" if group == 0 else f"group {group}",
                    "vehicles": sorted({self.names.track(r.submap.submap_id.track) for r in own}),
                    "num_submaps": len(own),
                    "shift": [shift.x, shift.y],
                    "bounds": [
                        low_x + shift.x,
                        low_y + shift.y,
                        high_x + shift.x,
                        high_y + shift.y,
                    ],
                }
            )
        return rows

    def _sides(self, answer: Answer) -> dict[str, str]:
        return {
            "source": self._name_of(answer.query.source),
            "target": self._name_of(answer.query.target),
        }

    def _name_of(self, group: SubmapGroup) -> str:
        """The vehicles of a group, and how many submaps."""
        if len(group.ids) == 1:
            return self.names.submap(group.ids[0])
        names = sorted({self.names.track(i.track) for i in group.ids})
        return f"{' + '.join(names)} ({len(group.ids)} submaps)"

    def _fingerprint(self) -> str:
        hasher = hashlib.blake2b(digest_size=8)
        for record in self.records:
            key = record.submap.submap_id
            row = (str(key), record.state, record.component, record.T_component_submap)
            hasher.update(repr(row).encode() + self._stored[key].digest)
        for constraint in self.constraints:
            hasher.update(
                repr((constraint.source, constraint.target, constraint.is_inlier)).encode()
            )
        hasher.update(repr([answer.query.key for answer, _ in self._answers]).encode())
        hasher.update(repr((self.decisions, self.georeference)).encode())
        return hasher.hexdigest()


def _value_at(record: SubmapRecord, place: FloatArray) -> int | None:
    grid = record.submap.grid
    cells = grid.spec.cells_of(record.T_component_submap.inverse().apply(place))
    if not grid.spec.contains(cells)[0]:
        return None
    value = int(grid.values[cells[0, 0], cells[0, 1]])
    return value if value >= 0 else None
