"""Turn public recordings into bags, one for each vehicle."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from uw_dslam_ros2.cli.common import parser_for, progress_bar, run_command
from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.io.datasets.aracati2017 import (
    read_aracati2017,
    read_published_runs,
    write_bags,
)
from uw_dslam_ros2.io.trajectories import write_tum

__all__ = ["main"]


def _parser() -> argparse.ArgumentParser:
    parser = parser_for(
        "convert", __doc__ or "", "convert aracati2017 --data data/aracati2017 --out aracati"
    )
    parser.add_argument("dataset", choices=("aracati2017",), help="which recording")
    parser.add_argument("--data", type=Path, required=True, help="folder of the recording")
    parser.add_argument("--out", type=Path, required=True, help="folder to write the bags to")
    parser.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap")
    return parser


def _run(args: argparse.Namespace) -> int:
    for name in ("auv_1", "auv_2", "auv_3", "whole"):
        if (args.out / name).exists():
            raise DataError(f"{args.out / name} is there already; give another folder")
    recording = read_aracati2017(args.data)
    published = read_published_runs(args.data)
    with progress_bar("convert", "bag") as progress:
        bags = write_bags(recording, args.out, storage=args.storage, progress=progress)
    print(f"{len(bags)} bags: {', '.join(map(str, bags))}")
    print(f"truth (DGPS), only for scoring: {args.out / 'truth'}")
    for name, (stamps_ns, poses) in published.items():
        file = args.out / "published" / f"{name.replace(', ', '_').replace(' ', '_')}.tum"
        file.parent.mkdir(exist_ok=True)
        write_tum(file, stamps_ns, poses)
    if published:
        print(f"{len(published)} runs that others published: {args.out / 'published'}")
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; the exit code is 2 for bad input."""
    args = _parser().parse_args(argv)
    return run_command("convert", lambda: _run(args))


if __name__ == "__main__":
    sys.exit(main())
