"""The last pass of ``offline``: the chart, drawn from all pings at the settled graph's poses."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.cli.reporting.outcome import Outcome, VehicleOutcome
from uw_dslam_ros2.core.chart.drawing import PingTrack, draw_chart, refined
from uw_dslam_ros2.core.chart.pings import DrawnPing
from uw_dslam_ros2.core.chart.redraw import drift_of, moved_by
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
            if pings_of_track.told_scale != 1.0:
                tell(_too_long(track.vehicle_id, pings_of_track.told_scale))
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
    drifts: dict[Track, list[tuple[float, float]]] = {}
    runs: dict[Track, list[Submap]] = {}
    for record in records:
        runs.setdefault(record.submap.submap_id.track, []).append(record.submap)
    drift = {key: own for submaps in runs.values() for key, own in drift_of(submaps).items()}
    for record in records:
        submap_id = record.submap.submap_id
        if record.state is not SubmapState.MERGED:
            continue
        for ping in pings.get(submap_id, ()):
            pose = record.T_component_submap @ ping.T_submap_sonar
            kept.setdefault(submap_id.track, []).append(ping)
            poses.setdefault(submap_id.track, []).append(pose.as_array())
            drifts.setdefault(submap_id.track, []).append(drift[submap_id])
    return {
        track: PingTrack(kept[track], np.array(poses[track]), np.array(drifts[track]))
        for track in kept
    }


def _bent(vehicle: VehicleOutcome, before: PingTracks, after: PingTracks) -> VehicleOutcome:
    """Move the trajectory as its pings were moved; between them in proportion."""
    own = [track for track in before if track.vehicle_id == vehicle.vehicle_id]
    if vehicle.trajectory is None or not own:
        return vehicle
    stamps_ns, poses = vehicle.trajectory
    new = poses + moved_by([before[t] for t in own], [after[t] for t in own], stamps_ns)
    new[:, 2] = wrap_angle(new[:, 2])
    return dataclasses.replace(vehicle, trajectory=(stamps_ns, new))
