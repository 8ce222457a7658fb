"""The life cycle of the nodes, and which parameters may change in which of its states."""

import threading
import time

import pytest

pytest.importorskip("rclpy")

import rclpy
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from node.drives import Vehicle, drive, finish, mapper_of
from places import room_map, room_submap
from rcl_interfaces.srv import SetParameters
from rclpy.action import ActionClient
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from std_srvs.srv import SetBool, Trigger
from uw_dslam_msgs.action import RegisterMaps as RegisterMapsAction
from uw_dslam_msgs.msg import MergeStatus
from uw_dslam_msgs.msg import Submap as SubmapMsg
from uw_dslam_msgs.srv import RegisterMaps

from uw_dslam_ros2.core.errors import ConfigError, DataError
from uw_dslam_ros2.core.registration.result import RegistrationResult, Verdict
from uw_dslam_ros2.io.sessions.session import load_session
from uw_dslam_ros2.ros.convert.core_types import occupancy_to_msg, submap_to_msg
from uw_dslam_ros2.ros.nodes import registration_server
from uw_dslam_ros2.ros.nodes.map_queue_manager import MapQueueManager
from uw_dslam_ros2.ros.nodes.registration_server import RegistrationServer
from uw_dslam_ros2.ros.nodes.sonar_mapper import SonarMapper
from uw_dslam_ros2.ros.plumbing.qos import LATCHED, SUBMAPS

pytestmark = pytest.mark.ros

NODES = {
    "sonar_mapper": (SonarMapper, "path", "map_period_s", "mapper.submap.max_length_m"),
    "registration_server": (
        *(RegistrationServer, "/diagnostics"),
        *("registration.max_false_accept", "max_parallel"),
    ),
    "map_queue_manager": (MapQueueManager, "pose_graph", "publish_period_s", "queue.max_partners"),
}
UNCONFIGURED, INACTIVE, ACTIVE, FINALIZED = (
    *(State.PRIMARY_STATE_UNCONFIGURED, State.PRIMARY_STATE_INACTIVE),
    *(State.PRIMARY_STATE_ACTIVE, State.PRIMARY_STATE_FINALIZED),
)


def make(node_type, context, **settings):
    parameters = [Parameter(k.replace("__", "."), value=v) for k, v in settings.items()]
    return node_type(context=context, namespace="auv_1", parameter_overrides=parameters)


class Hand:
    """Somebody who changes states and parameters, as ``ros2 lifecycle`` and ``ros2 param`` do."""

    def __init__(self, context, name):
        self.node = rclpy.create_node("hand", context=context)
        self._name = f"/auv_1/{name}"

    def call(self, until, service_type, name, **fields):
        client = self.node.create_client(service_type, f"{self._name}/{name}")
        until(client.service_is_ready, name)
        future = client.call_async(service_type.Request(**fields))
        until(future.done, f"answer of {name}")
        return future.result()

    def change(self, until, transition):
        asked = Transition(id=transition)
        return self.call(until, ChangeState, "change_state", transition=asked).success

    def state(self, until):
        return self.call(until, GetState, "get_state").current_state.id

    def set(self, until, **values):
        parameters = [
            Parameter(k.replace("__", "."), value=v).to_parameter_msg() for k, v in values.items()
        ]
        return self.call(until, SetParameters, "set_parameters", parameters=parameters).results[0]


@pytest.mark.parametrize("name", NODES)
def test_a_node_goes_through_its_states_when_told(ros_context, spinning, name):
    node_type, topic, _, fixed = NODES[name]
    node, hand = make(node_type, ros_context, autostart=False), Hand(ros_context, name)
    topic = topic if topic.startswith("/") else f"/auv_1/{topic}"

    def is_published():
        return hand.node.count_publishers(topic) > 0

    with spinning(node, hand.node) as until:
        assert hand.state(until) == UNCONFIGURED
        assert not is_published()
        held = node.get_parameter(fixed).value
        value = held + type(held)(1)
        assert hand.set(until, **{fixed.replace(".", "__"): value}).successful
        for _ in range(2):
            assert hand.change(until, Transition.TRANSITION_CONFIGURE)
            assert hand.state(until) == INACTIVE
            until(is_published, topic)
            refused = hand.set(until, **{fixed.replace(".", "__"): value})
            assert not refused.successful
            assert f"{fixed} cannot change while {name} is configured: " in refused.reason
            assert hand.change(until, Transition.TRANSITION_ACTIVATE)
            assert hand.state(until) == ACTIVE
            assert hand.change(until, Transition.TRANSITION_DEACTIVATE)
            assert hand.state(until) == INACTIVE
            assert hand.change(until, Transition.TRANSITION_CLEANUP)
            assert hand.state(until) == UNCONFIGURED
            until(lambda: not is_published(), f"the end of {topic}")
        assert hand.change(until, Transition.TRANSITION_CONFIGURE)
        assert hand.change(until, Transition.TRANSITION_INACTIVE_SHUTDOWN)
        assert hand.state(until) == FINALIZED


@pytest.mark.parametrize("name", NODES)
def test_by_default_a_node_is_active_at_once_and_rates_and_thresholds_can_change(
    ros_context, spinning, name
):
    node_type, _, live, _ = NODES[name]
    node, hand = make(node_type, ros_context), Hand(ros_context, name)
    key = live.replace(".", "__")
    with spinning(node, hand.node) as until:
        assert hand.state(until) == ACTIVE
        assert hand.set(until, **{key: 0.5}).successful
        assert node.get_parameter(live).value == 0.5
        assert not hand.set(until, **{key: -1.0}).successful
        assert not hand.set(until, **{key: "fast"}).successful
        assert node.get_parameter(live).value == 0.5


def test_the_bar_of_a_running_server_can_be_set(ros_context, spinning):
    server, hand = make(RegistrationServer, ros_context), Hand(ros_context, "registration_server")
    room = occupancy_to_msg(room_map(), "somewhere", 0)
    with spinning(server, hand.node) as until:
        for most, verdict in ((0.25, "ACCEPTED"), (0.0, "IMPROBABLE")):
            assert hand.set(until, registration__max_false_accept=most).successful
            response = hand.call(until, RegisterMaps, "register_maps", source=room, target=room)
            found = response.registration
            assert found.verdict == getattr(type(found), verdict), found.reason


def test_a_server_that_is_not_active_says_that_it_is_busy(ros_context, spinning):
    server, hand = make(RegistrationServer, ros_context), Hand(ros_context, "registration_server")
    room = occupancy_to_msg(room_map(), "somewhere", 0)
    with spinning(server, hand.node) as until:
        assert hand.change(until, Transition.TRANSITION_DEACTIVATE)
        response = hand.call(until, RegisterMaps, "register_maps", source=room, target=room)
        assert (response.result, response.message) == (response.BUSY, "the server is not active")
        assert hand.change(until, Transition.TRANSITION_ACTIVATE)
        response = hand.call(until, RegisterMaps, "register_maps", source=room, target=room)
        assert response.result == response.DONE


def test_who_waits_for_a_server_that_is_cleaned_up_gets_an_answer(
    ros_context, spinning, monkeypatch
):
    begun = threading.Event()

    def endless(*_, progress, is_cancelled, **__):  # noqa: ARG001
        begun.set()
        while not is_cancelled():
            time.sleep(0.01)
        return RegistrationResult.refused(Verdict.BUDGET_EXHAUSTED, "cancelled")

    monkeypatch.setattr(registration_server, "register_grids", endless)
    server, hand = make(RegistrationServer, ros_context), Hand(ros_context, "registration_server")
    room = occupancy_to_msg(room_map(), "somewhere", 0)
    name = "/auv_1/registration_server/register_maps"
    asking = hand.node.create_client(RegisterMaps, name)
    acting = ActionClient(hand.node, RegisterMapsAction, name)
    with spinning(server, hand.node) as until:
        until(asking.service_is_ready, "the service")
        until(acting.server_is_ready, "the action")
        answer = asking.call_async(RegisterMaps.Request(source=room, target=room))
        until(begun.is_set, "the search")
        goal = acting.send_goal_async(RegisterMapsAction.Goal(source=room, target=room))
        until(goal.done, "the goal")
        result = goal.result().get_result_async()
        assert hand.change(until, Transition.TRANSITION_DEACTIVATE)
        assert hand.change(until, Transition.TRANSITION_CLEANUP)
        until(answer.done, "the answer")
        assert answer.result().registration.reason == "cancelled"
        until(result.done, "the action's result")
        assert hand.change(until, Transition.TRANSITION_CONFIGURE)
        assert hand.change(until, Transition.TRANSITION_ACTIVATE)
        begun.clear()
        goal = acting.send_goal_async(RegisterMapsAction.Goal(source=room, target=room))
        until(goal.done, "a goal again")
        assert goal.result().accepted
        until(begun.is_set, "its search")
    acting.destroy()


def test_a_manager_that_rests_takes_nothing_and_then_gets_what_it_missed(
    ros_context, spinning, tmp_path
):
    session = str(tmp_path / "session")
    manager = make(MapQueueManager, ros_context, session=session)
    hand, statuses = Hand(ros_context, "map_queue_manager"), []
    hand.node.create_subscription(MergeStatus, "/auv_1/merge_status", statuses.append, LATCHED)
    publisher = hand.node.create_publisher(SubmapMsg, "/auv_7/submap", SUBMAPS)

    def num_submaps():
        return len(statuses[-1].submaps) if statuses else 0

    with spinning(manager, hand.node) as until:
        publisher.publish(submap_to_msg(room_submap("auv_7")))
        until(lambda: num_submaps() == 1, "the first submap")
        assert hand.change(until, Transition.TRANSITION_DEACTIVATE)
        until(lambda: publisher.get_subscription_count() == 0, "that nobody listens")
        publisher.publish(submap_to_msg(room_submap("auv_7", sequence=1)))
        statuses.clear()
        assert hand.change(until, Transition.TRANSITION_ACTIVATE)
        until(lambda: num_submaps() == 2, "the second submap")
        assert hand.change(until, Transition.TRANSITION_DEACTIVATE)
        assert hand.change(until, Transition.TRANSITION_CLEANUP)
        assert len(load_session(session).submaps()) == 2
        statuses.clear()
        assert hand.change(until, Transition.TRANSITION_CONFIGURE)
        assert hand.change(until, Transition.TRANSITION_ACTIVATE)
        until(lambda: num_submaps() == 2, "the session")


def test_what_cannot_be_configured_stays_unconfigured_and_can_be_mended(
    ros_context, spinning, tmp_path
):
    damaged = tmp_path / "session"
    damaged.mkdir()
    (damaged / "session.sqlite").write_bytes(b"nonsense" * 100)
    with pytest.raises(DataError, match="is not a whole session"):
        make(MapQueueManager, ros_context, session=str(damaged))
    manager = make(MapQueueManager, ros_context, session=str(damaged), autostart=False)
    hand = Hand(ros_context, "map_queue_manager")
    with spinning(manager, hand.node) as until:
        assert not hand.change(until, Transition.TRANSITION_CONFIGURE)
        assert hand.state(until) == UNCONFIGURED
        assert hand.set(until, session=str(tmp_path / "other")).successful
        assert hand.change(until, Transition.TRANSITION_CONFIGURE)


def test_a_mapper_maps_anew_after_a_clean_up(ros_context, spinning):
    vehicle, mapper = Vehicle(ros_context), mapper_of(ros_context)
    hand = Hand(ros_context, "sonar_mapper")
    with spinning(mapper, vehicle.node, hand.node) as until:
        until(vehicle.is_connected, "connection")
        vehicle.send_mount()
        drive(until, vehicle, range(3))
        until(lambda: vehicle.values().get("num_scan") == "6", "all scans")
        until(lambda: vehicle.values().get("num_frames") == "1", "the mount")
        assert hand.change(until, Transition.TRANSITION_DEACTIVATE)
        until(lambda: vehicle.scan_pub.get_subscription_count() == 0, "that nobody listens")
        assert hand.change(until, Transition.TRANSITION_CLEANUP)
        until(lambda: vehicle.submaps, "the open submap, given away at the end")
        vehicle.diagnostics.clear()
        assert hand.change(until, Transition.TRANSITION_CONFIGURE)
        assert hand.change(until, Transition.TRANSITION_ACTIVATE)
        until(vehicle.is_connected, "connection")
        drive(until, vehicle, range(3, 7))
        until(lambda: vehicle.values().get("num_scan") == "8", "all scans")
        assert "8 pings mapped into 1 submaps" in finish(until, vehicle).message
        until(lambda: len(vehicle.submaps) == 3, "the submap, and drawn anew")
        assert len({msg.run_id for msg in vehicle.submaps}) == 2


def test_pings_are_left_out_while_a_mapper_pauses_and_the_run_goes_on(ros_context, spinning):
    vehicle, mapper = Vehicle(ros_context), mapper_of(ros_context)
    hand = Hand(ros_context, "sonar_mapper")
    with spinning(mapper, vehicle.node, hand.node) as until:
        until(vehicle.is_connected, "connection")
        vehicle.send_mount()
        for seconds, is_paused in ((range(2), True), (range(2, 4), False)):
            drive(until, vehicle, seconds)
            num_scans = str(2 * seconds.stop)
            until(lambda n=num_scans: vehicle.values().get("num_scan") == n, "scans")
            assert hand.call(until, SetBool, "pause", data=is_paused).success
        drive(until, vehicle, range(4, 6))
        until(lambda: vehicle.values().get("num_scan") == "12", "all scans")
        assert "8 pings mapped into 1 submaps" in finish(until, vehicle).message
        until(lambda: vehicle.values().get("num_pings_paused") == "4", "those left out")
        until(lambda: vehicle.odometry[-1].pose.pose.position.x > 2.5, "the whole way")


def test_a_mapper_that_is_reset_begins_a_new_run(ros_context, spinning):
    vehicle, mapper = Vehicle(ros_context), mapper_of(ros_context)
    hand = Hand(ros_context, "sonar_mapper")
    with spinning(mapper, vehicle.node, hand.node) as until:
        until(vehicle.is_connected, "connection")
        vehicle.send_mount()
        drive(until, vehicle, range(4))
        until(lambda: vehicle.values().get("num_scan") == "8", "scans")
        until(lambda: vehicle.values().get("num_frames") == "1", "the mount")
        answer = hand.call(until, Trigger, "reset")
        assert answer.success
        assert "a new run begins" in answer.message
        until(lambda: len(vehicle.submaps) == 1, "what was mapped before")
        drive(until, vehicle, range(4, 8))
        until(lambda: vehicle.values().get("num_scan") == "16", "all scans")
        finish(until, vehicle)
        until(lambda: len(vehicle.submaps) == 4, "the new run's submap, and both drawn anew")
        assert len({msg.run_id for msg in vehicle.submaps}) == 2
        assert [msg.sequence for msg in vehicle.submaps] == [0, 0, 0, 0]
        until(lambda: vehicle.odometry[-1].pose.pose.position.x > 3.5, "odometry that goes on")


def test_quality_of_service_is_as_overridden(ros_context):
    given = {
        "qos_overrides./auv_1/map.publisher.reliability": "best_effort",
        "qos_overrides./auv_1/submap.publisher.depth": 7,
        "qos_overrides./auv_1/imu.subscription.reliability": "reliable",
    }
    parameters = [Parameter(name, value=value) for name, value in given.items()]
    mapper = SonarMapper(context=ros_context, namespace="auv_1", parameter_overrides=parameters)
    second = SonarMapper(context=ros_context, namespace="auv_2")
    profiles = {p.topic_name: p.qos_profile for p in (*mapper.publishers, *second.publishers)} | {
        s.topic_name: s.qos_profile for s in mapper.subscriptions
    }
    assert profiles["/auv_1/map"].reliability == ReliabilityPolicy.BEST_EFFORT
    assert profiles["/auv_1/map"].durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert profiles["/auv_1/path"].reliability == ReliabilityPolicy.RELIABLE
    assert profiles["/auv_2/map"].reliability == ReliabilityPolicy.RELIABLE
    assert (profiles["/auv_1/submap"].depth, profiles["/auv_2/submap"].depth) == (7, 100)
    assert profiles["/auv_1/imu"].reliability == ReliabilityPolicy.RELIABLE
    assert profiles["/auv_1/dvl"].reliability == ReliabilityPolicy.BEST_EFFORT
    mapper.destroy_node()
    second.destroy_node()


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("/auv_1/mpa.publisher.depth", 5, "would change nothing: sonar_mapper publishes"),
        ("/auv_1/map.publisher.dpeth", 5, "is unknown, expected qos_overrides.<topic>"),
        ("map.publisher.depth", 5, "with the topic's whole name"),
        ("/auv_1/map.publisher.depth", "deep", "qos_overrides of map"),
        ("/auv_1/map.publisher.reliability", "perhaps", "Unexpected QoS override"),
    ],
)
def test_an_override_that_cannot_be_used_is_refused(ros_context, name, value, words):
    override = Parameter(f"qos_overrides.{name}", value=value)
    with pytest.raises(ConfigError, match=words):
        SonarMapper(context=ros_context, namespace="auv_1", parameter_overrides=[override])
