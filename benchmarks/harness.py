"""What the benchmarks share: timing, and JSON lines that tell where they were measured."""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["Budget", "Timing", "context", "emit", "require", "run_cases", "tables", "timed"]

_CONTEXT: dict[str, Any] = {}
_ROWS: list[dict[str, Any]] = []


class Budget:
    """Seconds that a case may take, for cases that can make do with fewer trials."""

    seconds = 300.0  # --minutes sets it
    start = 0.0

    @classmethod
    def restart(cls) -> None:
        """Begin a case."""
        cls.start = time.monotonic()

    @classmethod
    def left_s(cls, share: float = 1.0) -> float:
        """Seconds left until that share of the case's time is used up."""
        return cls.start + share * cls.seconds - time.monotonic()


def context() -> dict[str, Any]:
    """Commit, machine and versions, looked up once."""
    if not _CONTEXT:
        root = Path(__file__).resolve().parent
        git = ["git", "-C", str(root)]
        commit = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True)
        changed = subprocess.run(
            [*git, "status", "--porcelain", "--untracked-files=no"], capture_output=True
        )
        _CONTEXT.update(
            commit=commit.stdout.decode().strip() + ("+changes" if changed.stdout.strip() else ""),
            cpu=_cpu_name(),
            cores=len(os.sched_getaffinity(0)),
            python=platform.python_version(),
            **{name: metadata.version(name) for name in ("numpy", "scipy", "numba")},
        )
    return _CONTEXT


def _cpu_name() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


class Timing:
    """Wall and CPU seconds of repeated runs."""

    def __init__(self) -> None:
        self.wall_s: list[float] = []
        self.cpu_s: list[float] = []

    def add(self, wall_s: float, cpu_s: float) -> None:
        """Note one run."""
        self.wall_s.append(wall_s)
        self.cpu_s.append(cpu_s)

    def row(self, prefix: str = "") -> dict[str, float]:
        """Medians and 95th percentiles; other jobs on the machine disturb CPU time least."""
        return {
            f"{prefix}runs": len(self.wall_s),
            f"{prefix}median_s": _rounded(np.median(self.wall_s)),
            f"{prefix}p95_s": _rounded(np.percentile(self.wall_s, 95)),
            f"{prefix}cpu_median_s": _rounded(np.median(self.cpu_s)),
            f"{prefix}cpu_p95_s": _rounded(np.percentile(self.cpu_s, 95)),
        }


def timed[T](call: Callable[[], T], timing: Timing) -> T:
    """Run `call` and note its time."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = call()
    timing.add(time.perf_counter() - wall, time.process_time() - cpu)
    return result


def require(is_true: bool, what: str) -> None:
    """Stop where the answer is wrong: its time is worth nothing."""
    if not is_true:
        raise SystemExit(f"wrong answer: {what}")


def emit(case: str, values: Mapping[str, Any]) -> None:
    """Print one JSON line."""
    plain = {key: _plain(value) for key, value in values.items()}
    row = {"case": case, **plain, "load": round(os.getloadavg()[0], 2), **context()}
    _ROWS.append(row)
    print(json.dumps(row), flush=True)


def tables(rows: Sequence[Mapping[str, Any]]) -> str:
    """Markdown: one table a case, without what is the same in all rows of a run."""
    known = {"case", "load", *context()}
    lines = []
    for case in dict.fromkeys(row["case"] for row in rows):
        group = [row for row in rows if row["case"] == case]
        keys = [key for key in dict.fromkeys(k for row in group for k in row) if key not in known]
        cells = [[_text(row.get(key)) for key in keys] for row in group]
        if len(group) == 1:
            keys, cells = ["figure", case], [list(pair) for pair in zip(keys, *cells, strict=True)]
        lines += [
            f"**{case}**, load {group[0].get('load')}",
            "",
            _line(keys),
            "|---" * len(keys) + "|",
        ]
        lines += [*map(_line, cells), ""]
    return "\n".join(lines)


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _text(value: Any) -> str:
    return "" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def run_cases(
    description: str, cases: Mapping[str, Callable[[bool], None]], argv: list[str] | None = None
) -> int:
    """Command line of a benchmark: all cases, or those named."""
    parser = argparse.ArgumentParser(description=description)
    texts = "; ".join(
        f"{name}: {(case.__doc__ or '').split('.')[0]}" for name, case in cases.items()
    )
    escaped = texts.replace("%", "%%")  # argparse formats its help texts
    parser.add_argument("case", nargs="*", help=f"cases to run (default: all). {escaped}")
    parser.add_argument("--quick", action="store_true", help="few runs, to see that it works")
    parser.add_argument(
        "--minutes", type=float, default=5.0, help="for cases that can do with fewer trials"
    )
    parser.add_argument("--out", type=Path, help="file that gets the JSON lines, too")
    parser.add_argument("--table", type=Path, help="print the tables of such a file and stop")
    args = parser.parse_args(argv)
    if args.table:
        print(tables([json.loads(line) for line in args.table.read_text().splitlines()]))
        return 0
    unknown = [name for name in args.case if name not in cases]
    if unknown:
        parser.error(f"no case {unknown[0]!r}; there are {', '.join(cases)}")
    Budget.seconds = 60.0 * args.minutes
    failed = []
    for name in args.case or cases:
        print(f"# {name}", file=sys.stderr, flush=True)
        Budget.restart()
        try:
            cases[name](args.quick)
        except SystemExit as error:
            # A wrong answer of one case is no reason to lose the others.
            failed.append(name)
            print(f"# {name}: {error}", file=sys.stderr, flush=True)
        if args.out:
            args.out.write_text("".join(json.dumps(row) + "\n" for row in _ROWS))
    print(tables(_ROWS), file=sys.stderr)
    if failed:
        print(f"# wrong: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


def _rounded(value: Any) -> float:
    return float(f"{float(value):.4g}")


def _plain(value: Any) -> Any:
    if isinstance(value, float | np.floating):
        return _rounded(value) if np.isfinite(value) else None  # JSON knows no NaN
    return value.item() if isinstance(value, np.generic) else value
