"""How every node starts, spins and ends."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Sequence

import rclpy
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.utilities import try_shutdown

from uw_dslam_ros2.core.errors import UwDslamError

__all__ = ["run_node"]


def run_node(name: str, make_node: Callable[[], Node], argv: Sequence[str] | None) -> int:
    """Spin a node until SIGINT or SIGTERM; return the process's exit code.

    A node whose callbacks wait says in `num_threads` how many threads it needs. A wrong setting or
    file ends it with one sentence and code 1, not with a traceback.
    """
    rclpy.init(args=None if argv is None else list(argv))
    node: Node | None = None
    try:
        node = make_node()
        executor = MultiThreadedExecutor(getattr(node, "num_threads", 4))
        executor.add_node(node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except UwDslamError as error:
        get_logger(name).fatal(str(error))
        return 1
    finally:
        # A second SIGINT while ending must not tear the node apart half-way.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        if node is not None:
            node.destroy_node()
        try_shutdown()
        sys.stdout.flush()
    return 0
