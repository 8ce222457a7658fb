"""How little overlap is too little: success, refusal and error of map registration over overlap.

Pairs of harbours, lakes, offices and caves, half of them again with maps of two places; each with
its proof. Writes a table, a CSV file, the curve and the reliability diagram.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path
from typing import Any

import numpy as np

from uw_dslam_ros2.cli.studies._common import (
    figure,
    print_table,
    progress,
    save_figure,
    write_csv,
)
from uw_dslam_ros2.cli.studies._map_pairs import PairSpec, is_right, pair_errors, pair_specs
from uw_dslam_ros2.core.registration.grids import register_grids

Row = dict[str, Any]
_FIRST_SEED = 2000  # others than those of `study verdict`


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this study."""
    parser.add_argument("--seeds", type=int, default=3, help="places of each kind (%(default)s)")
    parser.add_argument(
        "--kinds", nargs="+", default=["harbour", "lake", "office", "cave"], help="kinds of places"
    )
    parser.add_argument(
        "--overlaps", nargs="+", type=float, default=[0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0]
    )
    parser.add_argument("--noises", nargs="+", default=["clean", "noisy", "hard"])


def run(args: argparse.Namespace) -> int:
    """Register all pairs, print the table, draw."""
    specs = list(
        pair_specs(
            tuple(args.kinds),
            tuple(args.overlaps),
            tuple(args.noises),
            range(_FIRST_SEED, _FIRST_SEED + args.seeds),
        )
    )
    rows = [_registered(spec) for spec in progress(specs, text="pairs")]
    write_csv(args.out / "pairs.csv", rows)
    table = []
    for noise in args.noises:
        for overlap in args.overlaps:
            same = [
                r for r in rows if r["matching"] and (r["noise"], r["overlap"]) == (noise, overlap)
            ]
            if same:
                table.append((noise, f"{overlap:.0%}", len(same), *_shares(same)))
    print_table(
        ("noise", "overlap", "pairs", "right", "accepted, right", "accepted, wrong"), table
    )
    different = [r for r in rows if not r["matching"]]
    wrong = sum(r["accepted"] for r in different)
    print(f"maps of different places: {wrong} of {len(different)} accepted")
    seconds = [r["seconds"] for r in rows]
    print(f"time: median {np.median(seconds):.2f} s, p95 {np.quantile(seconds, 0.95):.2f} s")
    _draw_curve(args.out / "overlap.png", rows, args)
    _draw_reliability(args.out / "reliability.png", rows)
    return 0


def _registered(spec: PairSpec) -> Row:
    pair = spec.make()
    result = register_grids(pair.source, pair.target, clock=time.monotonic)
    error_m, error_rad = pair_errors(pair, result.T_target_source)
    return {
        "kind": spec.kind,
        "overlap": spec.overlap,
        "noise": spec.noise,
        "seed": spec.seed,
        "sonar": spec.is_sonar,
        "matching": spec.is_matching,
        "right": is_right(pair, result.T_target_source),
        "accepted": result.is_accepted,
        "verdict": result.verdict.name,
        "certified": result.is_certified,
        "probability": result.probability,
        "error_m": error_m,
        "error_deg": math.degrees(error_rad),
        "boxes": result.num_boxes,
        "seconds": result.seconds,
    }


def _shares(rows: list[Row]) -> tuple[str, str, str]:
    right = np.mean([r["right"] for r in rows])
    kept = np.mean([r["right"] and r["accepted"] for r in rows])
    wrong = np.mean([r["accepted"] and not r["right"] for r in rows])
    return f"{right:.2f}", f"{kept:.2f}", f"{wrong:.3f}"


def _draw_curve(path: Path, rows: list[Row], args: argparse.Namespace) -> None:
    picture, grid = figure()
    axes = grid[0][0]
    for noise in args.noises:
        shares = []
        for overlap in args.overlaps:
            same = [
                r["right"] and r["accepted"]
                for r in rows
                if r["matching"] and (r["noise"], r["overlap"]) == (noise, overlap)
            ]
            shares.append(np.mean(same) if same else np.nan)
        axes.plot(args.overlaps, shares, "o-", label=noise)
    axes.set_xlabel("overlap of the windows")
    axes.set_ylabel("share accepted and right")
    axes.set_ylim(-0.02, 1.02)
    axes.legend()
    save_figure(picture, path)


def _draw_reliability(path: Path, rows: list[Row]) -> None:
    """Share of right poses over the stated probability, with the number of pairs."""
    picture, grid = figure()
    axes = grid[0][0]
    axes.plot([0, 1], [0, 1], "k:", linewidth=0.8)
    bins: dict[int, list[Row]] = {}
    for row in rows:
        bins.setdefault(min(int(10 * row["probability"]), 9), []).append(row)
    for _, members in sorted(bins.items()):
        stated = np.mean([r["probability"] for r in members])
        share = np.mean([r["right"] for r in members])
        axes.plot(stated, share, "o", color="C0")
        axes.annotate(
            str(len(members)), (stated, share), textcoords="offset points", xytext=(5, -9)
        )
    axes.set_xlabel("stated probability")
    axes.set_ylabel("share of right poses")
    save_figure(picture, path)
