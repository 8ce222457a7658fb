"""The last pass of ``offline``: the chart, drawn from all pings at the settled graph's poses."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.cli.outcome import Outcome, VehicleOutcome
from uw_dslam_ros2.core.chart.drawing import PingTrack, draw_chart, refined
from uw_dslam_ros2.core.chart.pings import DrawnPing
from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.findings import Finding
from uw_dslam_ros2.core.mapping.config import OccupancyConfig
from uw_dslam_ros2.core.merging import SubmapRecord, SubmapState
from uw_dslam_ros2.core.merging.config import LOG_ODDS_MAX
from uw_dslam_ros2.core.se2 import wrap_angle
from uw_dslam_ros2.core.submap import Submap, SubmapId, Track

__all__ = ["PingTracks", "chart_tracks", "charted"]

FloatArray = NDArray[np.float64]
Tell = Callable[[Finding], None]
Pings = Mapping[SubmapId, Sequence[DrawnPing]]
PingTracks = dict[Track, PingTrack]


def charted(
    outcome: Outcome, pings: Pings, config: OccupancyConfig, tell: Tell | None = None
) -> Outcome:
    """The outcome with its global map drawn anew, and the trajectories that belong to that.

    Parameters
    ----------
    pings
        Of every submap.
    config
        The sensor model; cells are as large as those of the map that is replaced.
    tell
        Called with what the walls show to be wrong.
    """
    before, after = chart_tracks(outcome, pings)
    if outcome.global_map is None or not after:
        return outcome
    if tell is not None:
        for track, pings_of_track in after.items():
            if pings_of_track.range_scale != 1.0:
                tell(_too_long(track.vehicle_id, pings_of_track.range_scale))
    resolution_m = outcome.global_map.spec.resolution_m
    config = dataclasses.replace(config, resolution_m=resolution_m)
    try:
        chart = draw_chart(list(after.values()), config, LOG_ODDS_MAX)
    except InvalidInputError as error:
        if tell is not None:
            tell(Finding("no_chart", "", f"{error}; the map is the sum of the submaps instead"))
        return outcome
    vehicles = tuple(_bent(vehicle, before, after) for vehicle in outcome.vehicles)
    return dataclasses.replace(outcome, global_map=chart, vehicles=vehicles)


def _too_long(vehicle_id: str, range_scale: float) -> Finding:
    return Finding(
        "sound_speed",
        "sonar",
        f"walls that it saw from several places meet where its ranges are taken "
        f"{100.0 * (1.0 - range_scale):.1f} % shorter, as with a speed of sound that is too high "
        "for colder or fresher water; the chart is drawn so, and all is mapped so with "
        f"conventions.sonar_range_scale: {range_scale:.3f}",
        0.9,
        vehicle_id=vehicle_id,
    )


def chart_tracks(outcome: Outcome, pings: Pings) -> tuple[PingTracks, PingTracks]:
    """Pings of the merged submaps: at the graph's poses, and at refined ones."""
    before = _tracks_of(outcome.records, pings)
    if outcome.global_map is None or not before:
        return {}, {}
    after = refined(list(before.values()), outcome.global_map.spec.resolution_m)
    return before, dict(zip(before, after, strict=True))


def _tracks_of(records: Sequence[SubmapRecord], pings: Pings) -> PingTracks:
    """Pings of each run's merged submaps, where the settled graph places them."""
    kept: dict[Track, list[DrawnPing]] = {}
    poses: dict[Track, list[FloatArray]] = {}
    for record in records:
        submap_id = record.submap.submap_id
        if record.state is not SubmapState.MERGED:
            continue
        for ping in pings.get(submap_id, ()):
            pose = record.T_component_submap @ ping.T_submap_sonar
            kept.setdefault(submap_id.track, []).append(ping)
            poses.setdefault(submap_id.track, []).append(pose.as_array())
    return {
        track: PingTrack(
            kept[track],
            np.array(poses[track]),
            **_drift([r.submap for r in records if r.submap.submap_id.track == track]),
        )
        for track in kept
    }


def _drift(submaps: Sequence[Submap]) -> dict[str, float]:
    """What navigation says a path gains on one metre, of a run's submaps in their order."""
    found = []
    for before, after in itertools.pairwise(submaps):
        way_m = float(np.hypot(*np.diff(before.trajectory[:, :2], axis=0).T).sum())
        if after.sequence == before.sequence + 1 and way_m > 0.0:
            found.append(np.diag(after.covariance) / way_m)
    if not found:
        return {}
    x, y, yaw = np.median(found, axis=0)
    return {"drift_m": math.sqrt(0.5 * (x + y)), "drift_rad": math.sqrt(yaw)}


def _bent(vehicle: VehicleOutcome, before: PingTracks, after: PingTracks) -> VehicleOutcome:
    """Move the trajectory as its pings were moved; between them in proportion."""
    own = [track for track in before if track.vehicle_id == vehicle.vehicle_id]
    if vehicle.trajectory is None or not own:
        return vehicle
    stamps_ns, poses = vehicle.trajectory
    ping_ns = np.concatenate([before[track].stamps_ns for track in own])
    moved = np.vstack([_moved(before[track], after[track]) for track in own])
    order = np.argsort(ping_ns, kind="stable")
    # Relative to the first: nanoseconds since 1970 do not fit a double.
    start_ns = int(ping_ns.min())
    at, known = stamps_ns - start_ns, ping_ns[order] - start_ns
    new = poses + np.column_stack([np.interp(at, known, column) for column in moved[order].T])
    new[:, 2] = wrap_angle(new[:, 2])
    return dataclasses.replace(vehicle, trajectory=(stamps_ns, new))


def _moved(before: PingTrack, after: PingTrack) -> FloatArray:
    """How each pose (K, 3) of the vehicle changes; the sonar's turn on it is no heading."""
    moved = after.T_map_sonar - before.T_map_sonar
    moved[:, 2] = wrap_angle(moved[:, 2] - after.mounting_rad)
    return moved
