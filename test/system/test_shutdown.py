"""SIGINT and SIGTERM end every node soon and with exit code 0, whatever it is doing."""

import os
import signal
import socket
import subprocess
import sys
import time

import pytest

pytest.importorskip("rclpy")

pytestmark = [pytest.mark.ros, pytest.mark.slow]

NODES = ("sonar_mapper", "registration_server", "map_queue_manager", "bag_player")
SIGNALS = (signal.SIGINT, signal.SIGTERM)
START_S = 90.0
LIMIT_S = 3.0
"""Under two seconds of the node's own, and what a busy machine takes to end a process."""

_BUSY = """
import sys, time
from rclpy.node import Node
from uw_dslam_ros2.ros.plumbing.running import run_node

class Busy(Node):
    def __init__(self):
        super().__init__("busy")
        print("spinning", flush=True)

    def stop(self):
        time.sleep(60.0)

sys.exit(run_node("busy", Busy, []))
"""


@pytest.fixture
def begin(ros_domain_id, tmp_path):
    """``begin(code, *arguments)``: a Python process on a domain of its own; killed at the end."""
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(ros_domain_id),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(tmp_path / "ros_logs"),
    }
    processes = []

    def start(code, *arguments):
        process = subprocess.Popen(
            [sys.executable, "-c", code, *arguments],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        processes.append(process)
        return process

    yield start
    for process in processes:
        process.kill()
        process.wait()
        process.stdout.close()


def wait_for_line(process, word):
    end_s = time.monotonic() + START_S
    while word not in (line := process.stdout.readline()):
        assert line or process.poll() is None, f"ended with {process.returncode} before {word!r}"
        assert time.monotonic() < end_s, f"not within {START_S} s: {word}"


def ended_with(process, number):
    """Exit code after a signal; how long that takes is limited."""
    begun_s = time.monotonic()
    process.send_signal(number)
    code = process.wait(START_S)
    assert time.monotonic() - begun_s < LIMIT_S
    return code


@pytest.mark.parametrize("number", SIGNALS)
def test_a_node_that_still_waits_for_something_is_ended(begin, number):
    process = begin(_BUSY)
    wait_for_line(process, "spinning")
    assert ended_with(process, number) == 0


def test_systemd_hears_that_a_node_is_ready_and_alive(begin, tmp_path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        listener.settimeout(START_S)
        asked = {"NOTIFY_SOCKET": listener.getsockname(), "WATCHDOG_USEC": "300000"}
        process = begin(f"import os; os.environ.update({asked!r})\n{_BUSY}")
        said = [listener.recv(100) for _ in range(4)]
        assert said == [b"READY=1", *3 * [b"WATCHDOG=1"]]
        process.send_signal(signal.SIGTERM)
        while (word := listener.recv(100)) == b"WATCHDOG=1":
            pass
        assert word == b"STOPPING=1"


@pytest.mark.parametrize(
    ("node", "word"),
    [
        ("sonar_mapper", "mapping auv_1"),
        ("registration_server", "serving"),
        ("map_queue_manager", "waiting for submaps"),
    ],
)
def test_nodes_end_when_told(begin, node, word):
    code = f"import sys; from uw_dslam_ros2.ros.start import {node}; sys.exit({node}())"
    for number in SIGNALS:
        process = begin(code, "--ros-args", "-r", "__ns:=/auv_1")
        wait_for_line(process, word)
        assert ended_with(process, number) == 0


@pytest.mark.parametrize("number", SIGNALS)
@pytest.mark.parametrize("node", NODES)
def test_a_node_that_is_still_starting_ends_at_once(begin, node, number):
    mark = "sys.meta_path.insert(0, type('Mark', (), {'find_spec': staticmethod(found)}))"
    code = f"""
import sys
def found(name, *_):
    if name == "uw_dslam_ros2.ros.nodes":
        print("importing", flush=True)
from uw_dslam_ros2.ros.start import {node}
{mark}
sys.exit({node}())
"""
    process = begin(code)
    wait_for_line(process, "importing")
    assert ended_with(process, number) == 0
