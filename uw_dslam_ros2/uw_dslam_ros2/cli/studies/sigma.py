"""The kernel's width: multiples of the one that is derived from the data, and the paper's.

Kernels are the standard deviation of a *pair* of points. Derived is that of the engine's first
search, 0.75 of the target's spacing (the root of its area over its number of points). Over fixed
multiples of it: how often the optimum of the paper's plain sum lies in the success region, how
often the engine does with that kernel alone and how many boxes it takes, how far the optimum next
to the truth is off; and beside them the engine as it is, which derives the kernel and goes on with
others where that one is not decisive.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from uw_dslam_ros2.cli.studies._common import (
    COLOURS,
    figure,
    is_success,
    print_table,
    progress,
    save_figure,
    write_csv,
)
from uw_dslam_ros2.cli.studies._trials import Cell, search_mixture
from uw_dslam_ros2.core.registration import (
    PriorWindow,
    RegistrationConfig,
    register_point_sets,
)
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["add_arguments", "run"]

_PAPER_SIGMA_M = 0.1
_DERIVED = 0.75  # spacings
_MULTIPLES = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0)
_MAX_BOXES = 50_000  # hopeless kernels would search for minutes
_CELLS = (
    Cell(50, 0.5, 0.0),
    Cell(50, 0.8, 0.0),
    Cell(50, 0.5, 0.05),
    Cell(50, 0.8, 0.05),
    Cell(50, 0.0, 0.02, 0.3),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--trials", type=int, default=40, help="per cell (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=2000, help="of the first trial")


def run(args: argparse.Namespace) -> int:
    """Try every kernel in every cell; write ``sigma.png`` and ``sigma.csv``."""
    seeds = range(args.seed, args.seed + args.trials)
    rows = [row for cell in _CELLS for row in _cell(cell, seeds)]
    write_csv(args.out / "sigma.csv", rows)
    _draw(rows, args)
    _report(rows)
    return 0


def _cell(cell: Cell, seeds: Sequence[int]) -> list[dict[str, Any]]:
    """One row for each kernel, and one for the engine as it is (multiple empty)."""
    derived_m = _DERIVED * 2.0 / math.sqrt(len(cell.problem(0).target))  # the square's area is 4
    problems = [cell.problem(seed) for seed in seeds]
    rows = []
    paper = math.sqrt(2.0) * _PAPER_SIGMA_M / derived_m
    for multiple in progress([*sorted([*_MULTIPLES, paper]), None], text=str(cell)):
        sigma_m = 0.0 if multiple is None else multiple * derived_m / math.sqrt(2.0)
        config = RegistrationConfig(sigma=sigma_m, max_boxes=_MAX_BOXES)
        plain, near, chain, boxes = [], [], [], []
        for problem in problems:
            source, target, T_true = problem.source, problem.target, problem.T_target_source
            result = register_point_sets(source, target, config)
            assert result.T_target_source is not None
            chain.append((result.T_target_source, T_true))
            boxes.append(result.num_boxes)
            if multiple is not None:
                plain.append((search_mixture(source, target, sigma_m), T_true))
                window = PriorWindow(T_true, 0.15, 0.15)
                near.append((search_mixture(source, target, sigma_m, window), T_true))
        rows.append(
            {
                "cell": str(cell),
                "multiple": "" if multiple is None else multiple,
                "sigma_m": "" if multiple is None else sigma_m,
                "is_paper": int(multiple == paper),
                "derived_m": derived_m,
                "trials": len(problems),
                "plain_success": _success(plain),
                "near_deg": _median_deg(near),
                "engine_success": _success(chain),
                "engine_deg": _median_deg(chain),
                "boxes": float(np.median(boxes)),
            }
        )
    return rows


def _success(pairs: list[tuple[SE2, SE2]]) -> float:
    return float(np.mean([is_success(*pair) for pair in pairs])) if pairs else math.nan


def _median_deg(pairs: list[tuple[SE2, SE2]]) -> float:
    if not pairs:
        return math.nan
    return math.degrees(float(np.median([found.distance_to(true)[1] for found, true in pairs])))


def _draw(rows: list[dict[str, Any]], args: argparse.Namespace) -> None:
    made, axes = figure(2, len(_CELLS), width=3.0 * len(_CELLS), height=5.6)
    for column, cell in enumerate(_CELLS):
        own = [row for row in rows if row["cell"] == str(cell)]
        fixed, ladder = [row for row in own if row["multiple"] != ""], own[-1]
        multiples = [row["multiple"] for row in fixed]
        top, bottom = axes[0, column], axes[1, column]
        for key, label, colour in (
            ("plain_success", "plain sum, fixed kernel", COLOURS[1]),
            ("engine_success", "engine, fixed kernel", COLOURS[5]),
        ):
            values = [row[key] for row in fixed]
            top.semilogx(multiples, values, "o-", markersize=3, color=colour, label=label)
        top.axhline(ladder["engine_success"], color=COLOURS[0], linewidth=2.5, label="engine")
        for key, label, colour in (
            ("near_deg", "optimum next to the truth", COLOURS[1]),
            ("engine_deg", "engine, fixed kernel", COLOURS[5]),
        ):
            floored = np.maximum([row[key] for row in fixed], 1e-3)
            bottom.loglog(multiples, floored, "o-", markersize=3, color=colour, label=label)
        bottom.axhline(max(ladder["engine_deg"], 1e-3), color=COLOURS[0], linewidth=2.5)
        paper = next(row["multiple"] for row in fixed if row["is_paper"])
        for axis in (top, bottom):
            axis.axvline(paper, color="black", linestyle=":", label="the paper's 0.1")
            axis.set_xticks(_MULTIPLES, [f"{multiple:g}" for multiple in _MULTIPLES])
            axis.set_xticks([], minor=True)
        top.set(title=str(cell).replace(", ", "\n", 1), ylim=(-0.03, 1.03))
        bottom.set(xlabel="kernel / derived kernel", ylim=(8e-4, 200.0))
    axes[0, 0].set_ylabel("share of successes")
    axes[1, 0].set_ylabel("median rotation error [deg]")
    handles = dict(zip(*reversed(axes[0, 0].get_legend_handles_labels()), strict=True))
    handles["optimum next to the truth (below)"] = axes[1, 0].lines[0]
    made.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=5)
    save_figure(made, args.out / "sigma.png")


def _report(rows: list[dict[str, Any]]) -> None:
    table = []
    for row in rows:
        is_ladder = row["multiple"] == ""
        kernel = "engine as it is" if is_ladder else f"{row['multiple']:.3g}"
        if row["is_paper"]:
            kernel += " (paper)"
        table.append(
            (
                row["cell"],
                kernel,
                "" if is_ladder else f"{row['plain_success']:.0%}",
                "" if is_ladder else f"{row['near_deg']:.3f}",
                f"{row['engine_success']:.0%}",
                f"{row['engine_deg']:.4f}",
                f"{row['boxes']:.0f}",
            )
        )
    shares = ("plain sum", "near optimum deg")
    print_table(
        ("cell", "kernel / derived", *shares, "engine", "engine deg", "boxes"),
        table,
    )
