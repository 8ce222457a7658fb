"""How nodes start, spin and end: each in a process of its own, or several in one."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args, try_shutdown

from uw_dslam_ros2.core.errors import UwDslamError
from uw_dslam_ros2.ros.plumbing.heartbeat import Heartbeat

__all__ = ["init_ros", "run_node", "run_nodes"]

_LOOK_UP_S = 0.2
_END_WITHIN_S = 1.7
"""Launch files and service managers kill after a few seconds; by then we are gone."""


def init_ros(name: str, argv: Sequence[str] | None, **options: Any) -> bool:
    """Do what `rclpy.init` does; False: the arguments are wrong, and the log says why."""
    try:
        rclpy.init(args=None if argv is None else list(argv), **options)
    except RuntimeError as error:  # base of all that rcl raises
        # Where in rcl's own source it was found says nothing to who wrote the arguments.
        get_logger(name).fatal(re.sub(r", at \S+:\d+", "", str(error)))
        return False
    return True


def _let_callbacks_end(executor: MultiThreadedExecutor) -> None:
    """Wait for the callbacks at hand; the executor's own shutdown does not."""
    executor.shutdown()
    pool = getattr(executor, "_executor", None)
    if pool is not None:
        pool.shutdown(wait=True, cancel_futures=True)


def _end_in_time(name: str, is_stopped: threading.Event) -> None:
    """End the process, some time after it was told to, whatever it still waits for.

    What anybody was told of is saved by then: a hard end loses what a kill would.
    """
    is_stopped.wait()
    time.sleep(_END_WITHIN_S)
    get_logger(name).warning(f"ended in the middle of a job that took over {_END_WITHIN_S} s")
    os._exit(0)


def run_node(name: str, make_node: Callable[[], Node], argv: Sequence[str] | None) -> int:
    """Spin a node until SIGINT or SIGTERM; see `run_nodes`.

    Arguments that are not ROS's are refused: what was meant by them would be left out.
    """
    arguments = sys.argv[1:] if argv is None else argv
    with contextlib.suppress(RuntimeError):  # which `init_ros` tells of
        if own := remove_ros_args([name, *arguments])[1:]:
            get_logger(name).fatal(
                f"arguments {' '.join(own)} are none of ROS: those follow --ros-args, as in "
                "--ros-args -r __ns:=/auv_1 -p name:=value --params-file FILE; docs/interfaces.md "
                "lists the parameters"
            )
            return 1
    return run_nodes(name, [make_node], argv)


def run_nodes(
    name: str, make_nodes: Sequence[Callable[[], Node]], argv: Sequence[str] | None
) -> int:
    """Spin nodes on one executor until SIGINT or SIGTERM; return the process's exit code.

    A node whose callbacks wait says in `num_threads` how many threads it needs, and has a method
    `stop` that ends their waiting; all have under two seconds for that. A wrong setting or file
    ends the process with one sentence and code 1, not with a traceback. `name` is for the log.
    """
    # rclpy's own handlers would pull the context away under callbacks that still want to answer.
    if not init_ros(name, argv, signal_handler_options=SignalHandlerOptions.NO):
        return 1
    is_stopped = threading.Event()

    def stop(*_: Any) -> None:
        is_stopped.set()  # a second signal changes nothing: it must not tear the node half-way

    threading.Thread(target=_end_in_time, args=(name, is_stopped), daemon=True).start()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    nodes: list[Node] = []
    try:
        for make_node in make_nodes:
            nodes.append(make_node())
        executor = MultiThreadedExecutor(sum(getattr(node, "num_threads", 4) for node in nodes))
        for node in nodes:
            executor.add_node(node)
        heartbeat = Heartbeat()
        heartbeat.is_ready()
        while not is_stopped.is_set():
            heartbeat.beat()
            executor.spin_once(timeout_sec=_LOOK_UP_S)
        heartbeat.is_stopping()
        for node in nodes:
            if hasattr(node, "stop"):
                node.stop()
        _let_callbacks_end(executor)
    except ExternalShutdownException:
        pass
    except UwDslamError as error:
        get_logger(name).fatal(str(error))
        return 1
    finally:
        for node in nodes:
            node.destroy_node()
        try_shutdown()
    return 0
