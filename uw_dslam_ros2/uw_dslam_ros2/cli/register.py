"""``register A.yaml B.yaml``: align two maps, with proof, picture and an exit code."""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from uw_dslam_ros2.cli.common import parser_for, run_command, warn
from uw_dslam_ros2.cli.reporting.outcome import json_bytes
from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.registration import (
    GridRegistrationConfig,
    PriorWindow,
    RegistrationResult,
    Verdict,
    register_grids,
)
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.atomic import write_files
from uw_dslam_ros2.io.maps.files import read_map
from uw_dslam_ros2.io.settings import SettingsFile

__all__ = ["EXIT_CODES", "main"]

EXIT_CODES = {
    Verdict.ACCEPTED: 0,
    Verdict.TOO_FEW_FEATURES: 3,
    Verdict.NOT_ENOUGH_OVERLAP: 4,
    Verdict.AMBIGUOUS: 5,
    Verdict.CONTRADICTED: 6,
    Verdict.BUDGET_EXHAUSTED: 7,
    Verdict.IMPROBABLE: 8,
}
"""Exit code for each verdict; 1 is an unexpected error, 2 wrong usage or input."""


def main(argv: Sequence[str] | None = None) -> int:
    """Align and print; the exit code tells the verdict."""
    args = _parser().parse_args(argv)
    return run_command("register", lambda: _run(args))


def _parser() -> argparse.ArgumentParser:
    parser = parser_for(
        "register",
        "Find the motion that lays map A (the source) on map B (the target), both map_server\n"
        "files, without a guess at it. Exit code: "
        + ", ".join(f"{code} {verdict.name}" for verdict, code in EXIT_CODES.items())
        + ";\n2 wrong usage or input.",
        "register submaps/auv_1_0.yaml submaps/auv_2_1.yaml --out overlay.png",
    )
    parser.add_argument("source", type=Path, metavar="A.yaml")
    parser.add_argument("target", type=Path, metavar="B.yaml")
    parser.add_argument("--out", type=Path, metavar="PNG", help="picture of A laid on B")
    parser.add_argument(
        "--merge",
        type=Path,
        metavar="DIR",
        help="write the merged map in B's frame, picture and verdict, as the command merge does",
    )
    parser.add_argument(
        "--prior",
        type=float,
        nargs=3,
        metavar=("X", "Y", "YAW"),
        help="search only near this pose of A in B [m, m, rad]; needs --window",
    )
    parser.add_argument(
        "--window",
        type=float,
        nargs=2,
        metavar=("M", "RAD"),
        help="half widths of the search around the prior [m, rad]",
    )
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings (YAML)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    return parser


def _run(args: argparse.Namespace) -> int:
    prior = _prior(args)
    config = SettingsFile(args.config).section(
        GridRegistrationConfig, "registration", "/registration_server"
    )
    source, target = read_map(args.source, warn), read_map(args.target, warn)
    result = register_grids(source, target, config, prior=prior, clock=time.monotonic)
    if args.json:
        sys.stdout.write(json_bytes(_plain(result)).decode())
    else:
        print("\n".join(_lines(result)))
    if args.merge is not None:
        _merge(args, source, target, result)
    if args.out is not None:
        # Drawing takes longer to import than many a search takes.
        from uw_dslam_ros2.cli.reporting.pictures import overlay, png_bytes

        motion = result.T_target_source
        if motion is None:
            print("no picture: there is no pose to draw", file=sys.stderr)
            return EXIT_CODES[result.verdict]
        state = "" if result.is_accepted else ": refused, this is only the best guess"
        title = (
            f"{result.verdict.name}{state}\nx {motion.x:.2f} m, y {motion.y:.2f} m, "
            f"yaw {math.degrees(motion.yaw):.2f} degrees"
        )
        write_files({args.out: png_bytes(overlay(source, target, motion, title))})
        if not args.json:
            print(f"picture: {args.out}")
    return EXIT_CODES[result.verdict]


def _merge(
    args: argparse.Namespace,
    source: OccupancyMap,
    target: OccupancyMap,
    result: RegistrationResult,
) -> None:
    """Write what ``merge`` writes, with the answer that was told."""
    from uw_dslam_ros2.cli.merge import names_of, write_merged
    from uw_dslam_ros2.cli.running.map_merging import MapFile, merge_maps, told
    from uw_dslam_ros2.cli.running.mapping import OfflineConfig

    paths = [args.target, args.source]
    occupancies = [target, source]
    maps = [MapFile(*one) for one in zip(names_of(paths), paths, occupancies, strict=True)]
    config = OfflineConfig.read(args.config, [])
    settler = told(maps[1], maps[0], result, config.registration)
    merged = merge_maps(maps, config, settler=settler)
    write_merged(args.merge, merged, config)
    if not args.json:
        print(f"merged map in {args.merge}" if merged.joined else f"not merged, see {args.merge}")


def _prior(args: argparse.Namespace) -> PriorWindow | None:
    if (args.prior is None) != (args.window is None):
        _parser().error("--prior and --window go together")
    if args.prior is None:
        return None
    half_width_m, half_width_rad = args.window
    if not (half_width_m > 0.0 and 0.0 < half_width_rad <= math.pi):
        _parser().error(
            f"--window is {half_width_m} {half_width_rad}, expected metres > 0 and radians in "
            "(0, pi]"
        )
    return PriorWindow(SE2(*args.prior), half_width_m, half_width_rad)


def _lines(result: RegistrationResult) -> list[str]:
    motion = result.T_target_source
    if motion is None:
        return [f"{result.verdict.name}, refused before any pose was judged: {result.reason}"]
    sigma_x, sigma_y, sigma_yaw = np.sqrt(np.maximum(np.diag(result.covariance), 0.0))
    note = "" if result.is_accepted else "   (refused: the best guess, not to be used)"
    certainty = ""
    if result.is_accepted:
        certainty = ", certified" if result.is_certified else ", NOT certified"
    proof = "complete" if result.is_certified else "NOT complete"
    lines = [
        f"{result.verdict.name}{certainty}: {result.reason}",
        f"T_B_A: x {motion.x:.3f} m, y {motion.y:.3f} m, "
        f"yaw {motion.yaw:.5f} rad ({math.degrees(motion.yaw):.2f} degrees){note}",
        f"standard deviations: x {sigma_x:.3f} m, y {sigma_y:.3f} m, yaw {sigma_yaw:.5f} rad",
        f"probability that it is right: {result.probability:.4f}",
        f"proof {proof}: score {result.score:.4f}, the best of all poses lies in "
        f"[{result.lower_bound:.4f}, {result.upper_bound:.4f}], gap {100.0 * result.gap:.2f} %, "
        f"{result.num_boxes} boxes, {result.seconds:.2f} s",
        f"overlap {result.overlap:.3f}, conflict {result.conflict_ratio:.3f}, "
        f"inliers {result.inlier_ratio:.3f}, points {result.num_source_points} and "
        f"{result.num_target_points}",
    ]
    for rival in result.rivals:
        other = rival.T_target_source
        lines.append(
            f"rival: x {other.x:.3f} m, y {other.y:.3f} m, yaw {other.yaw:.5f} rad, "
            f"{100.0 * rival.score:.0f} % of the score"
        )
    return lines


def _plain(result: RegistrationResult) -> dict[str, Any]:
    names = (
        "probability",
        "score",
        "lower_bound",
        "upper_bound",
        "gap",
        "is_certified",
        "num_boxes",
        "seconds",
        "overlap",
        "conflict_ratio",
        "inlier_ratio",
        "num_source_points",
        "num_target_points",
    )
    motion = result.T_target_source
    return {
        "verdict": result.verdict.name,
        "reason": result.reason,
        "T_target_source": None if motion is None else motion.as_array().tolist(),
        "covariance": np.asarray(result.covariance).tolist(),
        **{name: getattr(result, name) for name in names},
        "rivals": [
            {
                "T_target_source": rival.T_target_source.as_array().tolist(),
                "score": rival.score,
                "upper_bound": rival.upper_bound,
            }
            for rival in result.rivals
        ],
    }


if __name__ == "__main__":
    sys.exit(main())
