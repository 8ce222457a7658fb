"""What came out of a mapping run: the one form that offline, demo, pictures and report share."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.cli.reporting.decision_rows import DecisionRow
from uw_dslam_ros2.cli.reporting.looks import looks_of
from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.merging import (
    Constraint,
    Georeference,
    LoopError,
    MapProvenance,
    MapQueue,
    MapQueueConfig,
    SubmapRecord,
    SubmapState,
)
from uw_dslam_ros2.core.merging.graph.answers import Answer
from uw_dslam_ros2.core.run_names import RunNames
from uw_dslam_ros2.core.submap import Submap, SubmapId, Track
from uw_dslam_ros2.io.atomic import write_files
from uw_dslam_ros2.io.earth import geotiff_bytes
from uw_dslam_ros2.io.maps.files import write_map
from uw_dslam_ros2.io.maps.provenance import write_provenance
from uw_dslam_ros2.io.pose_graphs import pose_graph_bytes
from uw_dslam_ros2.io.trajectories import write_tum
from uw_dslam_ros2.view.pairs import Pair

__all__ = ["Outcome", "RegistrationRow", "VehicleOutcome", "outcome_of", "write_outcome"]

FloatArray = NDArray[np.float64]
Trajectory = tuple[NDArray[np.int64], FloatArray]

_AS_GIVEN = RunNames(())


@dataclass(frozen=True, slots=True)
class RegistrationRow:
    """One registration as it is listed; lengths in metres, angles in radians, NaN: not known.

    ``x``, ``y``, ``yaw`` are T_target_source: they take what lies in the frame of submap
    ``source_frame`` to that of submap ``target_frame``; the sigmas are in the target's frame.
    """

    number: int
    source: str
    target: str
    source_frame: str
    target_frame: str
    verdict: str
    reason: str
    is_used: bool
    x: float
    y: float
    yaw: float
    sigma_x: float
    sigma_y: float
    sigma_yaw: float
    probability: float
    score: float
    lower_bound: float
    upper_bound: float
    gap: float
    is_certified: bool
    num_boxes: int
    overlap: float
    conflict_ratio: float
    inlier_ratio: float
    num_source_points: int
    num_target_points: int
    has_prior: bool

    @classmethod
    def of(
        cls, number: int, answer: Answer, is_used: bool, names: RunNames = _AS_GIVEN
    ) -> RegistrationRow:
        """Flatten an answer."""
        motion, numbers = answer.T_target_source, answer.numbers
        x, y, yaw = (math.nan,) * 3 if motion is None else (motion.x, motion.y, motion.yaw)
        sigma_x, sigma_y, sigma_yaw = np.sqrt(np.maximum(np.diag(answer.covariance), 0.0))
        upper = numbers.get("upper_bound", math.nan)
        lower = numbers.get("lower_bound", math.nan)
        return cls(
            number,
            names_of(answer.query.source.ids, names),
            names_of(answer.query.target.ids, names),
            names.submap(answer.query.source.reference),
            names.submap(answer.query.target.reference),
            answer.verdict.name,
            answer.why,
            is_used,
            x,
            y,
            yaw,
            float(sigma_x),
            float(sigma_y),
            float(sigma_yaw),
            float(answer.probability),
            numbers.get("score", math.nan),
            lower,
            upper,
            (upper - lower) / upper if upper > 0.0 else math.nan,
            bool(numbers.get("is_certified", False)),
            int(numbers.get("num_boxes", 0)),
            numbers.get("overlap", math.nan),
            numbers.get("conflict_ratio", math.nan),
            numbers.get("inlier_ratio", math.nan),
            int(numbers.get("num_source_points", 0)),
            int(numbers.get("num_target_points", 0)),
            answer.query.prior is not None,
        )


@dataclass(frozen=True, slots=True, eq=False)
class VehicleOutcome:
    """One vehicle: what it made alone, and where that lies in the global map (None: nowhere)."""

    vehicle_id: str
    own_map: OccupancyMap
    own_trajectory: Trajectory
    trajectory: Trajectory | None
    num_submaps: int
    num_merged: int
    reason: str

    @property
    def is_merged(self) -> bool:
        """Whether any of it is in the global map."""
        return self.num_merged > 0

    def path_length_m(self) -> float:
        """Way travelled."""
        return float(np.hypot(*np.diff(self.own_trajectory[1][:, :2], axis=0).T).sum())


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """Everything that a run found out; no clock and no file in it."""

    vehicles: tuple[VehicleOutcome, ...]
    records: tuple[SubmapRecord, ...]
    constraints: tuple[Constraint, ...]
    global_map: OccupancyMap | None
    registrations: tuple[RegistrationRow, ...]
    provenance: MapProvenance | None = None
    loops: tuple[LoopError, ...] = ()
    decisions: tuple[DecisionRow, ...] = ()
    unmapped: tuple[str, ...] = ()
    """Vehicles of which there is no map at all."""
    georeference: Georeference | None = None
    looks: tuple[tuple[int, Pair], ...] = ()
    """Of a few registrations, by number: both maps laid on each other."""

    @property
    def names(self) -> RunNames:
        """Of the vehicles' runs, for people."""
        return RunNames(record.submap for record in self.records)

    @property
    def num_vehicles(self) -> int:
        """All, those without a map included."""
        return len(self.vehicles) + len(self.unmapped)

    @property
    def num_merged_vehicles(self) -> int:
        """Vehicles with a place in the global map."""
        return sum(vehicle.is_merged for vehicle in self.vehicles)

    def trajectories(self) -> dict[str, Trajectory]:
        """Of the merged vehicles, in the global frame."""
        return {v.vehicle_id: v.trajectory for v in self.vehicles if v.trajectory is not None}

    def verdict_counts(self) -> dict[str, int]:
        """How many registrations ended how, by name."""
        verdicts = [row.verdict for row in self.registrations]
        return {verdict: verdicts.count(verdict) for verdict in sorted(set(verdicts))}


def names_of(ids: Iterable[SubmapId], names: RunNames = _AS_GIVEN) -> str:
    """Submaps as text: ``auv_1/0-3`` for four of one vehicle."""
    by_track: dict[Track, list[int]] = {}
    for submap_id in ids:
        by_track.setdefault(submap_id.track, []).append(submap_id.sequence)
    return " + ".join(
        f"{names.track(t)}/{_ranges(sorted(s))}" for t, s in sorted(by_track.items())
    )


def _ranges(numbers: list[int]) -> str:
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][-1] + 1:
            parts[-1].append(number)
        else:
            parts.append([number])
    return ",".join(str(p[0]) if len(p) == 1 else f"{p[0]}-{p[-1]}" for p in parts)


def outcome_of(queue: MapQueue) -> Outcome:
    """Take everything out of a queue that has settled."""
    records = queue.submaps()
    names = RunNames(record.submap for record in records)
    trajectories = queue.trajectories()
    vehicles = []
    for vehicle_id in sorted({record.submap.vehicle_id for record in records}):
        own = [record for record in records if record.submap.vehicle_id == vehicle_id]
        own_map, own_trajectory = _alone([record.submap for record in own])
        merged = [record for record in own if record.state is SubmapState.MERGED]
        others = [record for record in own if record.state is not SubmapState.MERGED]
        vehicles.append(
            VehicleOutcome(
                vehicle_id,
                own_map,
                own_trajectory,
                trajectories.get(vehicle_id) if merged else None,
                len(own),
                len(merged),
                names.in_text((others or merged)[0].reason),
            )
        )
    return Outcome(
        tuple(vehicles),
        tuple(records),
        tuple(queue.constraints()),
        queue.global_map(),
        tuple(
            RegistrationRow.of(number, answer, is_used, names)
            for number, (answer, is_used) in enumerate(queue.answers(), start=1)
        ),
        queue.provenance(),
        tuple(queue.loops()),
        tuple(DecisionRow.of(record, names) for record in queue.decisions()),
        georeference=queue.georeference(),
        looks=looks_of(queue.answers(), records),
    )


def _alone(submaps: list[Submap]) -> tuple[OccupancyMap, Trajectory]:
    """One vehicle's map and trajectory without any other, in the frame of its first submap."""
    largest = max(submap.grid.values.size for submap in submaps)  # a queue has taken them before
    queue = MapQueue(MapQueueConfig(max_submap_cells=max(largest, 16_000_000)))
    for submap in submaps:
        queue.add_submap(submap)
    occupancy = queue.global_map()
    if occupancy is None:  # nothing is known
        occupancy = submaps[0].grid
    stamps_poses = queue.trajectories().get(submaps[0].vehicle_id)
    if stamps_poses is None:
        stamps_poses = np.empty(0, np.int64), np.empty((0, 3))
    return occupancy, stamps_poses


def write_outcome(folder: Path, outcome: Outcome) -> None:
    """Write maps, submaps, trajectories, pose graph and registrations; same input, same bytes.

    ``global_map.*``, ``vehicle_maps/<vehicle>.*``, ``submaps/<vehicle>_<sequence>.*`` and
    ``submaps/submaps.json``, ``trajectories/<vehicle>.tum`` (global frame) and
    ``trajectories/<vehicle>_alone.tum``, ``pose_graph.g2o``, ``pose_graph.json`` (all edges, with
    what became of them, and the cycles), ``registrations.json`` and ``.csv``,
    ``global_map_contradictions.png`` and ``global_map_provenance.npz``, and where there are fixes
    ``global_map.tif`` in their coordinates. Vertices of the graph are numbered as in
    ``submaps.json``.
    """
    if outcome.global_map is not None:
        write_map(folder / "global_map", outcome.global_map)
    if outcome.provenance is not None:
        write_provenance(folder / "global_map", outcome.provenance)
    for vehicle in outcome.vehicles:
        name = vehicle.vehicle_id
        write_map(folder / "vehicle_maps" / name, vehicle.own_map)
        write_tum(folder / "trajectories" / f"{name}_alone.tum", *vehicle.own_trajectory)
        if vehicle.trajectory is not None:
            write_tum(folder / "trajectories" / f"{name}.tum", *vehicle.trajectory)
    names = outcome.names
    for record in outcome.records:
        submap = record.submap
        name = f"{names.file(submap.submap_id.track)}_{submap.sequence}"
        write_map(folder / "submaps" / name, submap.grid)
    rows = [_strict(asdict(row)) for row in outcome.registrations]
    write_files(
        {
            folder / "submaps" / "submaps.json": json_bytes(_submap_table(outcome)),
            folder / "registrations.json": json_bytes(rows),
            folder / "registrations.csv": _csv_bytes(rows),
            folder / "pose_graph.json": json_bytes(_graph_table(outcome)),
            folder / "pose_graph.g2o": pose_graph_bytes(
                (record for record in outcome.records if record.component == 0),
                outcome.constraints,
                {record.submap.submap_id: i for i, record in enumerate(outcome.records)},
            ),
        }
    )
    if outcome.global_map is not None and outcome.georeference is not None:
        found = outcome.georeference
        picture = geotiff_bytes(outcome.global_map, found.T_earth_map, found.earth_frame)
        write_files({folder / "global_map.tif": picture})


def json_bytes(content: Any) -> bytes:
    """Indented JSON that every reader takes: NaN becomes null."""
    return (json.dumps(_strict(content), indent=1, allow_nan=False) + "\n").encode()


def _strict(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _strict(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_strict(inner) for inner in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _csv_bytes(rows: list[dict[str, Any]]) -> bytes:
    text = io.StringIO()
    names = [field.name for field in fields(RegistrationRow)]
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()


def _submap_table(outcome: Outcome) -> list[dict[str, Any]]:
    names = outcome.names
    return [
        {
            "vehicle_id": record.submap.vehicle_id,
            "run": names.number(record.submap.submap_id.track),
            "run_id": record.submap.run_id,
            "sequence": record.submap.sequence,
            "revision": record.submap.revision,
            "state": record.state.name,
            "component": record.component,
            "T_component_submap": record.T_component_submap.as_array().tolist(),
            "num_tries": record.num_tries,
            "reason": names.in_text(record.reason),
        }
        for record in outcome.records
    ]


def _graph_table(outcome: Outcome) -> dict[str, Any]:
    """Edges with their residuals, the wrong and the unsure ones included, and cycles."""
    names = outcome.names
    return {
        "edges": [
            {
                "kind": c.kind.name,
                "source": names.submap(c.source),
                "target": names.submap(c.target),
                "T_target_source": c.T_target_source.as_array().tolist(),
                "covariance": c.covariance.tolist(),
                "residual_m": c.residual_m,
                "residual_rad": c.residual_rad,
                "is_inlier": c.is_inlier,
                "is_unsure": c.is_unsure,
            }
            for c in outcome.constraints
        ],
        "loops": [
            {
                "submaps": [names.submap(submap_id) for submap_id in loop.submaps],
                "error_m": loop.error_m,
                "error_deg": math.degrees(loop.error_rad),
            }
            for loop in outcome.loops
        ],
    }
