"""Nodes start quickly and small: what is large is loaded when it is first used."""

import json
import os
import subprocess
import sys

import pytest

pytest.importorskip("rclpy")

_LARGE = [
    "cv2",
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
_CLASSES = {
    "sonar_mapper": "SonarMapper",
    "registration_server": "RegistrationServer",
    "map_queue_manager": "MapQueueManager",
}
_REPORT = """
import importlib, json, resource, sys

def memory_mb():
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) * 1.024e-3 for line in file if line.startswith("VmRSS"))

module = importlib.import_module(f"uw_dslam_ros2.ros.nodes.{sys.argv[1]}")
modules, imported_mb = sorted(sys.modules), memory_mb()
import rclpy
rclpy.init()
node = getattr(module, sys.argv[2])(namespace="auv_1")
used = resource.getrusage(resource.RUSAGE_SELF)
values = modules, imported_mb, memory_mb(), used.ru_utime + used.ru_stime
node.destroy_node()
rclpy.try_shutdown()
print("report:", json.dumps(values))
"""
# What no node can do without.
_LEAST = """
import resource
import numba, rclpy
rclpy.init()
node = rclpy.create_node("node")
used = resource.getrusage(resource.RUSAGE_SELF)
print("report:", used.ru_utime + used.ru_stime)
"""
_IMPORTED_MB, _STARTED_MB = 160.0, 200.0
_MOST_TIMES_LEAST = 2.5
_ATTEMPTS = 3


def reported(domain_id, *program):
    """What a program prints at its end."""
    command = [sys.executable, "-c", *program]
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(domain_id),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    done = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
    return json.loads(done.stdout.rpartition("report:")[2])


@pytest.mark.parametrize("node", _CLASSES)
def test_a_node_that_starts_loads_nothing_large(node, ros_domain_id):
    # A first start writes its byte code, and others may be busy: it may try again.
    for _ in range(_ATTEMPTS):
        modules, imported_mb, started_mb, used_s = reported(
            ros_domain_id, _REPORT, node, _CLASSES[node]
        )
        assert not set(_LARGE) & set(modules)
        assert imported_mb <= _IMPORTED_MB
        assert started_mb <= _STARTED_MB
        allowed_s = _MOST_TIMES_LEAST * reported(ros_domain_id, _LEAST)
        if used_s <= allowed_s:
            return
    pytest.fail(f"started in {used_s:.2f} s of computing, expected at most {allowed_s:.2f} s")
