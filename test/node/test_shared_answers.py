"""Managers that only modems join: answers and decisions of one serve the others, byte for byte."""

import contextlib

import numpy as np
import pytest

pytest.importorskip("rclpy")

import rclpy
from nav_msgs.msg import OccupancyGrid
from places import room_submap
from rclpy.parameter import Parameter
from std_msgs.msg import UInt8MultiArray
from uw_dslam_msgs.msg import Decision, MergeStatus
from uw_dslam_msgs.msg import Submap as SubmapMsg
from uw_dslam_msgs.srv import Decide, ListDecisions, RegisterMaps

from uw_dslam_ros2.cli.running.link_watch import what_is_open
from uw_dslam_ros2.core.link.coding.answers import decode_answer
from uw_dslam_ros2.core.merging import MapQueue
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.sessions.session import save_session
from uw_dslam_ros2.ros.convert.core_types import submap_to_msg
from uw_dslam_ros2.ros.convert.registration import registration_to_msg
from uw_dslam_ros2.ros.nodes.acoustic_link import AcousticLinkNode
from uw_dslam_ros2.ros.nodes.channel import ChannelNode
from uw_dslam_ros2.ros.nodes.map_queue_manager import MapQueueManager
from uw_dslam_ros2.ros.plumbing.qos import ANSWERS, LATCHED, SUBMAPS
from uw_dslam_ros2.sim.maps.fleets import answer_all, make_result

pytestmark = pytest.mark.ros

T_ROOM = {"auv_1": SE2(2.0, 3.0, 0.0), "auv_2": SE2(5.0, 4.0, 2.0)}
VEHICLES = tuple(T_ROOM)


def make(node_type, context, namespace, **settings):
    parameters = [Parameter(name.replace("__", "."), value=v) for name, v in settings.items()]
    return node_type(context=context, namespace=namespace, parameter_overrides=parameters)


class Vehicle:
    """A link and a manager, and a server that knows the truth up to digits of its own."""

    def __init__(self, context, name, error_m):
        self.name, self.error_m, self.asked = name, error_m, []
        self.link = make(
            AcousticLinkNode, context, name, link__number=VEHICLES.index(name), time_scale=2.0
        )
        self.manager = make(
            MapQueueManager,
            context,
            name,
            vehicles=[f"{name}/link/{other}" for other in VEHICLES],
            servers=[f"{name}/server"],
            link=name,
            queue__anchor_vehicle="auv_1",
            queue__resolution_m=0.1,
            publish_period_s=0.1,
            full_map_period_s=0.1,
        )
        self.probe = rclpy.create_node("probe", context=context, namespace=name)
        self.output = self.probe.create_publisher(SubmapMsg, "submap", SUBMAPS)
        self.statuses, self.maps = [], []
        self.probe.create_subscription(MergeStatus, "merge_status", self.statuses.append, LATCHED)
        self.probe.create_subscription(OccupancyGrid, "map", self.maps.append, LATCHED)
        if error_m is not None:
            self.probe.create_service(RegisterMaps, "server/register_maps", self._answer)
        self.nodes = self.link, self.manager, self.probe

    def _answer(self, request, response):
        names = (request.source.header.frame_id[:5], request.target.header.frame_id[:5])
        self.asked.append(names)
        T_true = T_ROOM[names[1]].inverse() @ T_ROOM[names[0]]
        found = make_result(T_true @ SE2(self.error_m, 0.0, 0.0))
        response.result, response.registration = response.DONE, registration_to_msg(found)
        return response

    def call(self, until, service, name, **fields):
        """What the manager answers."""
        client = self.probe.create_client(service, f"map_queue_manager/{name}")
        until(client.service_is_ready, name)
        future = client.call_async(service.Request(**fields))
        until(future.done, name)
        return future.result()

    @property
    def status(self):
        return self.statuses[-1] if self.statuses else MergeStatus()

    def merged(self):
        return {s.vehicle_id for s in self.status.submaps if s.state == s.MERGED}

    def map_bytes(self):
        if not self.maps:
            return None
        info = self.maps[-1].info
        return repr((info.resolution, info.width, info.origin)), bytes(self.maps[-1].data)


def still_open(vehicles):
    """What the nodes themselves tell of what is missing."""
    told = [[v.link._report()[2] for v in vehicles], [v.manager._report()[2] for v in vehicles]]
    links, managers = (
        [{name: str(value) for name, value in values.items()} for values in nodes]
        for nodes in told
    )
    return what_is_open(VEHICLES, links, managers)


@pytest.fixture
def fleet(ros_context, spinning):
    """``with fleet((error_m, error_m)) as (until, vehicles)``; None: without a server."""

    @contextlib.contextmanager
    def run(errors_m):
        vehicles = [
            Vehicle(ros_context, name, error_m)
            for name, error_m in zip(VEHICLES, errors_m, strict=True)
        ]
        water = make(ChannelNode, ros_context, "", vehicles=list(VEHICLES), time_scale=2.0)
        nodes = [node for vehicle in vehicles for node in vehicle.nodes]
        with spinning(water, *nodes) as until:
            until(lambda: all(v.output.get_subscription_count() for v in vehicles), "links")
            for vehicle in vehicles:
                submap = room_submap(vehicle.name, T_room_submap=T_ROOM[vehicle.name])
                vehicle.output.publish(submap_to_msg(submap))
            yield until, vehicles

    return run


def test_a_vehicle_without_a_server_merges_by_the_others_answers(fleet):
    with fleet((0.0, None)) as (until, (first, second)):
        until(lambda: first.merged() == set(VEHICLES), "the vehicle that searches")
        until(lambda: second.merged() == set(VEHICLES), "the one that does not")
        assert first.asked
        assert second.status.num_servers == 0
        assert second.status.num_registrations > 0
        until(lambda: first.map_bytes() == second.map_bytes(), "the same map")


def test_vehicles_whose_last_digits_differ_end_with_the_same_bytes(fleet):
    with fleet((0.003, -0.003)) as (until, vehicles):
        until(lambda: all(v.merged() == set(VEHICLES) for v in vehicles), "both maps")

        def edges(vehicle):
            return [
                (c.t_target_source.x, c.t_target_source.y, c.t_target_source.yaw)
                for c in vehicle.status.constraints
                if c.kind == c.REGISTRATION
            ]

        first, second = vehicles
        until(lambda: edges(first) and edges(first) == edges(second), "the same answer")
        until(lambda: first.map_bytes() == second.map_bytes(), "the same map")
        until(lambda: not still_open(vehicles), "rest")


def test_answers_of_a_session_that_nobody_has_heard_are_told(ros_context, spinning, tmp_path):
    queue = MapQueue()
    for name, T in T_ROOM.items():
        queue.add_submap(room_submap(name, T_room_submap=T))
    found = make_result(T_ROOM["auv_1"].inverse() @ T_ROOM["auv_2"])
    answer_all(queue, lambda _: found)
    save_session(tmp_path / "session", queue)
    manager = make(
        MapQueueManager, ros_context, "auv_1", link="auv_1", session=str(tmp_path / "session")
    )
    probe, told = rclpy.create_node("probe", context=ros_context), []
    probe.create_subscription(UInt8MultiArray, "/auv_1/link/answers", told.append, ANSWERS)
    with spinning(manager, probe) as until:
        until(lambda: told, "the answer")
    (_, result), *others = [decode_answer(bytes(msg.data)) for msg in told]
    assert not others
    assert result.is_accepted
    assert result.T_target_source.distance_to(found.T_target_source)[0] < 0.001


def test_what_is_no_answer_is_told_and_harms_nothing(fleet):
    with fleet((None, None)) as (until, (first, _)):
        topic = "/auv_1/link/answers"
        heard = first.probe.create_publisher(UInt8MultiArray, f"{topic}_heard", ANSWERS)
        own = first.probe.create_publisher(UInt8MultiArray, topic, ANSWERS)
        until(lambda: heard.get_subscription_count() and own.get_subscription_count())
        for output in (heard, own):
            output.publish(UInt8MultiArray(data=np.full(9, 255, np.uint8).tobytes()))
        until(lambda: first.manager._report()[2].get("num_bad"), "the manager's complaint")
        until(lambda: "verdict of an answer" in first.link._report()[1], "the link's complaint")
        assert first.status.num_registrations == 0


def test_what_a_person_decides_at_one_vehicle_holds_at_all(fleet):
    with fleet((0.0, None)) as (until, (first, second)):
        until(lambda: second.merged() == set(VEHICLES), "both maps")
        decided = [
            Decision(kind=Decision.WITHDRAW, who="Ann", source_vehicle_id="auv_2"),
            Decision(kind=Decision.UNDO, who="Bob", undone=1),
        ]
        for vehicle, decision, merged in (
            (first, decided[0], {"auv_1"}),
            (second, decided[1], set(VEHICLES)),
        ):
            taken = vehicle.call(until, Decide, "decide", decision=decision)
            assert taken.result == Decide.Response.DONE, taken.message
            until(lambda: first.merged() == second.merged() == merged, "the same at both")  # noqa: B023
        logs = [v.call(until, ListDecisions, "list_decisions").decisions for v in (first, second)]
        assert [(d.who, d.kind, d.undone) for d in logs[0]] == [("Ann", 1, 0), ("Bob", 8, 1)]
        assert logs[0] == logs[1]
        until(lambda: first.map_bytes() == second.map_bytes(), "the same map")


def test_what_is_no_decision_is_told_and_harms_nothing(fleet):
    with fleet((None, None)) as (until, (first, _)):
        heard = first.probe.create_publisher(
            UInt8MultiArray, "/auv_1/link/decisions_heard", ANSWERS
        )
        until(heard.get_subscription_count)
        heard.publish(UInt8MultiArray(data=np.full(9, 255, np.uint8).tobytes()))
        until(lambda: first.manager._report()[2].get("num_bad"), "the manager's complaint")
        assert first.status.num_decisions == 0
