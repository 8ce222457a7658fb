"""What the page shows of a merge: vehicles, submaps, constraints and groups, as plain values."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.merging import (
    Constraint,
    DecisionRecord,
    SubmapRecord,
    SubmapState,
)
from uw_dslam_ros2.core.merging.graph.answers import Answer
from uw_dslam_ros2.core.run_names import RunNames
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId

__all__ = [
    "Names",
    "constraint_row",
    "decision_row",
    "look_of",
    "outline_of",
    "registration_row",
    "submap_row",
    "track_piece",
    "vehicle_rows",
]

FloatArray = NDArray[np.float64]

_OUTLINE_CELL_M = 0.5
_TRACK_STEP_M = 0.2


class Names(RunNames):
    """Names for people of what a merge holds."""

    def __init__(self, records: Sequence[SubmapRecord]) -> None:
        super().__init__(record.submap for record in records)
        self._of_submaps: dict[SubmapId, str] = {}

    def submap(self, submap_id: SubmapId) -> str:
        """As of all runs; a page names each submap many times."""
        name = self._of_submaps.get(submap_id)
        if name is None:
            name = self._of_submaps[submap_id] = super().submap(submap_id)
        return name


def outline_of(occupancy: OccupancyMap) -> FloatArray:
    """Rim (K, 2) [m] of the largest patch that was seen, in the map's frame; K may be 0."""
    spec = occupancy.spec
    step = max(1, round(_OUTLINE_CELL_M / spec.resolution_m))
    rows, cols = -(-spec.num_rows // step), -(-spec.num_cols // step)
    known = np.zeros((rows * step, cols * step), bool)
    known[: spec.num_rows, : spec.num_cols] = occupancy.known
    coarse = known.reshape(rows, step, cols, step).any(axis=(1, 3)).astype(np.uint8)
    rims, _ = cv2.findContours(coarse, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if not rims:
        return np.empty((0, 2))
    largest = max(rims, key=cv2.contourArea)
    rim = cv2.approxPolyDP(largest, 1.0, True).reshape(-1, 2).astype(np.float64)
    return spec.T_frame_grid.apply((rim + 0.5) * step * spec.resolution_m)


def vehicle_rows(
    records: Sequence[SubmapRecord], pieces: Mapping[SubmapId, list[list[float]]], names: Names
) -> list[dict[str, Any]]:
    """Each run of each vehicle with its track, one piece for each submap, oldest first."""
    rows: dict[str, dict[str, Any]] = {}
    for record in records:
        submap = record.submap
        name = names.track(submap.submap_id.track)
        row = rows.setdefault(
            name,
            {
                "name": name,
                "id": list(submap.submap_id),
                "num_submaps": 0,
                "num_merged": 0,
                "num_withdrawn": 0,
                "reason": "",
                "track": [],
            },
        )
        row["num_submaps"] += 1
        is_merged = record.state is SubmapState.MERGED
        row["num_merged"] += is_merged
        row["num_withdrawn"] += record.state is SubmapState.WITHDRAWN
        if not is_merged or not row["reason"]:
            row["reason"] = record.reason
        row["newest_s"] = max(row.get("newest_s", 0.0), submap.stamp_ns * 1e-9)
        if piece := pieces.get(submap.submap_id):
            row["track"].append({"submap": names.submap(submap.submap_id), "xy": piece})
    return [rows[name] for name in sorted(rows)]


def track_piece(record: SubmapRecord, T_view_group: SE2) -> list[list[float]]:
    """Way of a vehicle while a submap was made; empty where that is not known, or withdrawn."""
    submap = record.submap
    if record.state is SubmapState.WITHDRAWN or not len(submap.trajectory):
        return []
    motion = T_view_group @ record.T_component_submap
    return _thinned(motion.apply(submap.trajectory[:, :2]))


def submap_row(
    record: SubmapRecord, outline: FloatArray, T_view_group: SE2, names: Names
) -> dict[str, Any]:
    """One submap."""
    submap = record.submap
    motion = T_view_group @ record.T_component_submap
    return {
        "name": names.submap(submap.submap_id),
        "id": list(submap.submap_id),
        "vehicle": names.track(submap.submap_id.track),
        "state": record.state.name.lower(),
        "group": record.component,
        "revision": submap.revision,
        "is_final": submap.is_final,
        "stamp_s": submap.stamp_ns * 1e-9,
        "reason": record.reason,
        "at": _rounded(motion.as_array()),
        "outline": _rounded(motion.apply(outline)) if len(outline) else [],
    }


def constraint_row(
    constraint: Constraint, places: Mapping[SubmapId, tuple[int, SE2]], names: Names
) -> dict[str, Any] | None:
    """One edge of the pose graph between two submaps that are shown, else None."""
    if constraint.source not in places or constraint.target not in places:
        return None
    (group, source), (other, target) = places[constraint.source], places[constraint.target]
    return {
        "kind": constraint.kind.name.lower(),
        "ends": [list(constraint.source), list(constraint.target)],
        "source": names.submap(constraint.source),
        "target": names.submap(constraint.target),
        "group": group if group == other else None,
        "line": _rounded(np.array([[source.x, source.y], [target.x, target.y]])),
        "residual_m": _number(constraint.residual_m),
        "residual_deg": _number(math.degrees(constraint.residual_rad)),
        "is_inlier": constraint.is_inlier,
        "is_unsure": constraint.is_unsure,
    }


def registration_row(
    number: int, answer: Answer, is_used: bool, sides: Mapping[str, str], names: Names
) -> dict[str, Any]:
    """One answer in a line; `sides` name its ``source`` and ``target``."""
    motion, numbers = answer.T_target_source, answer.numbers
    sigma = np.sqrt(np.maximum(np.diag(answer.covariance), 0.0))
    return {
        "number": number,
        **sides,
        "references": [list(answer.query.source.reference), list(answer.query.target.reference)],
        "runs": [
            names.track(group.reference.track)
            for group in (answer.query.source, answer.query.target)
        ],
        "verdict": answer.verdict.name,
        "reason": answer.why,
        "is_used": is_used,
        "probability": _number(answer.probability),
        "pose": None if motion is None else _rounded(motion.as_array(), 4),
        "look": look_of(answer),
        "sigma": [_number(value) for value in sigma],
        "numbers": {name: _number(value) for name, value in sorted(numbers.items())},
        "submaps": sorted(
            {names.submap(i) for i in (*answer.query.source.ids, *answer.query.target.ids)}
        ),
    }


def look_of(answer: Answer) -> str | None:
    """Name of what both maps look like as an answer lays them; None where it has no pose."""
    if answer.T_target_source is None:
        return None
    told = repr((answer.query.key, answer.T_target_source)).encode()
    return hashlib.blake2b(told, digest_size=8).hexdigest()


def decision_row(
    record: DecisionRecord, places: Mapping[SubmapId, tuple[int, SE2]], names: Names
) -> dict[str, Any]:
    """One decision, in words, and where it is drawn."""
    decision = record.decision
    ends = [end for end in (decision.source, decision.target) if end is not None]
    name = names.track if decision.is_run else names.submap
    shown = [name(end.track if decision.is_run else end) for end in ends]  # type: ignore[arg-type]
    groups = {places[end][0] for end in ends if end in places}
    at: FloatArray | None = None
    if ends and not decision.is_run and len(groups) == 1 and all(e in places for e in ends):
        poses = [places[end][1] for end in ends]
        at = np.mean([pose.apply(np.array(decision.point)) for pose in poses], axis=0)
    return {
        "number": decision.number,
        "kind": decision.kind.name.lower(),
        "who": decision.who,
        "stamp_s": decision.stamp_ns * 1e-9,
        "ends": shown,
        "is_run": decision.is_run,
        "undone": decision.undone,
        "is_in_force": record.is_in_force,
        "remark": names.in_text(record.remark),
        "at": None if at is None else _rounded(at),
    }


def _thinned(points: FloatArray) -> list[list[float]]:
    """Points at least so far apart, the last one kept."""
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    bins = np.floor(length / _TRACK_STEP_M)
    keep = np.concatenate([[True], bins[1:] != bins[:-1]])
    keep[-1] = True
    return _rounded(points[keep])


def _rounded(values: FloatArray, digits: int = 3) -> Any:
    return np.round(values, digits).tolist()


def _number(value: float) -> float | None:
    """JSON has no NaN."""
    return round(float(value), 6) if math.isfinite(value) else None
