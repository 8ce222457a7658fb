"""How little overlap is too little: success, refusal and error of map registration over overlap.

Pairs of harbours, lakes and buildings, half of them again with maps of two places, and, where
UW_DATA_DIR is set, all pairs of submaps of a real marina; each with its proof. Writes tables, a
CSV file, the curve and the reliability diagram.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
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
from uw_dslam_ros2.cli.studies._map_pairs import (
    SHARES,
    PairSpec,
    accepted_of_different,
    pair_specs,
    registered,
    shares,
)
from uw_dslam_ros2.cli.studies._real_pairs import has_recording, real_pairs
from uw_dslam_ros2.sim.maps.pairs import MapPair

Row = dict[str, Any]
_FIRST_SEED = 2000  # others than those of `study verdict`


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this study."""
    parser.add_argument("--seeds", type=int, default=2, help="places of each kind (%(default)s)")
    parser.add_argument(
        "--kinds",
        nargs="+",
        default=["harbour", "lake", "corridors", "oblique"],
        help="kinds of places",
    )
    parser.add_argument(
        "--overlaps", nargs="+", type=float, default=[0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0]
    )
    parser.add_argument("--noises", nargs="+", default=["clean", "noisy", "hard"])
    parser.add_argument("--data", type=Path, metavar="DIR", help="recordings ($UW_DATA_DIR)")


def run(args: argparse.Namespace) -> int:
    """Register all pairs, print the tables, draw."""
    specs = list(
        pair_specs(
            tuple(args.kinds),
            tuple(args.overlaps),
            tuple(args.noises),
            range(_FIRST_SEED, _FIRST_SEED + args.seeds),
        )
    )
    rows = [_registered(spec, spec.make()) for spec in progress(specs, text="pairs")]
    if args.data is not None or has_recording():
        real = real_pairs(args.data)
        rows += [
            _registered(PairSpec("aracati", pair.overlap, "real", number), pair)
            for number, pair in enumerate(progress(real, text="real pairs"))
        ]
    write_csv(args.out / "pairs.csv", rows)
    print_table(
        ("noise", "overlap", "pairs", *SHARES),
        _table(rows, args),
    )
    print(accepted_of_different(rows))
    seconds = [r["seconds"] for r in rows]
    print(f"time: median {np.median(seconds):.2f} s, p95 {np.quantile(seconds, 0.95):.2f} s")
    _draw_curve(args.out / "overlap.png", rows, args)
    _draw_reliability(args.out / "reliability.png", rows)
    return 0


def _registered(spec: PairSpec, pair: MapPair) -> Row:
    return {
        "kind": spec.kind,
        "overlap": spec.overlap,
        "noise": spec.noise,
        "seed": spec.seed,
        "sonar": spec.is_sonar,
        **registered(pair),
    }


def _table(rows: list[Row], args: argparse.Namespace) -> Iterator[tuple[Any, ...]]:
    for noise in (*args.noises, "real"):
        same = [r for r in rows if r["matching"] and r["noise"] == noise]
        if noise == "real":
            bins = [(low, high) for low, high in ((0.02, 0.2), (0.2, 0.5), (0.5, 1.01))]
            groups = {
                f"{low:.0%} to {min(high, 1.0):.0%}": [
                    r for r in same if low <= r["overlap"] < high
                ]
                for low, high in bins
            }
        else:
            groups = {f"{o:.0%}": [r for r in same if r["overlap"] == o] for o in args.overlaps}
        for name, members in groups.items():
            if members:
                yield noise, name, len(members), *shares(members)


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
