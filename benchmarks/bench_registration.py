"""Registration of point sets: proof, speed, accuracy, and the other methods in the same run.

``python benchmarks/bench_registration.py [CASE ...] [--quick]`` prints one JSON line per
measurement and their tables at the end. Every case checks its answers first, against the NumPy
reference or the planted truth. Cases with many trials stop at ``--minutes`` each and say how many
they made.
"""

from __future__ import annotations

import json
import math
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from harness import Budget, Timing, emit, require, run_cases, timed

from uw_dslam_ros2.cli.studies._trials import ENGINE, ORACLE, TRUTH, Cell, run_cell, summarise
from uw_dslam_ros2.core.registration import register_point_sets
from uw_dslam_ros2.core.registration.baselines.paper_reference import (
    Boxes,
    MixturePair,
    objective,
    register_reference,
)
from uw_dslam_ros2.core.registration.search.branch_and_bound import (
    SearchOutcome,
    SearchSettings,
    Status,
    Term,
    search,
)
from uw_dslam_ros2.core.registration.search.field import Field, mixture_field
from uw_dslam_ros2.sim.maps.point_sets import PointSetProblem, outlier_problem

_SIGMA_M = 0.1  # the paper's
_NODES_PER_SIGMA = 5.0  # of the field's lattice; its error falls with the third power
_SEARCH_SHARE = 0.45  # of the gap; the rest is for the field's error
_PEERS = ["ICP, 36 starts", "correlative BnB", "pair voting"]
_GO_ICP = "Go-ICP in SE(2)"


def proof(problem: PointSetProblem, gap: float = 0.01) -> tuple[SearchOutcome, float, float]:
    """The paper's objective with weights 1 / (m n), and proven bounds of its maximum."""
    m = len(problem.source)
    field = _field(problem)
    slack = field.error * m
    # The field's own error is part of the gap that is promised.
    term = Term(problem.source, np.ones(m), field)
    found = search([term], SearchSettings(gap=_SEARCH_SHARE * gap))
    return found, found.lower_bound - slack, found.upper_bound + slack


def _field(problem: PointSetProblem) -> Field:
    m, n = len(problem.source), len(problem.target)
    weights, sigmas_m = np.full(n, 1.0 / (m * n)), np.full(n, math.sqrt(2.0) * _SIGMA_M)
    return mixture_field(problem.target, weights, sigmas_m, nodes_per_sigma=_NODES_PER_SIGMA)


def check_proof(problem: PointSetProblem, gap: float = 0.01) -> None:
    """The pose's exact value lies between the bounds, and the gap is closed."""
    found, lower, upper = proof(problem, gap)
    pair = MixturePair.build(problem.source, problem.target, _SIGMA_M)
    T = found.T_target_source
    value = -float(objective(pair, [T.yaw], [[T.x, T.y]])[0])
    require(found.status is Status.CERTIFIED, f"status {found.status}")
    require(lower <= value <= upper, f"value {value} outside [{lower}, {upper}]")
    require(upper - lower <= gap * upper, f"gap {(upper - lower) / upper} above {gap}")


def speed(
    case: str,
    num_points: int,
    outlier_share: float,
    runs: int,
    *,
    proof_s: float | None = None,
    chain_s: float | None = None,
) -> None:
    """Time the proof alone and the whole chain on fresh problems of one kind."""
    first = outlier_problem(num_points, outlier_share, seed=0)
    check_proof(first)
    register_point_sets(first.source, first.target)
    searched, chain, boxes, right = Timing(), Timing(), [], 0
    for seed in range(runs):
        if seed >= 3 and Budget.left_s() < 0.0:
            break
        problem = outlier_problem(num_points, outlier_share, seed=seed)
        boxes.append(timed(lambda p=problem: proof(p), searched)[0].num_boxes)
        result = timed(lambda p=problem: register_point_sets(p.source, p.target), chain)
        error_m, error_rad = result.T_target_source.distance_to(problem.T_target_source)
        right += error_m < 0.05 and error_rad < math.radians(2.0) and result.is_certified
    emit(
        case,
        {
            "m": num_points,
            "n": len(first.target),
            "gap": 0.01,
            "sigma_m": _SIGMA_M,
            **searched.row(),
            "asked_s": proof_s,
            "boxes_median": float(np.median(boxes)),
            **chain.row("chain_"),
            "chain_asked_s": chain_s,
            "chain_right_and_certified": right / len(boxes),
        },
    )


def m50(quick: bool) -> None:
    """M = n = 50 of the paper's protocol to a proven gap of 1 %."""
    speed("m50", 50, 0.0, 10 if quick else 200, proof_s=0.010)


def m100(quick: bool) -> None:
    """100 against 200 points, half of them outliers: the whole chain."""
    speed("m100", 100, 0.5, 5 if quick else 100, chain_s=0.020)


def m100_in_1000(quick: bool) -> None:
    """100 against 1000 points, nine in ten of them outliers: the whole chain."""
    speed("m100_in_1000", 100, 0.9, 3 if quick else 50, chain_s=0.200)


def m200(quick: bool) -> None:
    """200 against 400 points, half of them outliers."""
    speed("m200", 200, 0.5, 3 if quick else 50, proof_s=0.150)


def m1000(quick: bool) -> None:
    """1000 against 1000 points."""
    speed("m1000", 1000, 0.0, 1 if quick else 10, proof_s=1.0)


def reference(quick: bool) -> None:
    """Ratio to reference.py at m = n = 50: its absolute gap 0.01, our 1 % and our 0.01."""
    box = Boxes(np.zeros(1), np.zeros((1, 2)), math.pi, 1.0)
    check_proof(outlier_problem(50, seed=0))
    fast, same, slow, iterations = Timing(), Timing(), Timing(), []
    for seed in range(1 if quick else 5):
        problem = outlier_problem(50, seed=seed)
        pair = MixturePair.build(problem.source, problem.target, _SIGMA_M)
        found = timed(lambda p=pair: register_reference(p, box=box, gap=0.01), slow)
        iterations.append(found.num_iterations)
        for _ in range(5):
            _, lower, upper = timed(lambda p=problem: proof(p), fast)
            relative = 0.009 / upper
            _, low, high = timed(lambda p=problem, g=relative: proof(p, g), same)
        require(high - low <= 0.01, "the engine's absolute gap exceeds 0.01")
        require(upper - lower <= 0.01, "the engine's absolute gap exceeds 0.01")
        require(lower <= -found.lower_bound, "the engine's bounds lie above the reference's")
        require(upper >= -found.upper_bound, "the engine's bounds lie below the reference's")
    emit(
        "reference",
        {
            "m": 50,
            "n": 50,
            **fast.row("engine_"),
            **same.row("engine_same_gap_"),
            **slow.row("reference_"),
            "reference_iterations_median": float(np.median(iterations)),
            "ratio_cpu": np.median(slow.cpu_s) / np.median(fast.cpu_s),
            "ratio_cpu_same_gap": np.median(slow.cpu_s) / np.median(same.cpu_s),
            "asked_ratio": 1000,
        },
    )


def memory(quick: bool) -> None:
    """3000 against 3000 points, peak memory of the process."""
    m = 1000 if quick else 3000
    code = (
        "import json, resource, time\n"
        "from uw_dslam_ros2.core.registration import register_point_sets\n"
        "from uw_dslam_ros2.sim.maps.point_sets import outlier_problem\n"
        f"p = outlier_problem({m}, 0.0, 0.005, seed=0)\n"
        "base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "start = time.perf_counter()\n"
        "r = register_point_sets(p.source, p.target)\n"
        "wall = time.perf_counter() - start\n"
        "peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "error = r.T_target_source.distance_to(p.T_target_source)\n"
        "print(json.dumps([wall, time.process_time(), base, peak, r.is_certified, *error]))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    wall, cpu, base, peak, is_certified, error_m, error_rad = json.loads(done.stdout)
    require(is_certified, "not certified")
    require(error_m < 0.05 and error_rad < math.radians(2.0), f"{error_m} m, {error_rad} rad off")
    emit(
        "memory",
        {
            "m": m,
            "n": m,
            "wall_s": wall,
            "process_cpu_s": cpu,
            "before_mib": base / 1024,
            "peak_mib": peak / 1024,
            "asked_mib": 1024,
        },
    )


def exponent(quick: bool) -> None:
    """Exponent of the time over m = n, of the proof and of the chain."""
    sizes = [50, 100, 200, 400] if quick else [50, 100, 200, 400, 800, 1600]
    runs = 2 if quick else 7
    check_proof(outlier_problem(50, seed=0))
    register_point_sets(*_sets(outlier_problem(50, seed=0)))
    medians: dict[str, list[float]] = {"proof": [], "chain": []}
    for k, m in enumerate(sizes, 1):
        timings = {name: Timing() for name in medians}
        for seed in range(runs):
            if seed >= 2 and Budget.left_s(k / len(sizes)) < 0.0:
                break
            problem = outlier_problem(m, seed=seed)
            timed(lambda p=problem: proof(p), timings["proof"])
            timed(lambda p=problem: register_point_sets(*_sets(p)), timings["chain"])
        for name, timing in timings.items():
            medians[name].append(float(np.median(timing.cpu_s)))
    for name, values in medians.items():
        slope = float(np.polyfit(np.log(sizes), np.log(values), 1)[0])
        rows = {"m": sizes, "cpu_median_s": [float(f"{v:.4g}") for v in values]}
        emit(f"exponent, {name}", {**rows, "exponent": slope, "asked_exponent": 1.3})


def breakdown(quick: bool) -> None:
    """Boxes per second, together and one by one; where the chain's time goes; floors."""
    for m, share in ((50, 0.0), (100, 0.5), (200, 0.5)):
        tables, searched, chain, boxes, cells = Timing(), Timing(), Timing(), [], []
        for seed in range(3 if quick else 20):
            problem = outlier_problem(m, share, seed=seed)
            field = timed(lambda p=problem: _field(p), tables)
            settings = SearchSettings(gap=0.01 * _SEARCH_SHARE)
            term = Term(problem.source, np.ones(m), field)
            found = timed(lambda t=term, s=settings: search([t], s), searched)
            boxes.append(found.num_boxes)
            cells.append(found.num_cells)
            timed(lambda p=problem: register_point_sets(*_sets(p)), chain)
        seconds = float(np.sum(searched.cpu_s))
        together = sum(boxes) + sum(cells)
        emit(
            "breakdown",
            {
                "m": m,
                "n": len(problem.target),
                **tables.row("tables_"),
                **searched.row("search_"),
                **chain.row("chain_"),
                "boxes_median": float(np.median(boxes)),
                "swept_cells_median": float(np.median(cells)),
                "boxes_and_cells_per_s": together / seconds,
                "ns_per_point_and_box": 1e9 * seconds / (together * m),
                "floor_ns_per_addition": _addition_ns(),
                "floor_ns_per_look_up": _look_up_ns(field.num_bytes),
                "table_mib": field.num_bytes / 2**20,
            },
        )


def _addition_ns() -> float:
    """What adding a row of a table in the cache costs per element here, in NumPy."""
    row, total = np.ones(16_384, dtype=np.float32), np.zeros(16_384, dtype=np.float32)
    start = time.process_time()
    for _ in range(5_000):
        np.add(total, row, out=total)
    return 1e9 * (time.process_time() - start) / (5_000 * len(row))


def _look_up_ns(num_bytes: int) -> float:
    """What a gather from a table of that size costs per element here, in NumPy."""
    rng = np.random.default_rng(0)
    table = rng.random(num_bytes // 4, dtype=np.float32)
    places = rng.integers(0, len(table), 1_000_000)
    table.take(places)
    start = time.process_time()
    for _ in range(5):
        table.take(places)
    return 1e9 * (time.process_time() - start) / 5e6


def first_call(quick: bool) -> None:
    """First call in a fresh process, caches in place, import included."""
    code = (
        "import time; start = time.perf_counter()\n"
        "from uw_dslam_ros2.core.registration import register_point_sets\n"
        "imported = time.perf_counter()\n"
        "import numpy as np\n"
        "rng = np.random.default_rng(0)\n"
        "x = rng.uniform(-1, 1, (50, 2))\n"
        "begin = time.perf_counter()\n"
        "register_point_sets(x, x + [1.0, 2.0])\n"
        "print(imported - start, time.perf_counter() - begin)\n"
    )
    rows = []
    for _ in range(3 if quick else 10):
        cpu = _children_cpu_s()
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
        rows.append([*map(float, done.stdout.split()), _children_cpu_s() - cpu])
    imports, calls, cpu_s = np.median(rows[1:], axis=0)
    emit(
        "first_call",
        {
            "runs": len(rows) - 1,
            "import_median_s": imports,
            "call_median_s": calls,
            "process_cpu_median_s": cpu_s,
            "asked_s": 1.5,
        },
    )


def _children_cpu_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def peers(quick: bool) -> None:
    """Success and time of every global method in the protocol's cells, with ratios."""
    cells = [Cell(m, share) for m in (50, 100, 200) for share in (0.33, 0.5, 0.7, 0.8)]
    cells += [Cell(100, 0.9), Cell(100, 0.9, 0.02), Cell(100, 0.5, 0.02)]
    cells = cells[:4] if quick else cells
    _trials("peers", cells, [ENGINE, *_PEERS], 3 if quick else 30, slow=[_GO_ICP])


def accuracy(quick: bool) -> None:
    """Accuracy and success of the whole chain over 200 trials, m = 100."""
    cells = [Cell(100, 0.33), Cell(100, 0.5), Cell(100, 0.5, 0.02)]
    cells += [Cell(100, 0.8), Cell(100, 0.8, 0.02), Cell(100, 0.9, 0.02)]
    cells += [Cell(100, 0.0, 0.01, share) for share in (0.5, 0.3)]
    _trials("accuracy", cells, [ENGINE, ORACLE], 5 if quick else 200)


def hard(quick: bool) -> None:
    """Cells where every peer fails, and what polishing from the true pose would give."""
    cells = [Cell(m, 0.9, 0.05) for m in (50, 100, 200)]
    cells += [Cell(m, 0.0, 0.05, 0.3) for m in (50, 100, 200)]
    cells += [Cell(50, 0.0, 0.02, 0.2), Cell(100, 0.0, 0.02, 0.1)]
    _trials("hard", cells, [ENGINE, TRUTH, *_PEERS], 3 if quick else 60)


def _trials(
    case: str,
    cells: Sequence[Cell],
    methods: Sequence[str],
    trials: int,
    *,
    slow: Sequence[str] = (),
) -> None:
    """As many trials as the case's time allows in every cell; `slow` methods get three at most."""
    for k, cell in enumerate(cells, 1):
        start = time.monotonic()
        done = run_cell(cell, methods, range(min(3, trials)))
        # The methods' first calls count as well, so that the estimate is on the safe side.
        each_s = (time.monotonic() - start) / len({trial.seed for trial in done})
        more = int(max(Budget.left_s(k / len(cells)), 0.0) / each_s)
        if more and trials > 3:
            done += run_cell(cell, methods, range(3, min(trials, 3 + more)))
        if slow and Budget.left_s(k / len(cells)) > 0.0:
            done += run_cell(cell, slow, range(min(3, trials)))
        rows = summarise(done)
        engine = next(row for row in rows if row["method"] == ENGINE)
        for row in rows:
            ratio: dict[str, Any] = {}
            if row["method"] not in (ENGINE, ORACLE, TRUTH):
                ratio = {"cpu_over_engine": row["median_cpu_s"] / engine["median_cpu_s"]}
            emit(case, {"cell": str(cell), **row, **ratio})


def _sets(problem: PointSetProblem) -> tuple[np.ndarray, np.ndarray]:
    return problem.source, problem.target


CASES = {
    case.__name__: case
    for case in (
        m50, reference, m100, m100_in_1000, m200, m1000, memory, exponent, breakdown, first_call,
        peers, accuracy, hard,
    )
}  # fmt: skip

if __name__ == "__main__":
    sys.exit(run_cases(__doc__, CASES))
