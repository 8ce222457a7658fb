"""Vehicles of other programs: the manager takes maps that grow, and nothing else of them."""

import contextlib
import math

import numpy as np
import pytest

pytest.importorskip("rclpy")

import rclpy
from nav_msgs.msg import OccupancyGrid
from places import room_submap
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from unit.mapping.test_vehicle_mapper import CONFIG, SONAR, scan
from uw_dslam_msgs.msg import MergeStatus
from uw_dslam_msgs.msg import Submap as SubmapMsg

from uw_dslam_ros2.core.errors import ConfigError
from uw_dslam_ros2.core.mapping import VehicleMapper
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.ros.convert.core_types import (
    occupancy_from_msg,
    occupancy_to_msg,
    submap_to_msg,
)
from uw_dslam_ros2.ros.manager.map_inputs import vehicle_of
from uw_dslam_ros2.ros.nodes.map_queue_manager import MapQueueManager
from uw_dslam_ros2.ros.nodes.registration_server import RegistrationServer
from uw_dslam_ros2.ros.plumbing.qos import LATCHED, SUBMAPS

pytestmark = pytest.mark.ros

S = 1_000_000_000
VOLATILE = QoSProfile(depth=10, durability=DurabilityPolicy.VOLATILE)
FAST = {"publish_period_s": 0.1, "full_map_period_s": 0.1}


def recorded(phase, heading_offset, seed):
    """Maps that our own mapper draws while it circles in a basin, and its frame in the world."""
    rng, bearings = np.random.default_rng(seed), np.linspace(-1.1, 1.1, 90)
    mapper, maps = VehicleMapper(CONFIG, "robot"), []
    for tenth in range(601):
        t, angle = tenth * S // 10, phase + 2.0 * math.pi * tenth / 600
        pose = SE2(19.5 + 6.5 * math.cos(angle), 15 + 6.5 * math.sin(angle), angle + math.pi / 2)
        if tenth == 0:
            T_world_odom = pose @ SE2(0.0, 0.0, pose.yaw + heading_offset).inverse()
        mapper.add_imu(t, pose.yaw + heading_offset + rng.normal(0, 0.01), None)
        mapper.add_velocity(t, (6.5 * 2.0 * math.pi / 60.0 + rng.normal(0, 0.02), 0.0))
        if tenth % 10 == 5:
            ranges = scan(pose @ SONAR, bearings)
            mapper.add_scan(t, bearings, ranges + rng.normal(0, 0.03, 90), 30.0, SONAR)
        if tenth % 100 == 99:
            maps.append((t, mapper.vehicle_map()))
    return maps, T_world_odom


@pytest.fixture(scope="module")
def recordings():
    return {"robot1": recorded(0.0, 0.0, 1), "robot2": recorded(2.0, 1.3, 2)}


class Probe:
    """Sends maps, and hears what the manager says."""

    def __init__(self, context):
        self.node = rclpy.create_node("probe", context=context)
        self.statuses, self.maps, self.transforms = [], [], {}
        self.node.create_subscription(MergeStatus, "/merge_status", self.statuses.append, LATCHED)
        self.node.create_subscription(OccupancyGrid, "/map", self.maps.append, LATCHED)
        self.node.create_subscription(TFMessage, "/tf", self._on_tf, 100)

    def _on_tf(self, msg):
        for transform in msg.transforms:
            self.transforms[transform.header.frame_id, transform.child_frame_id] = transform

    def vehicles(self):
        infos = self.statuses[-1].submaps if self.statuses else []
        return {info.vehicle_id for info in infos}

    def merged(self):
        infos = self.statuses[-1].submaps if self.statuses else []
        return {info.vehicle_id for info in infos if info.state == info.MERGED}

    def place(self, frame):
        transform = self.transforms["map", frame].transform
        yaw = 2.0 * math.atan2(transform.rotation.z, transform.rotation.w)
        return SE2(transform.translation.x, transform.translation.y, yaw)


@pytest.fixture
def manage(ros_context, spinning):
    """``with manage(settings) as (until, probe)``: a manager, a server, a probe."""

    @contextlib.contextmanager
    def run(**settings):
        parameters = [Parameter(k, value=v) for k, v in {**FAST, **settings}.items()]
        probe = Probe(ros_context)
        manager = MapQueueManager(context=ros_context, parameter_overrides=parameters)
        server = RegistrationServer(context=ros_context)
        with spinning(manager, server, probe.node) as until:
            yield until, probe

    return run


def send(publisher, occupancy, frame_id, stamp_ns=S):
    publisher.publish(occupancy_to_msg(occupancy, frame_id, stamp_ns))


@pytest.mark.parametrize("qos", [LATCHED, VOLATILE], ids=["latched", "volatile"])
def test_growing_maps_of_two_vehicles_become_one(manage, recordings, qos):
    topics = [f"/{name}/map" for name in recordings]
    with manage(map_topics=topics) as (until, probe):
        publishers = {
            name: probe.node.create_publisher(OccupancyGrid, f"/{name}/map", qos)
            for name in recordings
        }
        until(lambda: all(p.get_subscription_count() for p in publishers.values()), "the manager")
        for step in range(6):
            for name, (maps, _) in recordings.items():
                send(publishers[name], maps[step][1], f"{name}/map", maps[step][0])
            until(lambda: probe.vehicles() == set(recordings), "both maps")
        client = probe.node.create_client(Trigger, "/map_queue_manager/settle")
        until(client.service_is_ready, "the service")
        until(client.call_async(Trigger.Request()).done, "the answer")
        until(lambda: probe.merged() == set(recordings), "the merge", 60.0)
        until(lambda: ("map", "robot2/map") in probe.transforms, "TF")
        until(lambda: probe.statuses[-1].num_in_flight == 0, "the end")
        known = sum(maps[-1][1].known.sum() for maps, _ in recordings.values())
        until(lambda: occupancy_from_msg(probe.maps[-1]).known.sum() > 0.5 * known, "the map")
        T_robot1_robot2 = probe.place("robot1/map").inverse() @ probe.place("robot2/map")
    places = [T_world_odom for _, T_world_odom in recordings.values()]
    distance_m, angle_rad = T_robot1_robot2.distance_to(places[0].inverse() @ places[1])
    assert distance_m < 0.5
    assert angle_rad < 0.03


def test_maps_are_found_and_those_of_vehicles_with_submaps_are_left(manage, recordings):
    maps, _ = recordings["robot1"]
    with manage(is_discovering_maps=True) as (until, probe):
        own = probe.node.create_publisher(OccupancyGrid, "/auv_1/map", LATCHED)
        submaps = probe.node.create_publisher(SubmapMsg, "/auv_1/submap", SUBMAPS)
        other = probe.node.create_publisher(OccupancyGrid, "/robot1/map", LATCHED)
        costs = probe.node.create_publisher(OccupancyGrid, "/robot1/costmap", LATCHED)
        submaps.publish(submap_to_msg(room_submap("auv_1")))
        for publisher in (own, other, costs):
            send(publisher, maps[-1][1], "map")
        until(lambda: probe.vehicles() == {"auv_1", "robot1"}, "both vehicles")
        assert own.get_subscription_count() == 0
        assert costs.get_subscription_count() == 0


def test_frames_of_one_name_are_told_apart(manage, recordings):
    """In a namespace of its own every robot's map frame is called map."""
    maps, _ = recordings["robot1"]
    with manage(map_topics=["/robot1/map"]) as (until, probe):
        publisher = probe.node.create_publisher(OccupancyGrid, "/robot1/map", LATCHED)
        send(publisher, maps[-1][1], "map")
        until(lambda: ("map", "robot1/map") in probe.transforms, "TF")
        send(publisher, maps[-1][1], "warehouse")
        until(lambda: ("map", "warehouse") in probe.transforms, "TF by the map's own name")


def test_bad_maps_are_told_and_survived(manage, recordings):
    maps, _ = recordings["robot1"]
    with manage(map_topics=["/robot1/map"]) as (until, probe):
        publisher = probe.node.create_publisher(OccupancyGrid, "/robot1/map", LATCHED)
        until(publisher.get_subscription_count, "the manager")
        msg = occupancy_to_msg(maps[0][1], "map", S)
        msg.info.resolution = math.inf
        publisher.publish(msg)
        until(lambda: probe.statuses and "info.resolution" in probe.statuses[-1].message, "report")
        send(publisher, maps[0][1], "map")
        until(lambda: probe.vehicles() == {"robot1"}, "the map")


@pytest.mark.parametrize(
    ("topics", "match"),
    [
        (["/map"], "the map that is published here"),
        (["/robot1/map", "robot1/grid"], "both of vehicle 'robot1'"),
    ],
)
def test_topics_that_cannot_be_are_refused(ros_context, topics, match):
    with pytest.raises(ConfigError, match=match):
        MapQueueManager(
            context=ros_context, parameter_overrides=[Parameter("map_topics", value=topics)]
        )


def test_the_vehicle_is_what_stands_before_the_maps_name():
    assert vehicle_of("/robot1/map") == "robot1"
    assert vehicle_of("/fleet/robot1/map") == "fleet/robot1"
    assert vehicle_of("/grid") == "grid"
