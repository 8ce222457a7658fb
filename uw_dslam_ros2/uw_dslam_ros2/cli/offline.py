"""``offline BAG...``: from bags to one map without ROS, the same bytes each time."""

from __future__ import annotations

import argparse
import dataclasses
import math
import statistics
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from uw_dslam_ros2.cli.common import parser_for, progress_bar, run_command, versions
from uw_dslam_ros2.cli.reporting.outcome import Outcome, outcome_of
from uw_dslam_ros2.cli.reporting.report import RunFacts, headline, write_report
from uw_dslam_ros2.cli.reporting.scoring import Truth, read_truth
from uw_dslam_ros2.cli.running.charting import charted
from uw_dslam_ros2.cli.running.mapping import OfflineConfig, map_recordings, sensor_config, settle
from uw_dslam_ros2.core.errors import ConfigError, DataError, NothingMappedError
from uw_dslam_ros2.core.findings import Finding
from uw_dslam_ros2.core.merging import Decision, Georeference, MapQueue
from uw_dslam_ros2.io.fixes import fixes_of_recordings
from uw_dslam_ros2.io.heap import give_back, keep_apart
from uw_dslam_ros2.io.sensor_settings import SensorConfig, TopicsConfig
from uw_dslam_ros2.io.sessions.session import (
    SESSION_FOLDER,
    load_session,
    save_session,
    session_of,
)
from uw_dslam_ros2.io.settings import SettingsFile
from uw_dslam_ros2.io.vehicles import find_recordings

__all__ = ["about_fixes", "left_out", "main"]

_MAX_SHARE_ASIDE = 0.05
"""Of fixes, that are set aside without a warning: acoustic ones have such outliers."""
_OTHER_DEPTH_M = 1.0  # a sonar's beam is about as high, a few metres away


def main(argv: Sequence[str] | None = None) -> int:
    """Map bags and merge them; exit code 0 also where some vehicles could not be merged.

    1 where nothing could be mapped, 2 for bad input.
    """
    args = _parser().parse_args(argv)
    return run_command("offline", lambda: _run(args))


def _parser() -> argparse.ArgumentParser:
    parser = parser_for(
        "offline",
        "Map each vehicle's bag, merge the maps, and write maps, trajectories and a report.\n"
        "Uses no ROS and no clock: the same bags and settings give the same files.",
        "offline mission/auv_1 mission/auv_2 mission/auv_3 --out result",
    )
    parser.add_argument(
        "bags",
        nargs="*",
        type=Path,
        metavar="BAG",
        help="recordings: one for each vehicle, one of all, or several of one",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="result folder")
    parser.add_argument(
        "--config", type=Path, metavar="FILE", help="settings (YAML, as for the nodes)"
    )
    parser.add_argument(
        "--truth",
        type=Path,
        metavar="DIR",
        help="true trajectories (<vehicle>.tum) and map (map.yaml), only for scoring "
        "(default: the folder 'truth' beside the first bag, where there is one)",
    )
    parser.add_argument(
        "--topic",
        action="append",
        default=[],
        metavar="ROLE=TOPIC",
        help="which topic is the sonar, velocity, imu, depth, odometry or fix, where it is not "
        "found by its type; without a first slash it is below each vehicle's namespace",
    )
    parser.add_argument(
        "--vehicle",
        action="append",
        default=[],
        metavar="NAME=BAG[,BAG...]",
        help="bags of one vehicle, and its name, where topics do not tell",
    )
    parser.add_argument(
        "--fixes",
        type=float,
        metavar="SIGMA_M",
        help="have positions on earth (NavSatFix, USBL) pull the map, each with at least this "
        "standard deviation [m] (default: they are not used)",
    )
    parser.add_argument(
        "--decisions",
        type=Path,
        metavar="FOLDER",
        help="take over what people decided about an earlier result of the same bags",
    )
    parser.add_argument("--title", default="", help="name of the run in the report")
    parser.add_argument("--no-report", action="store_true", help="no pictures, no HTML")
    return parser


def _run(args: argparse.Namespace) -> int:
    started_s = time.monotonic()
    keep_apart()
    if args.fixes is not None and not 0.0 < args.fixes < math.inf:
        raise ConfigError(f"--fixes is {args.fixes}, expected metres > 0")
    named = _named_bags(args.vehicle)
    bags = [*args.bags, *(bag for own in named.values() for bag in own)]
    if not bags:
        raise DataError("no bags are named; expected at least one")
    if missing := [bag for bag in bags if not bag.exists()]:
        raise DataError(f"{missing[0]} does not exist; expected a recording")
    file = SettingsFile(args.config)
    topics = TopicsConfig.of_options(args.topic)
    decisions = () if args.decisions is None else _decisions(args.decisions)

    def settings_of(vehicle_id: str) -> SensorConfig:
        own = sensor_config(file, vehicle_id)
        return dataclasses.replace(own, topics=topics.over(own.topics))

    recordings, findings = find_recordings(args.bags, settings_of, named)
    vehicles = [recording.vehicle_id for recording in recordings]
    config = OfflineConfig.read(args.config, vehicles)
    config = dataclasses.replace(config, sensors={v: settings_of(v) for v in vehicles})
    truth = _truth(args, bags[0])

    say(f"mapping {len(vehicles)} vehicles")
    with progress_bar("mapping", " messages") as progress:
        mapped = map_recordings(recordings, config, progress)
    mapped_s = time.monotonic()
    findings += [finding for made in mapped for finding in made.findings]
    unmapped = [made.vehicle_id for made in mapped if not made.submaps]
    if len(unmapped) == len(mapped):
        raise NothingMappedError("; ".join(f.sentence for f in findings if f.severity == "error"))

    queue = MapQueue(config.queue)
    for made in mapped:
        for submap in made.submaps:
            queue.add_submap(submap)
    for decision in decisions:
        queue.decide(decision)
    give_back()
    say(f"merging {len(queue.submaps())} submaps")
    with progress_bar("registering", " pairs") as progress:
        settle(queue, config.registration, progress)
    if args.fixes is not None:  # nothing that is asked depends on them
        events = {made.vehicle_id: made.fixes for made in mapped}
        submaps = [submap for made in mapped for submap in made.submaps]
        queue.add_fixes(fixes_of_recordings(events, submaps, args.fixes))
    merged_s = time.monotonic()
    give_back()

    outcome = dataclasses.replace(outcome_of(queue), unmapped=tuple(unmapped))
    findings += left_out(outcome, {made.vehicle_id: made.depth_m for made in mapped})
    if args.fixes is not None:
        findings += about_fixes(outcome.georeference or queue.why_no_georeference())
    save_session(args.out / SESSION_FOLDER, queue)  # for view, and to go on from
    del queue  # as large as all maps together
    give_back()
    pings = {key: own for made in mapped for key, own in made.pings.items()}
    occupancy = config.mapper[mapped[0].vehicle_id].occupancy
    outcome = charted(outcome, pings, occupancy, findings.append)
    diagnostics = {made.vehicle_id: made.diagnostics for made in mapped}
    del mapped, made, pings
    facts = RunFacts(
        title=args.title or "offline: " + ", ".join(vehicles),
        source=[bag.name for bag in bags],
        command="offline",
        settings=config.to_dict(),
        seeds={},
        versions=versions(),
        diagnostics=diagnostics,
        notes=[finding.sentence for finding in findings if finding.severity != "info"],
        findings=[finding.to_dict() for finding in findings],
    )
    for note in facts.notes:
        print(f"warning: {note}", file=sys.stderr, flush=True)
    give_back()
    scores = write_report(args.out, outcome, facts, truth, has_pictures=not args.no_report)
    done_s = time.monotonic()
    say(
        f"mapping {mapped_s - started_s:.0f} s, merging {merged_s - mapped_s:.0f} s, "
        f"writing {done_s - merged_s:.0f} s"
    )
    print(headline(outcome, scores))
    print(f"results in {args.out}" + ("" if args.no_report else f", see {args.out}/report.html"))
    return 0


def left_out(outcome: Outcome, depths_m: Mapping[str, float] | None = None) -> list[Finding]:
    """What of the vehicles has no place in the common map.

    `depths_m` is how deep each was for most of the time, NaN where that is not known.
    """
    depths_m = depths_m or {}
    merged = [v.vehicle_id for v in outcome.vehicles if v.is_merged]
    common_m = [depths_m[v] for v in merged if math.isfinite(depths_m.get(v, math.nan))]
    found = []
    for vehicle in outcome.vehicles:
        num_left = vehicle.num_submaps - vehicle.num_merged
        if not num_left:
            continue
        what = f"{num_left} of its submaps have" if vehicle.is_merged else "it has"
        found.append(
            Finding(
                "partly_merged" if vehicle.is_merged else "not_merged",
                "",
                f"{what} no place in the common map, for no registration is sure enough "
                f"({vehicle.reason}); does its sonar see walls that others see?"
                + _at_another_depth(depths_m.get(vehicle.vehicle_id, math.nan), common_m),
                vehicle_id=vehicle.vehicle_id,
            )
        )
    return found


def _at_another_depth(depth_m: float, common_m: Sequence[float]) -> str:
    """What to add of a vehicle that dives above or below all of those that have a common map."""
    apart_m = [depth_m - other for other in common_m]
    nearest_m = min(apart_m, key=abs, default=0.0)
    if not abs(nearest_m) >= _OTHER_DEPTH_M or min(apart_m) * max(apart_m) < 0.0:
        return ""
    side = "deeper" if nearest_m > 0.0 else "higher"
    return f" It dives {abs(nearest_m):.1f} m {side} than they do, and may meet other walls there"


def about_fixes(found: Georeference | str) -> list[Finding]:
    """What became of the fixes that were to be used."""
    if isinstance(found, str):
        return [Finding("no_georeference", "fix", f"the map has no place on earth: {found}")]
    aside = [fit.metres_off for fit in found.fits if not fit.is_used]
    if not aside:
        return []
    return [
        Finding(
            "fixes_set_aside",
            "fix",
            f"{len(aside)} of {len(found.fits)} positions contradict the others or the map, by "
            f"{statistics.median(aside):.1f} m in the median, and do not count; is the standard "
            "deviation that --fixes gives too small?",
            severity="warning" if len(aside) > _MAX_SHARE_ASIDE * len(found.fits) else "info",
        )
    ]


def _named_bags(options: Sequence[str]) -> dict[str, list[Path]]:
    named: dict[str, list[Path]] = {}
    for text in options:
        name, is_set, bags = text.partition("=")
        if not is_set or not all(bags.split(",")):
            raise ConfigError(f"vehicle {text!r}: expected NAME=BAG, or NAME=BAG,BAG")
        named.setdefault(name, []).extend(Path(bag) for bag in bags.split(","))
    return named


def _decisions(folder: Path) -> tuple[Decision, ...]:
    return load_session(session_of(folder)).to_state().decisions


def _truth(args: argparse.Namespace, first_bag: Path) -> Truth | None:
    if args.truth is not None:
        return read_truth(args.truth)
    beside = first_bag.resolve().parent / "truth"
    return read_truth(beside) if beside.is_dir() else None


def say(text: str) -> None:
    """One line of progress."""
    print(f"offline: {text}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
