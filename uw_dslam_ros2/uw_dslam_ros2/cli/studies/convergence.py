"""Both bounds over the iterations (Figure 3): the paper's search and the engine.

Two artificial sets of m = n points, the paper's protocol, sigma = 0.1. The reference is
Algorithm 3 as corrected, in NumPy, once with weights 1 / (m n) alone and once divided by N as
eq. 3 demands; both stop at the paper's absolute gap. The engine stops at a relative gap. Bounds
are those of the objective that is maximised.
"""

from __future__ import annotations

import argparse
import math
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.cli.studies._common import (
    COLOURS,
    figure,
    print_table,
    progress,
    save_figure,
    write_csv,
)
from uw_dslam_ros2.core.registration.baselines.paper_reference import (
    Boxes,
    MixturePair,
    register_reference,
)
from uw_dslam_ros2.core.registration.search.branch_and_bound import (
    SearchSettings,
    Status,
    Term,
    search,
)
from uw_dslam_ros2.core.registration.search.field import mixture_field
from uw_dslam_ros2.sim.maps.point_sets import PointSetProblem, outlier_problem

__all__ = ["add_arguments", "run"]

_REFERENCE, _DENSITY, _ENGINE = "reference, N = 1", "reference, N of eq. 3", "engine"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--points", type=int, default=50, help="m (default: %(default)s)")
    parser.add_argument("--outliers", type=float, default=0.0, help="share of the target")
    parser.add_argument("--noise", type=float, default=0.0, help="standard deviation [m]")
    parser.add_argument("--sigma", type=float, default=0.1, help="kernel [m]; the paper has 0.1")
    parser.add_argument("--gap", type=float, default=0.01, help="absolute gap of the reference")
    parser.add_argument("--engine-gap", type=float, default=0.01, help="relative, of the engine")
    parser.add_argument("--iterations", type=int, default=20_000, help="limit of the reference")
    parser.add_argument("--seed", type=int, default=0)


def run(args: argparse.Namespace) -> int:
    """Run the searches, then write ``convergence.png`` and ``convergence.csv``."""
    problem = outlier_problem(args.points, args.outliers, args.noise, seed=args.seed)
    traces = {
        _REFERENCE: _trace_reference(problem, args, is_density=False),
        _DENSITY: _trace_reference(problem, args, is_density=True),
        _ENGINE: _trace_engine(problem, args),
    }
    rows = [
        {
            "search": name,
            "iteration": int(i),
            "boxes": int(b),
            "cpu_s": s,
            "lower": lo,
            "upper": up,
        }
        for name, trace in traces.items()
        for i, b, s, lo, up in trace
    ]
    write_csv(args.out / "convergence.csv", rows)
    _draw(traces, args)
    _report(traces, args)
    return 0


def _trace_reference(
    problem: PointSetProblem, args: argparse.Namespace, *, is_density: bool
) -> NDArray[np.float64]:
    """Rows of iteration, boxes, CPU seconds, lower and upper bound of the maximum."""
    pair = MixturePair.build(problem.source, problem.target, args.sigma, is_density=is_density)
    box = Boxes(np.zeros(1), np.zeros((1, 2)), math.pi, 1.0)  # theta in [-pi, pi], t in [-1, 1]^2
    rows: list[tuple[float, ...]] = []
    bar = progress(None, total=args.iterations, text="reference")
    start = time.process_time()

    def note(iteration: int, low: float, high: float) -> None:
        rows.append((iteration, 8 * iteration, time.process_time() - start, -high, -low))
        bar.update()

    register_reference(
        pair, box=box, gap=args.gap, max_iterations=args.iterations, on_iteration=note
    )
    bar.close()
    return np.array(rows)


def _trace_engine(problem: PointSetProblem, args: argparse.Namespace) -> NDArray[np.float64]:
    """The same rows for the engine, which is stopped after more and more boxes.

    The search is deterministic, so each run repeats the one before and goes on from there.
    """
    num_target = len(problem.target)
    weight = 1.0 / (len(problem.source) * num_target)
    sigmas = np.full(num_target, math.sqrt(2.0) * args.sigma)
    rows: list[tuple[float, ...]] = []
    limit, is_certified = 1, False
    while not is_certified and limit <= 100_000_000:
        start = time.process_time()
        field = mixture_field(problem.target, np.full(num_target, weight), sigmas)
        term = Term(problem.source, np.ones(len(problem.source)), field)
        # Half of the gap is left for the field's error.
        found = search([term], SearchSettings(gap=0.5 * args.engine_gap, max_boxes=limit))
        seconds = time.process_time() - start
        # The field is the mixture to within a proven error, which belongs into the bounds.
        slack = field.error * len(problem.source)
        row = (found.num_boxes, seconds, found.lower_bound - slack, found.upper_bound + slack)
        if rows or limit > 1:  # the first run loads the machine code
            rows.append((len(rows), *row))
        is_certified = found.status is Status.CERTIFIED
        limit = math.ceil(limit * 1.3)
    trace = np.array(rows)
    # Every run ends with an ascent from its best pose, so a longer run may start from a worse one;
    # all their bounds hold.
    trace[:, 3] = np.maximum.accumulate(trace[:, 3])
    trace[:, 4] = np.minimum.accumulate(trace[:, 4])
    return trace


def _draw(traces: dict[str, NDArray[np.float64]], args: argparse.Namespace) -> None:
    made, axes = figure(1, 3, width=11.0, height=3.6)
    bounds, boxes, seconds = axes[0]
    reference = traces[_REFERENCE]
    bounds.plot(reference[:, 0], reference[:, 4], color=COLOURS[1], label="upper bound")
    bounds.plot(reference[:, 0], reference[:, 3], color=COLOURS[0], label="lower bound")
    bounds.set(
        title=f"{_REFERENCE}, m = {args.points}",
        xlabel="iteration",
        ylabel="objective, maximised",
        ylim=(0.0, 4.0 * reference[-1, 4]),
    )
    bounds.legend()
    for number, (name, trace) in enumerate(traces.items()):
        gap = np.maximum((trace[:, 4] - trace[:, 3]) / trace[:, 4], 1e-6)
        style: dict[str, Any] = {"color": COLOURS[number], "label": name}
        if name == _REFERENCE:  # the same search as the next one, stopped earlier
            style |= {"linewidth": 5, "alpha": 0.35}
        boxes.loglog(np.maximum(trace[:, 1], 1), gap, **style)
        cpu_s = np.maximum.accumulate(np.maximum(trace[:, 2], 1e-5))
        seconds.loglog(cpu_s, gap, **style)
        for axis, work in ((boxes, trace[-1, 1]), (seconds, cpu_s[-1])):
            axis.plot(work, gap[-1], "o", color=COLOURS[number], markersize=4)
    boxes.set(title="gap over the work", xlabel="boxes", ylabel="gap / upper bound")
    seconds.set(title="gap over the time", xlabel="CPU time [s]", ylabel="gap / upper bound")
    boxes.legend()
    save_figure(made, args.out / "convergence.png")


def _report(traces: dict[str, NDArray[np.float64]], args: argparse.Namespace) -> None:
    rows: list[tuple[str, ...]] = [
        ("paper, Figure 3", "hundreds", "", "", "0.01", "", "not stated"),
    ]
    for name, trace in traces.items():
        iterations, boxes, seconds, lower, upper = trace[-1]
        count = "" if name == _ENGINE else f"{iterations:.0f}"
        gap = (upper - lower) / upper
        rows.append(
            (
                name,
                count,
                f"{boxes:.0f}",
                f"{upper:.4f}",
                f"{upper - lower:.4f}",
                f"{100 * gap:.2f} %",
                f"{seconds:.4g}",
            )
        )
    print(f"m = {args.points}, outliers {args.outliers:.0%}, seed {args.seed}")
    print_table(("search", "iterations", "boxes", "upper", "gap", "relative gap", "CPU s"), rows)
