"""The whole way with real processes: bags in, one map out, compared with the truth.

The client below is a plain rclpy node: what it finds is the contract of docs/interfaces.md.
"""

import os
import time
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("rclpy")

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.action import get_action_names_and_types
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from uw_dslam_msgs.msg import MergeStatus, Submap
from uw_dslam_msgs.srv import SaveMap, SaveSession

from uw_dslam_ros2.cli.running.processes import Children
from uw_dslam_ros2.core.metrics import compare_maps, trajectory_error
from uw_dslam_ros2.io.maps.files import read_map
from uw_dslam_ros2.io.trajectories import read_tum
from uw_dslam_ros2.sim.missions.mission import tiny_mission_config
from uw_dslam_ros2.sim.missions.recording import simulate_mission

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(900)]

VEHICLES = ("auv_1", "auv_2")
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
PATIENCE_S = 240.0

TYPES_OF_VEHICLE = {
    "map": "nav_msgs/msg/OccupancyGrid",
    "path": "nav_msgs/msg/Path",
    "odom": "nav_msgs/msg/Odometry",
    "submap": "uw_dslam_msgs/msg/Submap",
}
TYPES = {
    "/map": "nav_msgs/msg/OccupancyGrid",
    "/map_updates": "map_msgs/msg/OccupancyGridUpdate",
    "/merge_status": "uw_dslam_msgs/msg/MergeStatus",
    "/pose_graph": "visualization_msgs/msg/MarkerArray",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    **{f"/{v}/{topic}": kind for v in VEHICLES for topic, kind in TYPES_OF_VEHICLE.items()},
}
IS_LATCHED = ("/map", "/merge_status", "/pose_graph", "/auv_1/map", "/auv_1/path", "/auv_1/submap")
SERVICES = {
    "/registration_server/register_maps": "uw_dslam_msgs/srv/RegisterMaps",
    "/registration_server/register_point_sets": "uw_dslam_msgs/srv/RegisterPointSets",
    "/map_queue_manager/save_map": "uw_dslam_msgs/srv/SaveMap",
    "/map_queue_manager/list_submaps": "uw_dslam_msgs/srv/ListSubmaps",
    "/map_queue_manager/list_registrations": "uw_dslam_msgs/srv/ListRegistrations",
    "/map_queue_manager/get_submap": "uw_dslam_msgs/srv/GetSubmap",
    "/map_queue_manager/withdraw_submap": "uw_dslam_msgs/srv/WithdrawSubmap",
    "/map_queue_manager/decide": "uw_dslam_msgs/srv/Decide",
    "/map_queue_manager/list_decisions": "uw_dslam_msgs/srv/ListDecisions",
    "/map_queue_manager/restore_submap": "uw_dslam_msgs/srv/RestoreSubmap",
    "/map_queue_manager/save_session": "uw_dslam_msgs/srv/SaveSession",
    "/map_queue_manager/load_session": "uw_dslam_msgs/srv/LoadSession",
    "/map_queue_manager/settle": "std_srvs/srv/Trigger",
    "/auv_1/sonar_mapper/finish": "std_srvs/srv/Trigger",
}
ACTION = ("/registration_server/register_maps", "uw_dslam_msgs/action/RegisterMaps")


class Client:
    """Somebody else's program."""

    def __init__(self, domain_id, check):
        self._check = check
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain_id)
        self.node = rclpy.create_node("client", context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self.statuses, self.maps, self.frames = [], [], set()
        self.odometry, self.submaps, self.diagnosed = [], [], set()
        subscribe = self.node.create_subscription
        subscribe(MergeStatus, "/merge_status", self.statuses.append, LATCHED)
        subscribe(OccupancyGrid, "/map", self.maps.append, LATCHED)
        subscribe(Odometry, "/auv_1/odom", self.odometry.append, 10)
        subscribe(Submap, "/auv_1/submap", self.submaps.append, LATCHED)
        subscribe(TFMessage, "/tf", self._on_tf, 100)
        subscribe(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)

    def _on_tf(self, msg):
        self.frames |= {(t.header.frame_id, t.child_frame_id) for t in msg.transforms}

    def _on_diagnostics(self, msg):
        self.diagnosed |= {status.name.split(":")[0] for status in msg.status}

    def until(self, is_true, what):
        end_s = time.monotonic() + PATIENCE_S
        while not is_true():
            assert time.monotonic() < end_s, f"not within {PATIENCE_S} s: {what}"
            self._check()
            self._executor.spin_once(timeout_sec=0.1)

    def call(self, service_type, name, **fields):
        client = self.node.create_client(service_type, name)
        self.until(client.service_is_ready, name)
        future = client.call_async(service_type.Request(**fields))
        self.until(future.done, f"answer of {name}")
        return future.result()

    def close(self):
        self._executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture(scope="module")
def mission(tmp_path_factory):
    """Two vehicles that survey mostly the same water, with a small sonar: 140 pings each."""
    config = replace(tiny_mission_config(1), duration_s=70.0)
    return simulate_mission(tmp_path_factory.mktemp("mission"), config, num_processes=2)


@pytest.fixture
def graph(ros_domain_id, tmp_path, mission):
    """All nodes as processes, and a client: ``(client, start_player)``."""
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(ros_domain_id),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_PYTHON_CHECK_FIELDS": "1",
        "ROS_LOG_DIR": str(tmp_path / "ros_logs"),
    }
    nodes = "uw_dslam_ros2.ros.nodes."
    with Children(environment, tmp_path / "logs") as children:
        simulated = ["--ros-args", "-p", "use_sim_time:=true"]
        for vehicle in VEHICLES:
            arguments = [*simulated, "-r", f"__ns:=/{vehicle}", "-p", "is_reliable:=true"]
            children.start(vehicle, nodes + "sonar_mapper", arguments)
        children.start("server", nodes + "registration_server", simulated)
        children.start("manager", nodes + "map_queue_manager", simulated)
        client = Client(ros_domain_id, children.check)

        def play():
            arguments = [str(bag) for bag in mission.bags]
            arguments += ["--rate", "1000", "--max-lag-s", "10", "--wait-s", str(PATIENCE_S)]
            arguments += ["--wait-for", *(f"/{vehicle}/sonar" for vehicle in VEHICLES)]
            return children.start("player", nodes + "bag_player", arguments, may_end=True)

        yield client, play
        client.close()
    for child in children._children:
        assert child.poll() == 0, f"{child.name}: {child.tail()}"


def check_contract(client):
    found = dict(client.node.get_topic_names_and_types())
    client.until(
        lambda: set(TYPES) <= set(dict(client.node.get_topic_names_and_types())), "topics"
    )
    found = dict(client.node.get_topic_names_and_types())
    assert {topic: found[topic] for topic in TYPES} == {t: [kind] for t, kind in TYPES.items()}
    for topic in TYPES:
        publishers = client.node.get_publishers_info_by_topic(topic)
        assert publishers, topic
        for info in publishers:
            assert info.qos_profile.reliability == ReliabilityPolicy.RELIABLE, topic
            is_latched = info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
            assert is_latched == (topic.replace("auv_2", "auv_1") in IS_LATCHED), topic
    for sensor in ("sonar", "imu", "dvl", "depth"):
        assert client.node.get_subscriptions_info_by_topic(f"/auv_1/{sensor}"), sensor
    client.until(
        lambda: set(SERVICES) <= set(dict(client.node.get_service_names_and_types())), "services"
    )
    services = dict(client.node.get_service_names_and_types())
    assert {name: services.get(name) for name in SERVICES} == {
        name: [kind] for name, kind in SERVICES.items()
    }
    actions = dict(get_action_names_and_types(client.node))
    assert actions[ACTION[0]] == [ACTION[1]]


def test_bags_become_one_map_that_is_true(graph, mission, tmp_path):
    client, play = graph
    for vehicle in VEHICLES:
        name = f"/{vehicle}/sonar_mapper/finish"
        client.until(client.node.create_client(Trigger, name).service_is_ready, name)
    client.until(lambda: client.statuses and client.statuses[-1].num_servers == 1, "the server")
    check_contract(client)

    player = play()
    client.until(lambda: player.poll() is not None, "the end of the bags")
    for vehicle in VEHICLES:
        response = client.call(Trigger, f"/{vehicle}/sonar_mapper/finish")
        assert response.success, response.message
        assert response.message.startswith("140 pings mapped"), response.message
        assert response.message.endswith(" 0 bad messages")
    client.until(
        lambda: client.statuses[-1].num_waiting == 0 and client.statuses[-1].num_in_flight == 0,
        "all submaps merged",
    )
    assert client.statuses[-1].num_components == 1
    chain = {("map", f"{v}/map") for v in VEHICLES}
    chain |= {(f"{v}/map", f"{v}/odom") for v in VEHICLES}
    chain |= {(f"{v}/odom", f"{v}/base_link") for v in VEHICLES}
    client.until(lambda: chain <= client.frames, "the frames")
    assert client.odometry[-1].header.frame_id == "auv_1/odom"
    assert client.submaps[-1].header.frame_id.startswith("auv_1/submap_")
    client.until(lambda: client.maps, "the map")
    assert client.maps[-1].header.frame_id == "map"
    nodes = {*(f"{v}/sonar_mapper" for v in VEHICLES), "registration_server", "map_queue_manager"}
    client.until(lambda: nodes <= client.diagnosed, "diagnostics of every node")

    saved = client.call(SaveMap, "/map_queue_manager/save_map", path=str(tmp_path / "map"))
    assert saved.result == SaveMap.Response.DONE, saved.message
    session = str(tmp_path / "session")
    saved = client.call(SaveSession, "/map_queue_manager/save_session", path=session)
    assert saved.result == SaveSession.Response.DONE, saved.message
    check_against_truth(mission, tmp_path)


def check_against_truth(mission, tmp_path):
    """All vehicles in one frame, walls where walls are, to twice what was seen."""
    found, truth = {}, {}
    for vehicle, path in zip(mission.vehicle_ids, mission.truth_trajectories, strict=True):
        found[vehicle] = read_tum(tmp_path / "session" / "trajectories" / f"{vehicle}.tum")
        truth[vehicle] = read_tum(path)
    error = trajectory_error(found, truth)
    assert error.rmse_m < 0.2, error
    assert error.rmse_rad < np.deg2rad(1.0), error
    comparison = compare_maps(
        read_map(tmp_path / "map.yaml"),
        read_map(mission.truth_map),
        error.T_truth_map,
        tolerance_m=0.25,
    )
    assert comparison.wall_iou_tolerant > 0.5, comparison
