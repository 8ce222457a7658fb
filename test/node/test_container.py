"""Mapper, manager and server in one process."""

import os
import subprocess
import sys

import pytest

pytest.importorskip("rclpy")

import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile
from uw_dslam_msgs.msg import MergeStatus

from uw_dslam_ros2.ros.nodes import container

pytestmark = pytest.mark.ros

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
START = "import sys; from uw_dslam_ros2.ros.nodes.container import main; sys.exit(main())"
NAMES = ("sonar_mapper", "map_queue_manager", "registration_server")
MEMORY_MB = 250.0
"""Of all three; one process each takes twice as much."""


def test_three_nodes_share_a_process(ros_context, ros_domain_id, spinning, tmp_path):
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(ros_domain_id),
        "ROS_LOG_DIR": str(tmp_path),
    }
    settings = tmp_path / "settings.yaml"
    settings.write_text("/auv_1/sonar_mapper: {ros__parameters: {input: scan}}")
    ros = ["--ros-args", "-r", "sonar_mapper:__ns:=/auv_1", "--params-file", str(settings)]
    process = subprocess.Popen([sys.executable, "-c", START, *NAMES, *ros], env=environment)
    probe, heard = rclpy.create_node("probe", context=ros_context), []
    probe.create_subscription(MergeStatus, "/merge_status", heard.append, LATCHED)
    expected = {(name, "/auv_1" if name == "sonar_mapper" else "/") for name in NAMES}
    try:
        with spinning(probe) as until:
            until(lambda: expected <= set(probe.get_node_names_and_namespaces()), "the nodes")
            # The manager asks the server, though both wait on one executor.
            until(lambda: heard and heard[-1].num_servers == 1, "the server")
            until(lambda: probe.get_subscriptions_info_by_topic("/auv_1/scan"), "the parameter")
            with open(f"/proc/{process.pid}/status") as file:
                memory_kb = next(line.split()[1] for line in file if line.startswith("VmRSS"))
        process.terminate()
        assert process.wait(10.0) == 0
    finally:
        process.kill()
        process.wait()
    assert int(memory_kb) * 1.024e-3 <= MEMORY_MB


@pytest.mark.parametrize("names", [[], ["talker"], ["sonar_mapper", "sonar_mapper"]])
def test_what_is_no_node_is_refused(names, capfd):
    assert container.main(names) == 1
    assert f"the nodes are {names}, expected one or more" in capfd.readouterr().err
