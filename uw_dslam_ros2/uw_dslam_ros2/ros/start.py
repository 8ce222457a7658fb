"""What the nodes' commands call: until a node is imported, a signal ends its process at once."""

from __future__ import annotations

import functools
import importlib
import os
import signal
from collections.abc import Callable
from typing import Any

from uw_dslam_ros2.node_names import EXECUTABLES


def __getattr__(name: str) -> Callable[[], int]:
    """The command of each node, by its name."""
    if name not in EXECUTABLES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return functools.partial(_run, name)


def _run(name: str) -> int:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _end_at_once)
    module = importlib.import_module(f"uw_dslam_ros2.ros.nodes.{name}")
    return int(module.main())


def _end_at_once(*_: Any) -> None:
    # Nothing is begun that has to be kept, and importing does not survive an exception.
    os._exit(0)
