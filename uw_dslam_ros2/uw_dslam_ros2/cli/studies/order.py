"""How the error depends on the order in which the maps come: greedy pairwise against the graph.

Fleets of vehicles on neighbouring lanes, each with an unknown start and drifting odometry, are fed
to the map queue in random orders of the vehicles: to the paper's plain queue (take two, register,
put the merged map back) and to the pose graph. So that the merging alone is compared, the
registrations come from the true poses with noise, and a share of them can be wrong; with
``--matcher grids`` they are the project's own.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import numpy as np

from uw_dslam_ros2.cli.studies._common import (
    COLOURS,
    figure,
    print_table,
    progress,
    save_figure,
    write_csv,
)
from uw_dslam_ros2.core.merging import MapQueue, MapQueueConfig, MatchRequest
from uw_dslam_ros2.core.registration import RegistrationResult, register_grids
from uw_dslam_ros2.sim.maps.fleets import Fleet, KnowingMatcher, answer_all, lawnmower_fleet

__all__ = ["add_arguments", "run"]

_MODES = ("pairwise", "graph")
_HEADERS = (
    "mode",
    "median [m]",
    "worst [m]",
    "spread over orders [m]",
    "merged",
    "searches",
    "distinct maps",
)
Matcher = Callable[[MatchRequest], RegistrationResult]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--vehicles", type=int, default=5, help="default: %(default)s")
    parser.add_argument("--submaps", type=int, default=5, help="of each (default: %(default)s)")
    parser.add_argument("--lane", type=float, default=12.0, help="distance of lanes [m]")
    parser.add_argument("--orders", type=int, default=8, help="per place (default: %(default)s)")
    parser.add_argument("--places", type=int, default=3, help="seeds (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the first place")
    parser.add_argument(
        "--matcher", choices=("truth", "grids"), default="truth", help="default: %(default)s"
    )
    parser.add_argument(
        "--wrong", type=float, default=0.0, help="share of wrong answers (matcher truth only)"
    )


def run(args: argparse.Namespace) -> int:
    """Try every order in every place; write ``order.png`` and ``order.csv``."""
    rows: list[dict[str, Any]] = []
    trials = [(args.seed + i, order) for i in range(args.places) for order in range(args.orders)]
    matchers: dict[int, tuple[Fleet, Matcher]] = {}
    for seed, order in progress(trials, text="orders"):
        if seed not in matchers:
            fleet = lawnmower_fleet(args.vehicles, args.submaps, seed, lane_m=args.lane)
            matchers[seed] = fleet, _remembering(_matcher(args, fleet, seed))
        rows += [_trial(*matchers[seed], seed, order, mode) for mode in _MODES]
    write_csv(args.out / "order.csv", rows)
    _draw(rows, args)
    _report(rows)
    return 0


def _matcher(args: argparse.Namespace, fleet: Fleet, seed: int) -> Matcher:
    if args.matcher == "truth":
        return KnowingMatcher(fleet, seed, wrong_share=args.wrong)
    return lambda request: register_grids(request.source, request.target, prior=request.prior)


def _remembering(matcher: Matcher) -> Matcher:
    """Answer equal questions of different orders once."""
    known: dict[tuple[Any, ...], RegistrationResult] = {}

    def answer(request: MatchRequest) -> RegistrationResult:
        maps = request.source.values.tobytes(), request.target.values.tobytes()
        key = (*maps, request.source_reference, request.target_reference, request.prior)
        if key not in known:
            known[key] = matcher(request)
        return known[key]

    return answer


def _trial(fleet: Fleet, matcher: Matcher, seed: int, order: int, mode: str) -> dict[str, Any]:
    rng = np.random.default_rng([seed, order])
    vehicles = sorted({submap_id[0] for submap_id in fleet.submaps})
    shuffled = [vehicles[i] for i in rng.permutation(len(vehicles))]
    # The frame is pinned by name, so that equal results are equal bytes.
    queue = MapQueue(MapQueueConfig(mode=mode, anchor_vehicle=vehicles[0]))
    for vehicle in shuffled:
        for submap_id in sorted(i for i in fleet.submaps if i[0] == vehicle):
            queue.add_submap(fleet.submaps[submap_id])
    num_searches = answer_all(queue, matcher)
    merged = [record for record in queue.submaps() if record.component == 0]
    fused = queue.global_map()
    assert fused is not None
    return {
        "place": seed,
        "order": " ".join(shuffled),
        "mode": mode,
        "rmse_m": round(fleet.position_rmse_m(queue), 4),
        "merged_share": round(len(merged) / len(fleet.submaps), 3),
        "num_searches": num_searches,
        "cells_digest": fused.cells_digest(),
    }


def _draw(rows: list[dict[str, Any]], args: argparse.Namespace) -> None:
    made, axes = figure(1, 2, width=7.2, height=3.2)
    for mode, colour in zip(_MODES, COLOURS, strict=False):
        of_mode = [row for row in rows if row["mode"] == mode]
        for panel, (name, label) in enumerate(
            (("rmse_m", "position error of the merged [m]"), ("merged_share", "share merged"))
        ):
            values = np.sort([row[name] for row in of_mode])
            share = np.arange(1, len(values) + 1) / len(values)
            axes[0, panel].step(values, share, where="post", color=colour, label=mode)
            axes[0, panel].set_xlabel(label)
    axes[0, 0].set_ylabel("share of orders at most that")
    axes[0, 0].legend()
    save_figure(made, args.out / "order.png")


def _report(rows: list[dict[str, Any]]) -> None:
    table = []
    for mode in _MODES:
        of_mode = [row for row in rows if row["mode"] == mode]
        places = sorted({row["place"] for row in of_mode})
        spreads = [np.ptp([r["rmse_m"] for r in of_mode if r["place"] == p]) for p in places]
        errors = [row["rmse_m"] for row in of_mode]
        digests = [len({r["cells_digest"] for r in of_mode if r["place"] == p}) for p in places]
        table.append(
            (
                mode,
                f"{np.median(errors):.3f}",
                f"{np.max(errors):.3f}",
                f"{np.mean(spreads):.4f}",
                f"{np.mean([row['merged_share'] for row in of_mode]):.2f}",
                f"{np.mean([row['num_searches'] for row in of_mode]):.1f}",
                f"{np.mean(digests):.1f}",
            )
        )
    print_table(_HEADERS, table)
