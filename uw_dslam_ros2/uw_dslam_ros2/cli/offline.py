"""``offline BAG...``: from bags to one map without ROS, the same bytes each time."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from uw_dslam_ros2.cli.common import parser_for, progress_bar, run_command, versions
from uw_dslam_ros2.cli.mapping import OfflineConfig, map_bags, settle, vehicle_of_bag
from uw_dslam_ros2.cli.outcome import outcome_of
from uw_dslam_ros2.cli.report import RunFacts, headline, write_report
from uw_dslam_ros2.cli.scoring import Truth, read_truth
from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.merging import MapQueue

__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Map bags and merge them; exit code 0 also where some vehicles could not be merged."""
    args = _parser().parse_args(argv)
    return run_command("offline", lambda: _run(args))


def _parser() -> argparse.ArgumentParser:
    parser = parser_for(
        "offline",
        "Map each vehicle's bag, merge the maps, and write maps, trajectories and a report.\n"
        "Uses no ROS and no clock: the same bags and settings give the same files.",
        "offline mission/auv_1 mission/auv_2 mission/auv_3 --out result",
    )
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="one for each vehicle")
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
    parser.add_argument("--title", default="", help="name of the run in the report")
    parser.add_argument("--no-report", action="store_true", help="no pictures, no HTML")
    return parser


def _run(args: argparse.Namespace) -> int:
    started_s = time.monotonic()
    vehicles = [vehicle_of_bag(bag) for bag in args.bags]
    for vehicle in vehicles:
        if vehicles.count(vehicle) > 1:
            raise DataError(f"two bags are of {vehicle}; expected one for each vehicle")
    config = OfflineConfig.read(args.config, vehicles)
    truth = _truth(args)

    say(f"mapping {len(vehicles)} vehicles")
    with progress_bar("mapping", " messages") as progress:
        mapped = map_bags(args.bags, config, progress)
    mapped_s = time.monotonic()

    queue = MapQueue(config.queue)
    for made in mapped:
        for submap in made.submaps:
            queue.add_submap(submap)
    say(f"merging {len(queue.submaps())} submaps")
    with progress_bar("registering", " pairs") as progress:
        settle(queue, config.registration, progress)
    merged_s = time.monotonic()

    facts = RunFacts(
        title=args.title or "offline: " + ", ".join(vehicles),
        source=[bag.name for bag in args.bags],
        command="offline",
        settings=config.to_dict(),
        seeds={},
        versions=versions(),
        diagnostics={made.vehicle_id: made.diagnostics for made in mapped},
    )
    outcome = outcome_of(queue)
    scores = write_report(args.out, outcome, facts, truth, has_pictures=not args.no_report)
    done_s = time.monotonic()
    say(
        f"mapping {mapped_s - started_s:.0f} s, merging {merged_s - mapped_s:.0f} s, "
        f"writing {done_s - merged_s:.0f} s"
    )
    print(headline(outcome, scores))
    print(f"results in {args.out}" + ("" if args.no_report else f", see {args.out}/report.html"))
    return 0


def _truth(args: argparse.Namespace) -> Truth | None:
    if args.truth is not None:
        return read_truth(args.truth)
    beside = args.bags[0].resolve().parent / "truth"
    return read_truth(beside) if beside.is_dir() else None


def say(text: str) -> None:
    """One line of progress."""
    print(f"offline: {text}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
