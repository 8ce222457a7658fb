"""Outliers and noise (Figure 4 and beyond): the engine and the other methods.

The paper's four cases (a) to (d) with a picture before and after, then sweeps of the outlier
share, the noise and the number of points, and the cells in which every peer fails. A trial
succeeds below 2 degrees and 0.05 (the square's side is 2). The baselines are told the noise and
the overlap; the engine is not.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from uw_dslam_ros2.cli.studies._common import (
    COLOURS,
    figure,
    print_table,
    save_figure,
    share_interval,
    write_csv,
)
from uw_dslam_ros2.cli.studies._trials import (
    CEILING,
    ENGINE,
    ORACLE,
    TRUTH,
    Cell,
    Trial,
    method_names,
    run_cell,
    summarise,
)
from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.registration import register_point_sets

__all__ = ["add_arguments", "run"]

# Section 4.1.2: rotation error [deg] and translation error of the four cases, and what they are.
_PAPER_CASES = {
    "a": (0.0, 0.0, 0.024, 0.0044),
    "b": (0.33, 0.0, 0.228, 0.0087),
    "c": (0.5, 0.0, 0.323, 0.0113),
    "d": (0.5, 0.05, 0.493, 0.0127),
}
_OUTLIERS = (0.0, 0.2, 0.33, 0.5, 0.6, 0.7, 0.8, 0.9)
_NOISE = (0.0, 0.01, 0.02, 0.03, 0.05)
_POINTS = (25, 50, 100, 200)
_SLOW = "Go-ICP in SE(2)"  # seconds where there is noise; has to be asked for


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--trials", type=int, default=20, help="per cell (default: %(default)s)")
    parser.add_argument("--points", type=int, default=100, help="m (default: %(default)s)")
    parser.add_argument(
        "--only",
        choices=("paper", "outliers", "noise", "points", "accuracy", "hard"),
        action="append",
        help="run this part alone (may be given again; default: all)",
    )
    parser.add_argument(
        "--methods", nargs="+", metavar="NAME", help=f"of: {'; '.join(method_names())}"
    )
    parser.add_argument(
        "--cells", nargs="+", metavar="TEXT", help="only cells whose name holds one of these texts"
    )
    parser.add_argument("--seed", type=int, default=1000, help="of the first trial")


def run(args: argparse.Namespace) -> int:
    """Run the cells; write pictures, ``outliers.csv`` (trials) and ``summary.csv``."""
    known = method_names()
    methods = args.methods or [name for name in known if name not in (_SLOW, TRUTH, CEILING)]
    unknown = sorted(set(methods) - set(known))
    if unknown:
        raise InvalidInputError(f"--methods names {unknown[0]!r}, expected {'; '.join(known)}")
    trials: list[Trial] = []
    for part, (cells, report) in _parts(args.points).items():
        if args.only and part not in args.only:
            continue
        cells = [c for c in cells if any(text in str(c) for text in args.cells or [""])]
        if not cells:
            continue
        seeds = range(args.seed, args.seed + args.trials)
        found = [trial for cell in cells for trial in run_cell(cell, methods, seeds)]
        print(f"\n{part}: {args.trials} trials per cell")
        report(found, cells, methods, args)
        trials += found
    if not trials:
        raise InvalidInputError(
            f"--cells {' '.join(args.cells)}: no cell's name holds these texts"
        )
    write_csv(args.out / "outliers.csv", [trial.as_row() for trial in trials])
    write_csv(args.out / "summary.csv", summarise(trials))
    return 0


Report = Callable[[list[Trial], Sequence[Cell], Sequence[str], argparse.Namespace], None]


def _parts(num_points: int) -> dict[str, tuple[list[Cell], Report]]:
    m = num_points
    hard = [Cell(k, 0.9, 0.05) for k in (50, 100, 200)]
    hard += [Cell(k, 0.0, 0.05, 0.3) for k in (50, 100, 200)]
    hard += [Cell(50, 0.0, 0.02, 0.2)]
    accuracy = [Cell(m, o) for o in (0.33, 0.5, 0.8)]
    accuracy += [Cell(m, o, 0.02) for o in (0.5, 0.8, 0.9)]
    accuracy += [Cell(m, 0.0, 0.01, common) for common in (0.5, 0.3)]
    return {
        "paper": ([Cell(m, o, noise) for o, noise, _, _ in _PAPER_CASES.values()], _paper),
        "outliers": ([Cell(m, o, n) for n in (0.0, 0.02) for o in _OUTLIERS], _sweep("outliers")),
        "noise": ([Cell(m, 0.5, noise) for noise in _NOISE], _sweep("noise_m")),
        "points": ([Cell(k, 0.5, 0.0) for k in _POINTS], _sweep("points")),
        "accuracy": (accuracy, _table_by_cell),
        "hard": (hard, _table_by_cell),
    }


def _paper(
    trials: list[Trial], cells: Sequence[Cell], methods: Sequence[str], args: argparse.Namespace
) -> None:
    rows = []
    for cell in cells:
        letter = _letter(cell)
        outliers, noise, degrees, metres = _PAPER_CASES[letter]
        case = f"({letter}) {outliers:.0%}, {noise:.0%}"
        rows.append([case, "the paper", "", f"{degrees}", f"{metres}", ""])
        for row in summarise([trial for trial in trials if trial.cell == cell]):
            rows.append([case, row["method"], _percent(row), *_errors(row), _time(row)])
    header = ("outliers, noise", "method", "success", "median deg", "median m", "CPU s")
    print_table(header, rows)
    if ENGINE in methods:
        _draw_cases(cells, args)


def _letter(cell: Cell) -> str:
    """What the paper calls this cell."""
    key = (cell.outlier_share, cell.noise_m)
    return next(letter for letter, case in _PAPER_CASES.items() if case[:2] == key)


def _draw_cases(cells: Sequence[Cell], args: argparse.Namespace) -> None:
    """Figure 4: source in red, target in black, before and after."""
    made, axes = figure(2, len(cells), width=2.6 * len(cells), height=5.4)
    for column, cell in enumerate(cells):
        letter = _letter(cell)
        problem = cell.problem(args.seed)
        result = register_point_sets(problem.source, problem.target)
        assert result.T_target_source is not None
        error_m, error_rad = result.T_target_source.distance_to(problem.T_target_source)
        after = result.T_target_source.apply(problem.source)
        for row, source in enumerate((problem.source, after)):
            axis = axes[row, column]
            axis.plot(*problem.target.T, ".", color="black", markersize=4, label="target")
            style = {"color": COLOURS[1], "markersize": 4, "fillstyle": "none"}
            axis.plot(*source.T, "o", label="source", **style)
            axis.set_aspect("equal", adjustable="datalim")
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_visible(False)
        axes[0, column].set_title(
            f"({letter}) outliers {cell.outlier_share:.0%}, noise {cell.noise_m:.0%}"
        )
        axes[1, column].set_xlabel(f"{math.degrees(error_rad):.2g} deg, {error_m:.2g}")
    made.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    axes[0, 0].set_ylabel("before")
    axes[1, 0].set_ylabel("after")
    save_figure(made, args.out / "figure4.png")


def _sweep(key: str) -> Report:
    """A report with success, error and time over one quantity."""

    def report(
        trials: list[Trial],
        cells: Sequence[Cell],
        methods: Sequence[str],
        args: argparse.Namespace,
    ) -> None:
        rows = summarise(trials)
        noises = sorted({cell.noise_m for cell in cells}) if key == "outliers" else [None]
        for noise in noises:
            chosen = [row for row in rows if noise is None or row["noise_m"] == noise]
            name = key if noise is None else f"{key}_noise_{100 * noise:.0f}"
            _draw_sweep(chosen, key, methods, args, name.replace("_m", ""))
        _table_by_cell(trials, cells, methods, args)

    return report


def _draw_sweep(
    rows: list[dict[str, Any]],
    key: str,
    methods: Sequence[str],
    args: argparse.Namespace,
    name: str,
) -> None:
    label = {"outliers": "share of outliers", "noise_m": "noise [m]", "points": "m"}[key]
    made, axes = figure(1, 3, width=11.0, height=3.8)
    success, error, seconds = axes[0]
    for number, method in enumerate(methods):
        own = [row for row in rows if row["method"] == method]
        x = [row[key] for row in own]
        style: dict[str, Any] = {"color": COLOURS[number % len(COLOURS)], "marker": "o"}
        style |= {"markersize": 3, "label": method}
        if method in (ENGINE, ORACLE):
            style |= {"linewidth": 2.5, "zorder": 3} if method == ENGINE else {"linestyle": ":"}
        shares = np.array([row["success"] for row in own])
        success.plot(x, shares, **style)
        if method == ENGINE:
            band = np.array([share_interval(round(s * r["trials"]), r["trials"])
                             for s, r in zip(shares, own, strict=True)])  # fmt: skip
            success.fill_between(x, *band.T, color=style["color"], alpha=0.15, linewidth=0)
        floor = 1e-6  # below: exact but for rounding
        error.semilogy(x, np.maximum([row["median_deg"] for row in own], floor), **style)
        if method != ORACLE:
            seconds.semilogy(x, np.maximum([row["median_cpu_s"] for row in own], 1e-5), **style)
    success.set(xlabel=label, ylabel="share of successes", ylim=(-0.03, 1.03))
    error.set(xlabel=label, ylabel="median rotation error of successes [deg]")
    seconds.set(xlabel=label, ylabel="median CPU time [s]")
    handles, labels = success.get_legend_handles_labels()
    made.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 5))
    save_figure(made, args.out / f"{name}.png")


def _table_by_cell(
    trials: list[Trial],
    cells: Sequence[Cell],
    methods: Sequence[str],  # noqa: ARG001 - all reports take the same
    args: argparse.Namespace,  # noqa: ARG001
) -> None:
    rows = []
    for cell in cells:
        for row in summarise([trial for trial in trials if trial.cell == cell]):
            refused = [f"{row[k]:.0%}" for k in ("right_but_refused", "wrong_but_accepted")]
            rows.append(
                [str(cell), row["method"], _percent(row), *refused, *_errors(row), _time(row)]
            )
    shares = ("success", "right but refused", "wrong, not refused")
    header = ("cell", "method", *shares, "median deg", "median m", "CPU s")
    print_table(header, rows)


def _percent(row: dict[str, Any]) -> str:
    return f"{row['success']:.0%}"


def _errors(row: dict[str, Any]) -> tuple[str, str]:
    if math.isnan(row["median_deg"]):
        return "", ""
    return f"{row['median_deg']:.4f}", f"{row['median_m']:.5f}"


def _time(row: dict[str, Any]) -> str:
    return "" if row["method"] == ORACLE else f"{row['median_cpu_s']:.4f}"
