"""What the nodes' commands call: until a node is imported, a signal ends its process at once."""

from __future__ import annotations

import importlib
import os
import signal
from typing import Any

__all__ = [
    "acoustic_link",
    "bag_player",
    "channel",
    "map_queue_manager",
    "registration_server",
    "sonar_mapper",
]


def acoustic_link() -> int:
    """See `nodes.acoustic_link`."""
    return _run("acoustic_link")


def bag_player() -> int:
    """See `nodes.bag_player`."""
    return _run("bag_player")


def channel() -> int:
    """See `nodes.channel`."""
    return _run("channel")


def map_queue_manager() -> int:
    """See `nodes.map_queue_manager`."""
    return _run("map_queue_manager")


def registration_server() -> int:
    """See `nodes.registration_server`."""
    return _run("registration_server")


def sonar_mapper() -> int:
    """See `nodes.sonar_mapper`."""
    return _run("sonar_mapper")


def _run(name: str) -> int:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _end_at_once)
    module = importlib.import_module(f"uw_dslam_ros2.ros.nodes.{name}")
    return int(module.main())


def _end_at_once(*_: Any) -> None:
    # Nothing is begun that has to be kept, and importing does not survive an exception.
    os._exit(0)
