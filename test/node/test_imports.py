"""Nodes start quickly and small: what is large is loaded when it is first used."""

import json
import subprocess
import sys

import pytest

pytest.importorskip("rclpy")

_LARGE = [
    "matplotlib",
    "networkx",
    "PIL",
    "rosbags",
    "scipy.linalg",
    "scipy.ndimage",
    "scipy.optimize",
    "scipy.sparse",
    "scipy.spatial",
    "scipy.special",
    "scipy.stats",
    "skimage",
    "sklearn",
]
_REPORT = (
    "import importlib, json, sys; importlib.import_module(sys.argv[1]); "
    "print(json.dumps(sorted(sys.modules)))"
)


@pytest.mark.parametrize("node", ["sonar_mapper", "registration_server", "map_queue_manager"])
def test_a_node_that_starts_loads_nothing_large(node):
    command = [sys.executable, "-c", _REPORT, f"uw_dslam_ros2.ros.nodes.{node}"]
    loaded = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    assert not set(_LARGE) & set(loaded)
