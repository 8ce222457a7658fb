"""Maps from files into one map, by the map queue: the core of ``merge`` and ``register --merge``.

Each map is to the queue what a vehicle with one closed submap is: nothing is known of how two of
them lie. A submap's frame is put into the middle of what the map knows, because far from it, where
an origin in UTM would be, a small doubt of the angle is a large one of the place.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uw_dslam_ros2.cli.reporting.outcome import Outcome, outcome_of
from uw_dslam_ros2.cli.running.mapping import Counter, OfflineConfig, settle
from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap, bounds_of
from uw_dslam_ros2.core.merging import MapProvenance, MapQueue, MapQueueConfig, SubmapRecord
from uw_dslam_ros2.core.merging.drawn.global_map import pinned_lattice
from uw_dslam_ros2.core.merging.graph.answers import Answer, Query
from uw_dslam_ros2.core.merging.graph.submap_groups import SubmapGroup
from uw_dslam_ros2.core.pose_graph import compose_covariance, invert_covariance
from uw_dslam_ros2.core.registration import (
    GridRegistrationConfig,
    RegistrationResult,
    register_grids,
)
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap
from uw_dslam_ros2.io.maps.image import MAX_SIDE

__all__ = ["MapFile", "MergedMaps", "Placement", "Settler", "VerdictRow", "merge_maps", "told"]

Settler = Callable[[MapQueue], None]
"""Answers all that a queue asks."""


@dataclass(frozen=True, slots=True, eq=False)
class MapFile:
    """A map with a name of its own."""

    name: str
    path: Path
    occupancy: OccupancyMap

    @property
    def T_map_submap(self) -> SE2:  # noqa: N802 (notation of motions)
        """The corner of a cell in the middle of what is known; axes as the map's frame."""
        first, last = _known_box(self.occupancy)
        spec = self.occupancy.spec
        middle = (first + last) // 2 * spec.resolution_m
        x, y = spec.T_frame_grid.apply(middle[::-1].astype(np.float64))
        return SE2(float(x), float(y))

    def submap(self) -> Submap:
        """What the queue takes: the known part, certain of nothing but itself."""
        first, last = _known_box(self.occupancy)
        spec, resolution_m = self.occupancy.spec, self.occupancy.spec.resolution_m
        values = self.occupancy.values[first[0] : last[0], first[1] : last[1]]
        corner = SE2(float(first[1]) * resolution_m, float(first[0]) * resolution_m)
        T_submap_grid = self.T_map_submap.inverse() @ spec.T_frame_grid @ corner
        part = GridSpec(resolution_m, values.shape[0], values.shape[1], T_submap_grid)
        grid = OccupancyMap(part, np.ascontiguousarray(values))
        return Submap(self.name, 0, 0, True, 0, SE2(), np.zeros((3, 3)), grid)


@dataclass(frozen=True, slots=True)
class VerdictRow:
    """One registration of two maps, or of groups of maps that were joined before.

    The pose is ``T_target_source`` of the maps named first, in metres and radians in their own
    frames; ``sigma_m`` is the largest standard deviation of the place of the source's middle.
    NaN: not known.
    """

    source: str
    target: str
    verdict: str
    is_used: bool
    x: float
    y: float
    yaw: float
    sigma_m: float
    sigma_rad: float
    probability: float
    overlap: float
    conflict_ratio: float
    is_certified: bool
    has_prior: bool
    reason: str


@dataclass(frozen=True, slots=True)
class Placement:
    """Where a map came to lie: in the frame of the first map of its group; group 0 is merged."""

    name: str
    group: int
    T_group_map: SE2
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class MergedMaps:
    """What became of some maps.

    ``merged`` and ``provenance`` lie in the frame of the map `frame`; both are None where no two
    maps were joined, for a copy of one map is not a merged one. `outcome` is for pictures: its
    frames are those of the submaps.
    """

    maps: tuple[MapFile, ...]
    frame: str
    merged: OccupancyMap | None
    provenance: MapProvenance | None
    rows: tuple[VerdictRow, ...]
    placements: tuple[Placement, ...]
    outcome: Outcome

    @property
    def joined(self) -> list[Placement]:
        """Maps in the merged one; none where there is no merged one."""
        return [] if self.merged is None else [p for p in self.placements if p.group == 0]

    @property
    def apart(self) -> list[Placement]:
        """The others."""
        return [p for p in self.placements if self.merged is None or p.group > 0]


def merge_maps(
    maps: Sequence[MapFile],
    config: OfflineConfig,
    *,
    settler: Settler | None = None,
    progress: Counter | None = None,
) -> MergedMaps:
    """Merge maps; the same maps in the same order give the same result.

    Parameters
    ----------
    maps
        Two and more. The first one that is joined gives the merged map its frame and its cells.
    config
        Settings of registration and queue. Where the queue's ``resolution_m`` is 0 the merged map
        has the finest cells of the maps that it is made of.
    settler
        Answers the queue; by default `register_grids` does.
    progress
        Is told how many pairs are done, of how many.

    Raises
    ------
    InvalidInputError
        Where the merged map would have more than 20,000 cells a side.
    """
    limit = max(config.queue.max_submap_cells, MAX_SIDE**2)
    queue_config = dataclasses.replace(config.queue, max_submap_cells=limit)
    queue = MapQueue(queue_config)
    for one in maps:
        queue.add_submap(one.submap())
    if settler is not None:
        settler(queue)
    else:
        settle(queue, config.registration, progress)
    queue = _with_cells(_in_frame_of_first(queue, maps, queue_config), config)
    outcome = outcome_of(queue)
    by_name = {one.name: one for one in maps}
    anchor = queue.to_state().anchor
    assert anchor is not None  # it is the first submap's at least
    frame = by_name[anchor[0]]
    is_joined = outcome.num_merged_vehicles > 1
    merged, provenance = outcome.global_map, outcome.provenance
    if not is_joined or merged is None or provenance is None:
        merged, provenance = None, None
    else:
        spec = _moved(merged.spec, frame.T_map_submap)
        merged = OccupancyMap(spec, merged.values)
        provenance = dataclasses.replace(provenance, spec=spec)
    rows = tuple(_row(answer, is_used, by_name) for answer, is_used in queue.answers())
    placements = _placements(outcome.records, by_name, anchor[0])
    return MergedMaps(tuple(maps), frame.name, merged, provenance, rows, placements, outcome)


def told(
    source: MapFile,
    target: MapFile,
    result: RegistrationResult,
    config: GridRegistrationConfig,
) -> Settler:
    """Answer a queue of two maps with what is known of them already, in their own frames."""
    held = result
    motion = result.T_target_source
    if motion is not None:
        before, after = target.T_map_submap.inverse(), source.T_map_submap
        held = dataclasses.replace(
            result,
            T_target_source=before @ motion @ after,
            covariance=compose_covariance(result.covariance, before, motion, after),
        )

    def settle_two(queue: MapQueue) -> None:
        while requests := queue.next_requests(1):
            request = requests[0]
            if request.prior is not None:
                answer = register_grids(
                    request.source, request.target, config, prior=request.prior
                )
            elif request.source_reference[0] == source.name:
                answer = held
            else:
                answer = _inverted(held)
            queue.add_result(request.request_id, answer)

    return settle_two


def _inverted(result: RegistrationResult) -> RegistrationResult:
    motion = result.T_target_source
    if motion is None:
        return result
    return dataclasses.replace(
        result,
        T_target_source=motion.inverse(),
        covariance=invert_covariance(result.covariance, motion),
    )


def _known_box(occupancy: OccupancyMap) -> tuple[np.ndarray, np.ndarray]:
    """First and last (exclusive) cell [row, col] of what is known; all where nothing is."""
    box = bounds_of(occupancy.known)
    if box is None:
        return np.zeros(2, np.int64), np.array(occupancy.spec.shape)
    return np.array([along.start for along in box]), np.array([along.stop for along in box])


def _in_frame_of_first(
    queue: MapQueue, maps: Sequence[MapFile], config: MapQueueConfig
) -> MapQueue:
    """The same with the frame of the first map that is joined, or else of the first."""
    component = {record.submap.vehicle_id: record.component for record in queue.submaps()}
    numbers = list(component.values())
    joined = [one.name for one in maps if numbers.count(component[one.name]) > 1]
    name = config.anchor_vehicle or (joined[0] if joined else maps[0].name)
    state = dataclasses.replace(queue.to_state(), anchor=None, lattice=None, is_pinned=False)
    moved = MapQueue.from_state(state, dataclasses.replace(config, anchor_vehicle=name))
    moved.submaps()  # pins the frame
    return moved


def _with_cells(queue: MapQueue, config: OfflineConfig) -> MapQueue:
    """The same queue, drawing on cells of the finest map that is joined, or of the chosen size."""
    state = queue.to_state()
    joined = [record for record in queue.submaps() if record.component == 0]
    specs = [record.submap.grid.spec for record in joined]
    resolution_m = config.queue.resolution_m or min(spec.resolution_m for spec in specs)
    pinning = next(s for s in state.submaps if s.submap_id == state.anchor).grid.spec
    lattice = pinned_lattice(pinning, resolution_m)
    T_lattice_map = lattice.T_frame_grid.inverse()
    corners = [
        T_lattice_map.apply(r.T_component_submap.apply(r.submap.grid.spec.corners()))
        for r in joined
    ]
    size = np.ptp(np.concatenate(corners), axis=0) / resolution_m
    if size.max() > MAX_SIDE:
        raise InvalidInputError(
            f"the merged map would have {size[0]:.0f} x {size[1]:.0f} cells of {resolution_m} m, "
            f"expected at most {MAX_SIDE} a side: choose larger cells by --resolution"
        )
    limit = max(config.queue.max_submap_cells, MAX_SIDE**2)
    return MapQueue.from_state(
        dataclasses.replace(state, lattice=lattice, is_pinned=True),
        dataclasses.replace(config.queue, max_submap_cells=limit),
    )


def _moved(spec: GridSpec, T_map_submap: SE2) -> GridSpec:
    T_map_grid = T_map_submap @ spec.T_frame_grid
    # Rounding errors would make -10.000000000000002 of the origin that the map came with.
    tidy = SE2(round(T_map_grid.x, 9), round(T_map_grid.y, 9), round(T_map_grid.yaw, 12))
    return dataclasses.replace(spec, T_frame_grid=tidy)


def _row(answer: Answer, is_used: bool, maps: dict[str, MapFile]) -> VerdictRow:
    query: Query = answer.query
    found = answer.T_target_source
    x = y = yaw = math.nan
    if found is not None:
        T_target_submap = maps[query.target.reference[0]].T_map_submap
        T_submap_source = maps[query.source.reference[0]].T_map_submap.inverse()
        motion = T_target_submap @ found @ T_submap_source
        x, y, yaw = motion.x, motion.y, motion.yaw
    covariance = np.asarray(answer.covariance)
    sigma_m = sigma_rad = math.nan
    if found is not None and np.isfinite(covariance).all():
        sigma_m = math.sqrt(max(0.0, float(np.linalg.eigvalsh(covariance[:2, :2])[-1])))
        sigma_rad = math.sqrt(max(0.0, float(covariance[2, 2])))
    numbers = answer.numbers
    return VerdictRow(
        _group_name(query.source),
        _group_name(query.target),
        answer.verdict.name,
        is_used,
        x,
        y,
        yaw,
        sigma_m,
        sigma_rad,
        float(answer.probability),
        numbers.get("overlap", math.nan),
        numbers.get("conflict_ratio", math.nan),
        bool(numbers.get("is_certified", False)),
        query.prior is not None,
        answer.why,
    )


def _group_name(group: SubmapGroup) -> str:
    """Its maps, the one whose frame it has first."""
    first = group.reference.vehicle_id
    names = [submap_id.vehicle_id for submap_id in group.ids]
    return " + ".join([first, *(name for name in names if name != first)])


def _placements(
    records: Sequence[SubmapRecord], maps: dict[str, MapFile], anchor: str
) -> tuple[Placement, ...]:
    by_name = {record.submap.vehicle_id: record for record in records}
    first: dict[int, str] = {by_name[anchor].component: anchor}
    for name in maps:  # in the order given
        first.setdefault(by_name[name].component, name)
    found = []
    for name, one in maps.items():
        record = by_name[name]
        head = first[record.component]
        T_head_component = by_name[head].T_component_submap.inverse()
        T_group_map = (
            maps[head].T_map_submap
            @ T_head_component
            @ record.T_component_submap
            @ one.T_map_submap.inverse()
        )
        is_empty = not one.occupancy.known.any()
        reason = "the map knows nothing" if is_empty else record.reason
        found.append(Placement(name, record.component, T_group_map, reason))
    return tuple(found)
