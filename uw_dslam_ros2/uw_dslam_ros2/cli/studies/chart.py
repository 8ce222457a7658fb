"""Why walls in the chart are as thick as they are: each stage of drawing replaced by its ideal.

Simulated missions are mapped and merged as by `offline`; then the chart is drawn again with true
poses, true echoes, narrow beams and so on in the place of what was found. Thickness in cells,
agreement with the true walls within 0.25 m and cell by cell, walls that are none, walls that are
missing, and the error of the trajectories that the map was drawn along.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from uw_dslam_ros2.cli.common import num_processors
from uw_dslam_ros2.cli.reporting.outcome import Outcome, outcome_of
from uw_dslam_ros2.cli.reporting.scoring import WALL_TOLERANCE_M
from uw_dslam_ros2.cli.running.charting import chart_tracks, charted
from uw_dslam_ros2.cli.running.mapping import OfflineConfig, map_recordings, settle
from uw_dslam_ros2.cli.studies._common import print_table, progress, write_csv
from uw_dslam_ros2.core.chart.drawing import PingTrack, draw_chart
from uw_dslam_ros2.core.chart.pings import DrawnPing
from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.grid import UNITS_PER_NAT, OccupancyMap
from uw_dslam_ros2.core.mapping.config import OccupancyConfig
from uw_dslam_ros2.core.mapping.drawing.log_odds_grid import LogOddsGrid
from uw_dslam_ros2.core.mapping.drawing.occupancy import GrowingGrid
from uw_dslam_ros2.core.merging import MapQueue
from uw_dslam_ros2.core.merging.config import LOG_ODDS_MAX
from uw_dslam_ros2.core.metrics import (
    Trajectory,
    TrajectoryError,
    compare_maps,
    map_sharpness,
    trajectory_error,
)
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId, Track
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

__all__ = ["MappedMission", "add_arguments", "map_mission", "print_tables", "run", "stages"]

Row = dict[str, Any]
Tracks = Mapping[Track, PingTrack]
Pings = Mapping[SubmapId, Sequence[DrawnPing]]
_NUM_NARROW = 10
_THRESHOLDS_PERCENT = (50, 60, 70, 80, 90, 97)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the study."""
    parser.add_argument("--seeds", type=int, default=1, help="harbours (%(default)s)")
    parser.add_argument("--lakes", type=int, default=0, help="lakes beside them (%(default)s)")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--vehicles", type=int, default=MissionConfig().num_vehicles)
    parser.add_argument("--duration", type=float, default=MissionConfig().duration_s, metavar="S")


def run(args: argparse.Namespace) -> int:
    """Simulate, map, draw again and again; print means and missions, save every row."""
    rows: list[Row] = []
    missions = [(place, args.first_seed + i) for place, n in _counts(args) for i in range(n)]
    for place, seed in progress(missions, text="missions"):
        config = MissionConfig(
            seed=seed, place=place, num_vehicles=args.vehicles, duration_s=args.duration
        )
        with tempfile.TemporaryDirectory() as work:
            rows += stages(map_mission(config, Path(work)))
        write_csv(args.out / "chart.csv", rows)
    print_tables(rows)
    return 0


def _counts(args: argparse.Namespace) -> list[tuple[str, int]]:
    return [("harbour", args.seeds), ("lake", args.lakes)]


def print_tables(rows: Sequence[Row]) -> None:
    """Means of each stage over the missions, and of each mission what is before and after."""
    table = []
    for stage in dict.fromkeys(row["stage"] for row in rows):
        own = [row for row in rows if row["stage"] == stage]
        means = {key: np.mean([row[key] for row in own]) for key in _FORMATS}
        table.append([stage, *(f"{means[key]:{form}}" for key, form in _FORMATS.items())])
    print_table(["drawn with", *_FORMATS], table)
    table = [
        [
            row["mission"],
            row["merged"],
            name,
            *(f"{row[k]:{form}}" for k, form in _FORMATS.items()),
        ]
        for row in rows
        for stage, name in ((_LIVE, "live"), (_CHART, "chart"))
        if row["stage"] == stage
    ]
    print_table(["mission", "merged", "map", *_FORMATS], table)


_LIVE, _CHART = "sum of rigid submaps, as merged live", "last pass, poses refined: offline's chart"
_FORMATS = {
    "thickness [cells]": ".2f",
    "IoU 0.25 m": ".3f",
    "IoU cell": ".3f",
    "wrong walls [%]": ".1f",
    "recall": ".3f",
    "MSE": ".4f",
    "SSIM": ".3f",
    "trajectory [m]": ".3f",
}


@dataclass(frozen=True, slots=True, eq=False)
class MappedMission:
    """A mission, what became of it, and what is true."""

    mission: Mission
    outcome: Outcome
    pings: Pings
    truth_map: OccupancyMap
    truth: Mapping[str, Trajectory]
    occupancy: OccupancyConfig

    def run_of(self, track: Track) -> VehicleRun:
        """What the simulator knows of a vehicle."""
        return next(r for r in self.mission.runs if r.vehicle_id == track.vehicle_id)

    def draw(self, tracks: Tracks) -> OccupancyMap:
        """All pings in one map."""
        drawn = draw_chart(list(tracks.values()), self.occupancy, LOG_ODDS_MAX)
        if drawn is None:
            raise DataError(f"seed {self.mission.config.seed}: no ping was kept")
        return drawn

    def row(self, stage: str, drawn: OccupancyMap, placed: TrajectoryError | None = None) -> Row:
        """Score one map, placed as the trajectories are that it was drawn along; None: true."""
        T_truth_map = SE2() if placed is None else placed.T_truth_map
        error = compare_maps(drawn, self.truth_map, T_truth_map, tolerance_m=WALL_TOLERANCE_M)
        config, outcome = self.mission.config, self.outcome
        return {
            "mission": f"{config.place}, seed {config.seed}",
            "merged": f"{outcome.num_merged_vehicles} of {len(outcome.vehicles)}",
            "stage": stage,
            "thickness [cells]": map_sharpness(drawn).wall_thickness_cells,
            "IoU 0.25 m": error.wall_iou_tolerant,
            "IoU cell": error.wall_iou,
            "wrong walls [%]": 100.0 * (1.0 - error.wall_precision),
            "recall": error.wall_recall,
            "MSE": error.mse,
            "SSIM": error.ssim,
            "trajectory [m]": 0.0 if placed is None else placed.rmse_m,
        }


def map_mission(config: MissionConfig, work: Path) -> MappedMission:
    """Simulate a mission, map its vehicles, and merge them."""
    recorded = simulate_mission(work / "mission", config, num_processes=num_processors())
    recordings, _ = find_recordings(recorded.bags, lambda _: SensorConfig(), {})
    settings = OfflineConfig.read(None, [r.vehicle_id for r in recordings])
    mapped = map_recordings(recordings, settings)
    queue = MapQueue(settings.queue)
    for made in mapped:
        for submap in made.submaps:
            queue.add_submap(submap)
    settle(queue, settings.registration)
    return MappedMission(
        plan_mission(config),
        outcome_of(queue),
        {key: own for made in mapped for key, own in made.pings.items()},
        read_map(recorded.truth_map),
        {path.stem: read_tum(path) for path in recorded.truth_trajectories},
        settings.mapper[mapped[0].vehicle_id].occupancy,
    )


def stages(mapped: MappedMission) -> Iterator[Row]:
    """Rows of the maps that a mission gives, each stage of drawing replaced by its ideal."""
    if mapped.outcome.global_map is None:
        raise DataError(f"seed {mapped.mission.config.seed}: nothing was mapped")
    graph, found = chart_tracks(mapped.outcome, mapped.pings)
    chart, in_chart = _charted(mapped, mapped.pings)
    in_graph = trajectory_error(mapped.outcome.trajectories(), mapped.truth)
    draw, row = mapped.draw, mapped.row
    yield row(_LIVE, mapped.outcome.global_map, in_graph)
    yield row("last pass, poses of the graph", draw(graph), in_graph)
    yield row(_CHART, chart, in_chart)
    scales = {run.vehicle_id: 1.0 / run.range_scale for run in mapped.mission.runs}
    tuned = {
        key: [_scaled_ping(ping, scales[key.track.vehicle_id]) for ping in own]
        for key, own in mapped.pings.items()
    }
    yield row("the same, had the speed of sound been known", *_charted(mapped, tuned))
    yield row("with true poses", draw(_true_poses(mapped, found)))
    calibrated = {
        name: _scaled(track, 1.0 / mapped.run_of(name).range_scale)
        for name, track in _true_poses(mapped, found, is_mounting_known=True).items()
    }
    yield row("... also true mounting and speed of sound", draw(calibrated))
    yield row("chart with true echoes", draw(_with_true_echoes(mapped, found)), in_chart)
    narrow = {name: _narrowed(track) for name, track in found.items()}
    yield row("chart with beams a tenth as wide", draw(narrow), in_chart)
    plain = _plain(found, mapped.occupancy)
    yield row("chart, an echo marks its own cell alone", plain, in_chart)
    yield _best_threshold(mapped, "chart, best threshold of drawing", chart, in_chart)
    best = _with_true_echoes(mapped, calibrated)
    yield row("all true: poses, mounting, sound, echoes", draw(best))


def _charted(mapped: MappedMission, pings: Pings) -> tuple[OccupancyMap, TrajectoryError]:
    outcome = charted(mapped.outcome, pings, mapped.occupancy)
    if outcome.global_map is None:
        raise DataError(f"seed {mapped.mission.config.seed}: nothing was mapped")
    return outcome.global_map, trajectory_error(outcome.trajectories(), mapped.truth)


def _true_poses(
    mapped: MappedMission, tracks: Tracks, *, is_mounting_known: bool = False
) -> Tracks:
    """Where the sonar really was, mounted as the recording says or as it really was."""
    result = {}
    for name, track in tracks.items():
        run = mapped.run_of(name)
        motion = run.motion.at(track.stamps_ns)
        T_base_sonar = run.T_base_sonar if is_mounting_known else T_BASE_SONAR
        poses = [(motion.pose(i) @ T_base_sonar).as_array() for i in range(len(motion.stamp_ns))]
        result[name] = PingTrack(track.pings, np.array(poses))
    return result


def _with_true_echoes(mapped: MappedMission, tracks: Tracks) -> Tracks:
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
    return dataclasses.replace(track, pings=[_scaled_ping(p, factor) for p in track.pings])


def _scaled_ping(ping: DrawnPing, factor: float) -> DrawnPing:
    scale = np.float32(factor)
    return dataclasses.replace(
        ping, points=scale * ping.points, free_range_m=scale * ping.free_range_m
    )


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


def _plain(tracks: Tracks, config: OccupancyConfig) -> OccupancyMap:
    """No crests: log-odds of an echo in the one cell where it lies, of water before it."""
    water, echoes = GrowingGrid(config), []
    for track in tracks.values():
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


def _best_threshold(
    mapped: MappedMission, stage: str, chart: OccupancyMap, placed: TrajectoryError
) -> Row:
    """Of several thresholds above which a cell is a wall, the one that the truth likes best."""
    rows = []
    for percent in _THRESHOLDS_PERCENT:
        values = chart.values.copy()
        values[(values > 50) & (values <= percent)] = 50
        drawn = OccupancyMap(chart.spec, values)
        rows.append(mapped.row(f"{stage} ({percent} %)", drawn, placed))
    found = max(rows, key=lambda row: row["IoU 0.25 m"])
    return {**found, "stage": stage}
