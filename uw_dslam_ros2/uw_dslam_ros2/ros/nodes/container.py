"""Several nodes in one process, on one executor, which takes less memory than one process each.

::

    ros2 run uw_dslam_ros2 container sonar_mapper map_queue_manager registration_server \
        --ros-args -r sonar_mapper:__ns:=/auv_1 --params-file settings.yaml

rclpy has no components that a container loads by a service; this one has its nodes from its
command line. Parameters and remappings go to one of them by its name, as above.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

from rclpy.logging import get_logger
from rclpy.utilities import remove_ros_args

from uw_dslam_ros2.ros.plumbing.running import run_nodes

__all__ = ["main"]

_CLASSES = {
    "sonar_mapper": "SonarMapper",
    "registration_server": "RegistrationServer",
    "map_queue_manager": "MapQueueManager",
    "acoustic_link": "AcousticLinkNode",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the nodes that are named until stopped."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    names = remove_ros_args(["container", *arguments])[1:]
    wrong = [name for name in names if name not in _CLASSES]
    if wrong or not names or len(set(names)) < len(names):
        get_logger("container").fatal(
            f"the nodes are {names}, expected one or more, each once, of {', '.join(_CLASSES)}"
        )
        return 1
    modules = (importlib.import_module(f"uw_dslam_ros2.ros.nodes.{name}") for name in names)
    makers = [getattr(module, _CLASSES[n]) for n, module in zip(names, modules, strict=True)]
    return run_nodes("container", makers, argv)
