"""Compile the kernels once, so that nobody's first call waits for it.

Example::

    ./uw python -m uw_dslam_ros2.cli.warm_up
"""

from __future__ import annotations

import importlib
import os
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import uw_dslam_ros2

__all__ = ["main", "warm_up_modules"]


def warm_up_modules() -> list[str]:
    """Names of all modules called ``warm_up`` below ``core`` and ``sim``, sorted."""
    root = Path(uw_dslam_ros2.__file__).parent
    files = [file for part in ("core", "sim") for file in root.glob(f"{part}/**/warm_up.py")]
    names = (".".join(file.relative_to(root).with_suffix("").parts) for file in files)
    return sorted(f"{uw_dslam_ros2.__name__}.{name}" for name in names)


def _run(name: str) -> tuple[str, float]:
    start = time.perf_counter()
    importlib.import_module(name).warm_up()
    return name, time.perf_counter() - start


def main() -> None:
    """Run every kernel on something small; numba keeps the machine code on disk."""
    num_workers = max(1, len(os.sched_getaffinity(0)))
    # A fresh interpreter each: nothing that one part loads is shared with another.
    with ProcessPoolExecutor(num_workers, mp_context=get_context("spawn")) as pool:
        for name, seconds in pool.map(_run, warm_up_modules()):
            print(f"{name}: {seconds:.1f} s", flush=True)


if __name__ == "__main__":
    main()
