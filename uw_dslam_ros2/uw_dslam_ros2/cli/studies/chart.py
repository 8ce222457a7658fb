"""Why walls in the chart are as thick as they are: each stage of drawing replaced by its ideal.

Simulated missions are mapped and merged as by `offline`; then the chart is drawn again with true
poses, true echoes, narrow beams and so on in the place of what was found. Thickness in cells,
agreement with the true walls within 0.25 m and cell by cell, walls that are none, and walls that
are missing.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from uw_dslam_ros2.cli.common import num_processors
from uw_dslam_ros2.cli.reporting.outcome import outcome_of
from uw_dslam_ros2.cli.reporting.scoring import WALL_TOLERANCE_M
from uw_dslam_ros2.cli.running.charting import chart_tracks, charted
from uw_dslam_ros2.cli.running.mapping import OfflineConfig, map_recordings, settle
from uw_dslam_ros2.cli.studies._common import print_table, progress, write_csv
from uw_dslam_ros2.core.chart.drawing import PingTrack, draw_chart
from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.grid import UNITS_PER_NAT, OccupancyMap
from uw_dslam_ros2.core.mapping.config import OccupancyConfig
from uw_dslam_ros2.core.mapping.drawing.log_odds_grid import LogOddsGrid
from uw_dslam_ros2.core.mapping.drawing.occupancy import GrowingGrid
from uw_dslam_ros2.core.merging import MapQueue
from uw_dslam_ros2.core.merging.config import LOG_ODDS_MAX
from uw_dslam_ros2.core.metrics import compare_maps, map_sharpness, trajectory_error
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Track
from uw_dslam_ros2.io.maps.files import read_map
from uw_dslam_ros2.io.sensor_settings import SensorConfig
from uw_dslam_ros2.io.trajectories import read_tum
from uw_dslam_ros2.io.vehicles import find_recordings
from uw_dslam_ros2.sim.missions.mission import (
    T_BASE_SONAR,
    Mission,
    MissionConfig,
    VehicleRun,
    plan_mission,
)
from uw_dslam_ros2.sim.missions.recording import simulate_mission
from uw_dslam_ros2.sim.waters.places import PLACES

__all__ = ["add_arguments", "run"]

Row = dict[str, Any]
Tracks = Mapping[Track, PingTrack]
_NUM_NARROW = 10
_THRESHOLDS_PERCENT = (50, 60, 70, 80, 90, 97)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the study."""
    parser.add_argument("--seeds", type=int, default=1, help="missions (%(default)s)")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--place", choices=PLACES, default="harbour")
    parser.add_argument("--vehicles", type=int, default=MissionConfig().num_vehicles)
    parser.add_argument("--duration", type=float, default=MissionConfig().duration_s, metavar="S")


def run(args: argparse.Namespace) -> int:
    """Simulate, map, draw again and again; print the means over missions, save every row."""
    rows: list[Row] = []
    for seed in progress(range(args.first_seed, args.first_seed + args.seeds), text="missions"):
        config = MissionConfig(
            seed=seed,
            place=args.place,
            num_vehicles=args.vehicles,
            duration_s=args.duration,
        )
        with tempfile.TemporaryDirectory() as work:
            rows += [{"seed": seed, **row} for row in _stages(config, Path(work))]
        write_csv(args.out / "chart.csv", rows)
    stages = list(dict.fromkeys(row["stage"] for row in rows))
    table = []
    for stage in stages:
        own = [row for row in rows if row["stage"] == stage]
        means = {key: np.mean([row[key] for row in own]) for key in own[0] if key in _FORMATS}
        table.append([stage, *(f"{means[key]:{form}}" for key, form in _FORMATS.items())])
    print_table(["drawn with", *_FORMATS], table)
    return 0


_FORMATS = {
    "thickness [cells]": ".2f",
    "IoU 0.25 m": ".3f",
    "IoU cell": ".3f",
    "wrong walls [%]": ".1f",
    "recall": ".3f",
    "MSE": ".4f",
    "SSIM": ".3f",
}


@dataclass(frozen=True, slots=True, eq=False)
class _Mapped:
    """A mission, what became of it, and what is true."""

    mission: Mission
    summed_map: OccupancyMap
    graph: Tracks
    tracks: Tracks
    truth_map: OccupancyMap
    T_truth_graph: SE2
    T_truth_map: SE2
    occupancy: OccupancyConfig

    def run_of(self, track: Track) -> VehicleRun:
        """What the simulator knows of a vehicle."""
        return next(r for r in self.mission.runs if r.vehicle_id == track.vehicle_id)

    def row(self, stage: str, drawn: OccupancyMap, T_truth_map: SE2) -> Row:
        """Score one map."""
        error = compare_maps(drawn, self.truth_map, T_truth_map, tolerance_m=WALL_TOLERANCE_M)
        return {
            "stage": stage,
            "thickness [cells]": map_sharpness(drawn).wall_thickness_cells,
            "IoU 0.25 m": error.wall_iou_tolerant,
            "IoU cell": error.wall_iou,
            "wrong walls [%]": 100.0 * (1.0 - error.wall_precision),
            "recall": error.wall_recall,
            "MSE": error.mse,
            "SSIM": error.ssim,
        }


def _map_mission(config: MissionConfig, work: Path) -> _Mapped:
    recorded = simulate_mission(work / "mission", config, num_processes=num_processors())
    recordings, _ = find_recordings(recorded.bags, lambda _: SensorConfig(), {})
    settings = OfflineConfig.read(None, [r.vehicle_id for r in recordings])
    mapped = map_recordings(recordings, settings)
    queue = MapQueue(settings.queue)
    for made in mapped:
        for submap in made.submaps:
            queue.add_submap(submap)
    settle(queue, settings.registration)
    summed = outcome_of(queue)
    pings = {key: own for made in mapped for key, own in made.pings.items()}
    occupancy = settings.mapper[mapped[0].vehicle_id].occupancy
    if summed.global_map is None:
        raise DataError(f"seed {config.seed}: nothing was mapped")
    graph, tracks = chart_tracks(summed, pings)
    chart = charted(summed, pings, occupancy)
    truth = {path.stem: read_tum(path) for path in recorded.truth_trajectories}
    return _Mapped(
        plan_mission(config),
        summed.global_map,
        graph,
        tracks,
        read_map(recorded.truth_map),
        trajectory_error(summed.trajectories(), truth).T_truth_map,
        trajectory_error(chart.trajectories(), truth).T_truth_map,
        occupancy,
    )


def _stages(config: MissionConfig, work: Path) -> Iterator[Row]:
    mapped = _map_mission(config, work)
    T_graph, T_chart = mapped.T_truth_graph, mapped.T_truth_map
    true, found = _true_poses(mapped), dict(mapped.tracks)
    calibrated = {
        name: _scaled(track, 1.0 / mapped.run_of(name).range_scale)
        for name, track in _true_poses(mapped, is_mounting_known=True).items()
    }
    echoes = _with_true_echoes(mapped, found)
    narrow = {name: _narrowed(track) for name, track in found.items()}
    best = _with_true_echoes(mapped, calibrated)
    same = SE2()

    def draw(tracks: Tracks) -> OccupancyMap:
        drawn = draw_chart(list(tracks.values()), mapped.occupancy, LOG_ODDS_MAX)
        assert drawn is not None
        return drawn

    yield mapped.row("sum of rigid submaps, as merged live", mapped.summed_map, T_graph)
    yield mapped.row("last pass, poses of the graph", draw(mapped.graph), T_graph)
    chart = draw(found)
    yield mapped.row("last pass, poses refined: offline's chart", chart, T_chart)
    yield mapped.row("the same with true poses", draw(true), same)
    yield mapped.row("... also true mounting and speed of sound", draw(calibrated), same)
    yield mapped.row("chart with true echoes", draw(echoes), T_chart)
    yield mapped.row("chart with beams a tenth as wide", draw(narrow), T_chart)
    yield mapped.row("chart, an echo marks its own cell alone", _plain(mapped), T_chart)
    yield _best_threshold(mapped, "chart, best threshold of drawing", chart)
    yield mapped.row("all true: poses, mounting, sound, echoes", draw(best), same)


def _true_poses(mapped: _Mapped, *, is_mounting_known: bool = False) -> Tracks:
    """Where the sonar really was, mounted as the recording says or as it really was."""
    result = {}
    for name, track in mapped.tracks.items():
        run = mapped.run_of(name)
        motion = run.motion.at(track.stamps_ns)
        T_base_sonar = run.T_base_sonar if is_mounting_known else T_BASE_SONAR
        poses = [(motion.pose(i) @ T_base_sonar).as_array() for i in range(len(motion.stamp_ns))]
        result[name] = PingTrack(track.pings, np.array(poses))
    return result


def _with_true_echoes(mapped: _Mapped, tracks: Tracks) -> Tracks:
    """Each echo at the range of the first wall along its beam; those that met none are dropped."""
    world, max_range_m = mapped.mission.world, mapped.mission.config.sonar.max_range_m
    result = {}
    for name, track in tracks.items():
        run = mapped.run_of(name)
        motion = run.motion.at(track.stamps_ns)
        pings = []
        for i, ping in enumerate(track.pings):
            pose = motion.pose(i) @ run.T_base_sonar
            bearing = np.arctan2(ping.points[:, 1], ping.points[:, 0]).astype(np.float64)
            hits = world.cast((pose.x, pose.y), pose.yaw + bearing, max_range_m)
            is_hit = np.isfinite(hits.range_m)
            ranges, angles = hits.range_m[is_hit], bearing[is_hit]
            points = np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles)])
            pings.append(
                dataclasses.replace(
                    ping, points=points.astype(np.float32), weight=ping.weight[is_hit]
                )
            )
        result[name] = dataclasses.replace(track, pings=pings)
    return result


def _scaled(track: PingTrack, factor: float) -> PingTrack:
    """All ranges times a factor."""
    scale = np.float32(factor)
    pings = [
        dataclasses.replace(p, points=scale * p.points, free_range_m=scale * p.free_range_m)
        for p in track.pings
    ]
    return dataclasses.replace(track, pings=pings)


def _narrowed(track: PingTrack) -> PingTrack:
    """Beams of a tenth of the width, ten in the place of each: the same water, sharper echoes."""
    pings = []
    for ping in track.pings:
        width_rad = ping.beamwidth_rad / _NUM_NARROW
        offsets = (np.arange(_NUM_NARROW) - 0.5 * (_NUM_NARROW - 1)) * width_rad
        pings.append(
            dataclasses.replace(
                ping,
                bearing_rad=(ping.bearing_rad[:, None] + offsets).ravel(),
                free_range_m=np.repeat(ping.free_range_m, _NUM_NARROW),
                beamwidth_rad=width_rad,
            )
        )
    return dataclasses.replace(track, pings=pings)


def _plain(mapped: _Mapped) -> OccupancyMap:
    """No crests: log-odds of an echo in the one cell where it lies, of water before it."""
    config = mapped.occupancy
    water, echoes = GrowingGrid(config), []
    for track in mapped.tracks.values():
        for ping, pose in zip(track.pings, track.T_map_sonar, strict=True):
            seen, T_map_sonar = ping.detections(), SE2.from_array(pose)
            echoes.append(T_map_sonar.apply(seen.points))
            none = dataclasses.replace(seen, points=seen.points[:0], weight=seen.weight[:0])
            water.add(none, T_map_sonar)
    seen_water = water.trimmed()
    spec = seen_water.spec
    margin = round(5.0 / spec.resolution_m)
    log_odds = np.pad(seen_water.log_odds, margin)
    observed = np.pad(seen_water.observed, margin)
    cells = spec.cells_of(np.vstack(echoes)) + margin
    cells = cells[((cells >= 0) & (cells < log_odds.shape)).all(axis=1)]
    np.add.at(log_odds, tuple(cells.T), round(config.hit_log_odds * UNITS_PER_NAT))
    observed[tuple(cells.T)] = True
    corner = seen_water.row - margin, seen_water.col - margin
    drawn = LogOddsGrid(log_odds, observed, *corner, spec.resolution_m)
    return drawn.to_occupancy(LOG_ODDS_MAX)


def _best_threshold(mapped: _Mapped, stage: str, chart: OccupancyMap) -> Row:
    """Of several thresholds above which a cell is a wall, the one that the truth likes best."""
    rows = []
    for percent in _THRESHOLDS_PERCENT:
        values = chart.values.copy()
        values[(values > 50) & (values <= percent)] = 50
        drawn = OccupancyMap(chart.spec, values)
        rows.append(mapped.row(f"{stage} ({percent} %)", drawn, mapped.T_truth_map))
    found = max(rows, key=lambda row: row["IoU 0.25 m"])
    return {**found, "stage": stage}
