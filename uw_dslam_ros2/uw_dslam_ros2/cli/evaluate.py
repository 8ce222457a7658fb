"""``evaluate RESULT --truth TRUTH``: how far a result is from the truth."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

from uw_dslam_ros2.cli.common import parser_for, run_command
from uw_dslam_ros2.cli.reporting.outcome import Trajectory, json_bytes
from uw_dslam_ros2.cli.reporting.report import whose_error
from uw_dslam_ros2.cli.reporting.scoring import WALL_TOLERANCE_M, Scores, Truth, read_truth, score
from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.metrics import trajectory_error
from uw_dslam_ros2.io.maps.files import read_map
from uw_dslam_ros2.io.trajectories import read_tum

__all__ = ["main"]

_ALONE = "_alone"


def main(argv: Sequence[str] | None = None) -> int:
    """Print the scores; exit code 0, or 2 for bad input."""
    args = _parser().parse_args(argv)
    return run_command("evaluate", lambda: _run(args))


def _parser() -> argparse.ArgumentParser:
    parser = parser_for(
        "evaluate",
        "Compare a result of offline or demo (global_map.yaml, trajectories/) with the truth.\n"
        "One rigid motion for all vehicles together takes the result's frame to the truth's.",
        "evaluate uw_demo --truth uw_demo/recordings/truth",
    )
    parser.add_argument(
        "result", type=Path, metavar="RESULT", help="result folder, or the TUM file of one vehicle"
    )
    parser.add_argument(
        "--truth",
        type=Path,
        required=True,
        metavar="TRUTH",
        help="folder with <vehicle>.tum and perhaps map.yaml, or the TUM file of one vehicle",
    )
    parser.add_argument(
        "--beside",
        type=Path,
        metavar="FOLDER",
        help="folder with trajectories of other programs (TUM) of the same recording; each is "
        "scored in the same way, against the truth of the one vehicle that the truth has",
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    return parser


def _run(args: argparse.Namespace) -> int:
    trajectories, own = _trajectories(args.result)
    truth = read_truth(args.truth)
    if args.truth.is_file() and len(trajectories) == 1:
        # With one file on each side their names need not agree.
        truth.trajectories[next(iter(trajectories))] = next(iter(truth.trajectories.values()))
    if not set(trajectories) & set(truth.trajectories):
        raise DataError(
            f"{args.truth} has no trajectory of {', '.join(sorted(trajectories))}; "
            f"it has {', '.join(sorted(truth.trajectories))}"
        )
    map_file = args.result / "global_map.yaml"
    global_map = read_map(map_file) if map_file.is_file() else None
    scores = score(global_map, trajectories, own or trajectories, truth)
    others = {} if args.beside is None else _beside(args.beside, truth)
    if args.json:
        report = scores.to_dict()
        if others:
            report["rmse_m_of_others"] = others
        sys.stdout.write(json_bytes(report).decode())
    else:
        print("\n".join(_lines(scores)))
        if others:
            print(f"beside it, the trajectories in {args.beside}, RMSE after a motion of its own:")
        for name, rmse_m in sorted(others.items(), key=lambda item: item[1]):
            print(f"  {name}: {rmse_m:.3f} m")
    return 0


def _beside(folder: Path, truth: Truth) -> dict[str, float]:
    """Score each TUM file of a folder against the truth of the only vehicle; RMSE [m] by name."""
    if len(truth.trajectories) != 1:
        raise DataError(
            f"--beside needs a truth of one vehicle, this one has {len(truth.trajectories)}: "
            f"{', '.join(sorted(truth.trajectories))}"
        )
    files = sorted(folder.glob("*.tum"))
    if not files:
        raise DataError(f"{folder} holds no .tum file; expected one for each run")
    (true,) = truth.trajectories.values()
    return {file.stem: trajectory_error({"": read_tum(file)}, {"": true}).rmse_m for file in files}


def _trajectories(result: Path) -> tuple[dict[str, Trajectory], dict[str, Trajectory]]:
    """Return trajectories in the global frame, and each vehicle's own, by vehicle."""
    if result.is_file():
        return {result.stem: read_tum(result)}, {}
    files = sorted((result / "trajectories").glob("*.tum"))
    merged = {f.stem: read_tum(f) for f in files if not f.stem.endswith(_ALONE)}
    own = {f.stem.removesuffix(_ALONE): read_tum(f) for f in files if f.stem.endswith(_ALONE)}
    if not merged:
        raise DataError(
            f"{result} is no result: it has no trajectories/<vehicle>.tum, expected a folder that "
            "offline or demo wrote, or a TUM file"
        )
    return merged, own


def _whose(scores: Scores) -> str:
    assert scores.trajectory is not None
    scored = list(scores.trajectory.per_vehicle_rmse_m)
    return whose_error(scored, len({*scored, *scores.alone_rmse_m, *scores.without_truth}))


def _lines(scores: Scores) -> list[str]:
    lines = []
    error = scores.trajectory
    if error is not None:
        lines += [
            f"trajectories, {error.num_poses} poses {_whose(scores)}:",
            f"  RMSE {error.rmse_m:.3f} m, median {error.median_m:.3f} m, "
            f"largest {error.max_m:.3f} m, yaw RMSE {math.degrees(error.rmse_rad):.2f} degrees",
        ]
        for name, rmse_m in error.per_vehicle_rmse_m.items():
            alone = scores.alone_rmse_m.get(name, math.nan)
            lines.append(f"  {name}: {rmse_m:.3f} m (by itself {alone:.3f} m)")
    for name in scores.alone_rmse_m:
        if error is None or name not in error.per_vehicle_rmse_m:
            lines.append(f"  {name}: not merged (by itself {scores.alone_rmse_m[name]:.3f} m)")
    if scores.without_truth:
        lines.append(f"  without truth: {', '.join(scores.without_truth)}")
    if scores.map is not None:
        lines += [
            "map against the true one:",
            f"  MSE {scores.map.mse:.4f}, SSIM {scores.map.ssim:.3f}, wall IoU "
            f"{scores.map.wall_iou:.3f}, within {WALL_TOLERANCE_M} m "
            f"{scores.map.wall_iou_tolerant:.3f}",
            f"  walls that are right {scores.map.wall_precision:.3f}, true walls found "
            f"{scores.map.wall_recall:.3f}, seen area known {scores.map.coverage:.3f}",
        ]
    return lines


if __name__ == "__main__":
    sys.exit(main())
