"""How well maps that were built apart are registered: other vehicles, sonars, settings, seasons.

Simulated places are mapped several times through the real mapper, each time by a vehicle with a
way, a sonar (every third one turns), settings, a drift and cells of its own, some in another
season. All pairs of maps of one place are registered with the proof, and so many pairs of
different places. Basins of one plan, and one that looks alike half-turned, are reported by
themselves. Maps are kept in a folder, and made anew when the code that makes them has changed.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from uw_dslam_ros2.cli.studies._apart_maps import (
    apart_maps,
    different_pairs,
    matching_pairs,
    twin_pairs,
)
from uw_dslam_ros2.cli.studies._common import (
    COLOURS,
    figure,
    print_table,
    progress,
    save_figure,
    share_interval,
    write_csv,
)
from uw_dslam_ros2.cli.studies._map_methods import add_method_arguments, compare
from uw_dslam_ros2.cli.studies._map_pairs import registered
from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.sim.maps.pairs import MapPair

Row = dict[str, Any]

OVERLAPS = (0.05, 0.2, 0.4, 0.5, 0.7, 1.01)
"""Edges of the bins by which pairs are told apart; what shares less has nothing to be found by."""
_FIFTHS = 5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this study."""
    parser.add_argument("--places", type=int, default=20, help="places (%(default)s)")
    parser.add_argument("--first-seed", type=int, default=5000, help="others than were fitted on")
    parser.add_argument("--vehicles", type=int, default=4, help="maps of each place (%(default)s)")
    parser.add_argument(
        "--different", type=int, default=300, help="pairs of different places (%(default)s)"
    )
    parser.add_argument(
        "--cache", type=Path, metavar="DIR", help="folder of the maps (default: in --out)"
    )
    add_method_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Map, register, print tables, draw."""
    seeds = range(args.first_seed, args.first_seed + args.places)
    maps = apart_maps(seeds, args.vehicles, args.cache or args.out / "maps")
    pairs = [
        *((pair, "one place") for pair in matching_pairs(maps) if pair.overlap >= OVERLAPS[0]),
        *((pair, "twins") for pair in twin_pairs(maps)),
        *((pair, "different") for pair in different_pairs(maps, args.different, args.first_seed)),
    ]
    if not pairs:
        raise DataError("no two maps were made, expected more of --places and --vehicles")
    rows = [_row(pair, group) for pair, group in progress(pairs, text="pairs")]
    write_csv(args.out / "apart.csv", rows)
    print(f"{len(maps)} maps of {len(seeds)} places")
    _print_overlaps(rows)
    _print_calibration(rows)
    _print_wrong(rows)
    seconds = [row["seconds"] for row in rows]
    print(f"time: median {np.median(seconds):.2f} s, p95 {np.quantile(seconds, 0.95):.2f} s")
    _draw(args.out / "apart.png", rows)
    if args.methods:
        plain = [pair for pair, group in pairs if group != "twins" and not pair.is_ambiguous]
        write_csv(args.out / "methods.csv", compare(plain, args.methods))
    return 0


def _row(pair: MapPair, group: str) -> Row:
    group = "symmetric" if group == "one place" and pair.is_ambiguous else group
    cells_m = [one.spec.resolution_m for one in (pair.source, pair.target)]
    return {
        "group": group,
        "kind": pair.kind,
        "noise": pair.noise,
        "overlap": pair.overlap,
        "cells_m": max(cells_m),
        **registered(pair),
    }


def _of(rows: list[Row], *groups: str) -> list[Row]:
    return [row for row in rows if row["group"] in groups]


def _print_overlaps(rows: list[Row]) -> None:
    """What became of the pairs of one place, by the share of the smaller seen area in common."""
    own = _of(rows, "one place")
    bins = [
        (f"{low:.0%} to {min(high, 1.0):.0%}", low, high)
        for low, high in itertools.pairwise(OVERLAPS)
    ]
    table = []
    for name, low, high in (*bins, ("50% and more", 0.5, 1.01), ("all", 0.0, 1.01)):
        members = [row for row in own if low <= row["overlap"] < high]
        right = [row for row in members if row["right"]]
        kept = sum(row["accepted"] for row in right)
        table.append(
            (
                name,
                len(members),
                f"{len(right) / len(members):.2f}" if members else "-",
                f"{kept / len(right):.2f}" if right else "-",
                sum(row["accepted"] and not row["right"] for row in members),
            )
        )
    print_table(("in common", "pairs", "right", "of these accepted", "accepted, wrong"), table)


def _print_calibration(rows: list[Row]) -> None:
    own = _of(rows, "one place", "different")
    table = [
        (name, len(members), f"{stated:.2f}", f"{share:.2f}")
        for name, members, stated, share in _fifths(own)
    ]
    print_table(("stated probability", "pairs", "stated, mean", "right, observed"), table)


def _fifths(rows: list[Row]) -> Iterator[tuple[str, list[Row], float, float]]:
    """Each fifth of the probability: its name, rows, mean stated and observed share of right."""
    for number in range(_FIFTHS):
        low, high = number / _FIFTHS, (number + 1) / _FIFTHS
        is_last = number + 1 == _FIFTHS
        members = [r for r in rows if low <= r["probability"] < high + is_last]
        if members:
            stated = float(np.mean([r["probability"] for r in members]))
            yield (
                f"{low:.1f} to {high:.1f}",
                members,
                stated,
                float(np.mean([r["right"] for r in members])),
            )


def _print_wrong(rows: list[Row]) -> None:
    """Who was accepted wrongly, with the interval of the share."""
    table = []
    for group in ("one place", "different", "twins", "symmetric"):
        members = _of(rows, group)
        if not members:
            continue
        wrong = sum(row["accepted"] and not row["right"] for row in members)
        low, high = share_interval(wrong, len(members))
        table.append((group, len(members), wrong, f"{low:.2%} to {high:.2%}"))
    print_table(("pairs of", "number", "accepted, wrong", "95 %"), table)


def _draw(path: Path, rows: list[Row]) -> None:
    """Right pairs kept against wrong ones for every threshold, and the reliability diagram."""
    made, axes = figure(1, 2, width=10.0)
    own = sorted(_of(rows, "one place", "different"), key=lambda row: -row["probability"])
    right = np.cumsum([row["right"] for row in own])
    wrong = np.arange(1, len(own) + 1) - right
    axes[0, 0].step(wrong, right / max(right[-1], 1), where="post")
    accepted = [row for row in own if row["accepted"]]
    kept = sum(row["right"] for row in accepted)
    axes[0, 0].plot(
        len(accepted) - kept, kept / max(right[-1], 1), "o", color=COLOURS[1], label="the verdict"
    )
    axes[0, 0].set_xlabel("wrong poses more probable than the threshold")
    axes[0, 0].set_ylabel("right poses more probable than it, share")
    axes[0, 0].set_xscale("symlog", linthresh=1.0)
    axes[0, 0].legend(loc="lower right")
    axes[0, 1].plot([0, 1], [0, 1], "k:", linewidth=0.8)
    for _, members, stated, share in _fifths(own):
        axes[0, 1].plot(stated, share, "o", color=COLOURS[0])
        axes[0, 1].annotate(
            str(len(members)), (stated, share), textcoords="offset points", xytext=(5, -9)
        )
    axes[0, 1].set_xlabel("stated probability")
    axes[0, 1].set_ylabel("share of right poses")
    save_figure(made, path)
