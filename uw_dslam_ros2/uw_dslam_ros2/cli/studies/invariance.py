"""Whether an answer depends on what it must not: margins, turns, origins, order, cells, specks.

Each pair of maps is told in several other ways that change nothing of what is right, and once
mirrored, which nothing can repair. Writes a table and a CSV file with one line for each telling.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from uw_dslam_ros2.cli.studies._common import print_table, progress, write_csv
from uw_dslam_ros2.cli.studies._map_pairs import pair_specs
from uw_dslam_ros2.core.registration.grids.judging.verdict import decide
from uw_dslam_ros2.core.registration.grids.register import GridRegistrationConfig, match_evidence
from uw_dslam_ros2.core.registration.result import Verdict
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.maps.pairs import MapPair, pair_errors
from uw_dslam_ros2.sim.maps.variants import VARIANTS, coarser_pair, mirrored

Row = dict[str, Any]
Changes = dict[str, Callable[[MapPair], MapPair]]
_FIRST_SEED = 7000  # others than those of the fit
_KINDS = ("harbour", "lake", "corridors", "office", "cave", "oblique")
_MIRRORED = "mirrored"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this study."""
    parser.add_argument("--seeds", type=int, default=2, help="places of each kind (%(default)s)")
    parser.add_argument("--kinds", nargs="+", default=list(_KINDS), help="kinds of places")
    parser.add_argument("--overlaps", nargs="+", type=float, default=[0.3, 0.5, 0.7])
    parser.add_argument("--noises", nargs="+", default=["clean", "noisy", "hard"])
    parser.add_argument(
        "--coarser", nargs="*", type=int, default=[3], metavar="TIMES",
        help="also on cells so many times as large",
    )  # fmt: skip
    parser.add_argument("--size", type=int, default=160, help="side of a map [cells]")


def run(args: argparse.Namespace) -> int:
    """Register every telling of every pair, print the table."""
    seeds = range(_FIRST_SEED, _FIRST_SEED + args.seeds)
    specs = pair_specs(tuple(args.kinds), tuple(args.overlaps), tuple(args.noises), seeds)
    changes = VARIANTS | {
        f"cells {times} times as large": coarser_pair(times) for times in args.coarser
    }
    rows: list[Row] = []
    for number, spec in enumerate(progress(list(specs), text="pairs")):
        pair = replace(spec, size_cells=args.size).make()
        rows += [
            {"pair": number, "kind": spec.kind, **row} for row in _told_otherwise(pair, changes)
        ]
    write_csv(args.out / "invariance.csv", rows)
    print_table(
        ("told otherwise", "pairs", "same verdict", "accepted before", "accepted",
         "accepted now only", "most that a flip moved", "farthest off"),
        [_summary(name, rows) for name in (*changes, _MIRRORED)],
    )  # fmt: skip
    return 0


def _told_otherwise(pair: MapPair, changes: Changes) -> Iterator[Row]:
    told = _answer(pair)
    if told is None:
        return
    verdict, probability, T_target_source = told
    known = replace(pair, T_target_source=T_target_source)
    others = {name: change(known) for name, change in changes.items()}
    others[_MIRRORED] = replace(known, source=mirrored(known.source))
    for name, other in others.items():
        again = _answer(other)
        if again is None:
            continue
        off_m, _ = pair_errors(other, again[2])
        yield {
            "told": name,
            "before": verdict.name,
            "verdict": again[0].name,
            "probability_before": probability,
            "probability": again[1],
            "off_cells": off_m / pair.source.spec.resolution_m,
        }


def _answer(pair: MapPair) -> tuple[Verdict, float, SE2] | None:
    found = match_evidence(pair.source, pair.target)
    if found is None:
        return None
    evidence, poses = found
    verdict, _, probability = decide(evidence, GridRegistrationConfig())
    return verdict, probability, poses[0][1]


def _summary(name: str, rows: list[Row]) -> tuple[str | int, ...]:
    own = [r for r in rows if r["told"] == name]
    accepted = [r for r in own if r["before"] == Verdict.ACCEPTED.name]
    both = [r for r in accepted if r["verdict"] == Verdict.ACCEPTED.name]
    flipped = [r for r in own if (r in accepted) != (r["verdict"] == Verdict.ACCEPTED.name)]
    change = max((abs(r["probability"] - r["probability_before"]) for r in flipped), default=0.0)
    off = max((r["off_cells"] for r in both), default=0.0)
    return (
        name,
        len(own),
        len(own) - len(flipped),
        len(accepted),
        sum(r["verdict"] == Verdict.ACCEPTED.name for r in own),
        sum(r not in accepted for r in flipped),
        f"{change:.3f}" if flipped else "-",
        f"{off:.2f} cells" if name != _MIRRORED and np.isfinite(off) else "-",
    )
