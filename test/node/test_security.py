"""Who has no keys sends no submaps, and who has keys sends only what its policy says."""

import os
import shutil
import subprocess
import time

import numpy as np
import pytest

pytest.importorskip("rclpy")

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from uw_dslam_msgs.msg import Submap as SubmapMsg

from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap
from uw_dslam_ros2.ros.convert.core_types import submap_to_msg
from uw_dslam_ros2.ros.nodes.map_queue_manager import MapQueueManager
from uw_dslam_ros2.ros.plumbing.qos import SUBMAPS
from uw_dslam_ros2.ros.plumbing.security_policy import policy_of

pytestmark = pytest.mark.ros

MAPPER, MANAGER, SERVER = "/auv_1/sonar_mapper", "/map_queue_manager", "/registration_server"
PATIENCE_S, LISTEN_S = 30.0, 3.0
NOT_BUILT = "doesn't have the security libraries"


@pytest.fixture
def keystore(tmp_path):
    """Keys of our policy's enclaves, by the commands of docs/trust.md."""
    ros2 = shutil.which("ros2")
    if ros2 is None or subprocess.run([ros2, "security", "-h"], capture_output=True).returncode:
        pytest.skip("needs `ros2 security` (sros2), which is not installed")
    policy, keys = tmp_path / "policy.xml", tmp_path / "keys"
    policy.write_text(policy_of(["auv_1"]))
    commands = [["create_keystore", keys]]
    for enclave in (MAPPER, MANAGER, SERVER):
        commands += [["create_enclave", keys, enclave]]
        commands += [["create_permission", keys, enclave, policy]]
    for command in commands:
        subprocess.run([ros2, "security", *map(str, command)], check=True)
    return keys


@pytest.fixture
def joined(ros_domain_id, monkeypatch):
    """``joined(enclave, keystore)``: a context with the keys of an enclave; None: without keys."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    contexts = []

    def join(enclave=None, keystore=None):
        is_secured = enclave is not None
        monkeypatch.setenv("ROS_SECURITY_ENABLE", "true" if is_secured else "false")
        monkeypatch.setenv("ROS_SECURITY_STRATEGY", "Enforce")
        monkeypatch.setenv("ROS_SECURITY_KEYSTORE", os.fspath(keystore or ""))
        context = rclpy.Context()
        arguments = ["--ros-args", "--enclave", enclave] if is_secured else []
        rclpy.init(args=arguments, context=context, domain_id=ros_domain_id)
        contexts.append(context)
        return context

    yield join
    for context in contexts:
        context.try_shutdown()


class Sender:
    """Sends a submap as the mapper of auv_1 does, under that or another node's name."""

    def __init__(self, context, sequence, node=MAPPER):
        namespace, _, name = node.rpartition("/")
        self.node = rclpy.create_node(name, namespace=namespace, context=context)
        publisher = self.node.create_publisher(SubmapMsg, "/auv_1/submap", SUBMAPS)
        values = np.zeros((20, 20), np.int8)
        values[:, 0] = 100
        submap = Submap(
            vehicle_id="auv_1",
            sequence=sequence,
            revision=0,
            is_final=True,
            stamp_ns=1,
            T_odom_submap=SE2(),
            covariance=np.eye(3) * 1e-4,
            grid=OccupancyMap(GridSpec(0.1, 20, 20), values),
            trajectory_stamp_ns=np.array([1], np.int64),
            trajectory=np.zeros((1, 3)),
            run_id=1,
        )
        publisher.publish(submap_to_msg(submap))


@pytest.fixture
def secured(joined, keystore):
    """``secured(enclave)``: as `joined`, with keys of our policy; skips without the tools."""
    try:
        rclpy.create_node("registration_server", context=joined(SERVER, keystore)).destroy_node()
    except Exception as error:
        if NOT_BUILT in str(error):
            pytest.skip(f"needs a middleware that is built with security: {error}")
        raise
    return lambda enclave: joined(enclave, keystore)


def sequences_heard(manager_context, senders, awaited):
    """What a manager takes, some time after it has taken what is awaited."""
    manager = MapQueueManager(
        context=manager_context, parameter_overrides=[Parameter("vehicles", value=["auv_1"])]
    )
    executors = []
    for node in (manager, *(sender.node for sender in senders)):
        executors.append(SingleThreadedExecutor(context=node.context))
        executors[-1].add_node(node)

    def heard():
        for executor in executors:
            executor.spin_once(timeout_sec=0.02)
        held = manager._worker.call(manager._queue.submaps).result(PATIENCE_S)
        return {record.submap.sequence for record in held}

    end_s = time.monotonic() + PATIENCE_S
    while awaited not in heard():
        assert time.monotonic() < end_s
    end_s = time.monotonic() + LISTEN_S
    while time.monotonic() < end_s:
        found = heard()
    manager.destroy_node()
    for sender in senders:
        sender.node.destroy_node()
    return found


def test_without_security_anybody_is_heard(joined):
    """What the next test would find if keys changed nothing."""
    senders = [Sender(joined(), 0), Sender(joined(), 1)]
    assert sequences_heard(joined(), senders, awaited=0) == {0, 1}


def test_a_stranger_without_keys_is_not_heard(secured):
    senders = [Sender(secured(MAPPER), 0), Sender(secured(None), 1)]
    assert sequences_heard(secured(MANAGER), senders, awaited=0) == {0}


def test_keys_of_another_node_are_not_enough(secured):
    context = secured(SERVER)
    with pytest.raises(Exception, match=r"(?i)publish|permission|security"):
        Sender(context, 1, SERVER)
