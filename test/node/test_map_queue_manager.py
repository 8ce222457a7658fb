"""The manager with real registration servers: merging, services, TF, failures."""

import contextlib
import dataclasses
import time
from collections import defaultdict

import numpy as np
import pytest

pytest.importorskip("rclpy")

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from map_msgs.msg import OccupancyGridUpdate
from nav_msgs.msg import OccupancyGrid
from places import room_submap
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from uw_dslam_msgs.msg import MergeStatus, SubmapInfo
from uw_dslam_msgs.msg import Submap as SubmapMsg
from uw_dslam_msgs.srv import (
    GetSubmap,
    ListSubmaps,
    LoadSession,
    RegisterMaps,
    RestoreSubmap,
    SaveMap,
    SaveSession,
    WithdrawSubmap,
)
from visualization_msgs.msg import MarkerArray

from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.maps.files import read_map
from uw_dslam_ros2.io.maps.provenance import read_provenance
from uw_dslam_ros2.io.sessions.session import SessionInUseError, has_session, load_session
from uw_dslam_ros2.ros.convert.core_types import (
    occupancy_from_msg,
    submap_from_msg,
    submap_to_msg,
)
from uw_dslam_ros2.ros.manager import missing_submaps
from uw_dslam_ros2.ros.nodes.map_queue_manager import MapQueueManager
from uw_dslam_ros2.ros.nodes.registration_server import RegistrationServer
from uw_dslam_ros2.ros.plumbing.qos import LATCHED, SUBMAPS

pytestmark = pytest.mark.ros

T_ROOM = {"auv_1": SE2(2.0, 3.0, 0.0), "auv_2": SE2(5.0, 4.0, 2.0)}
FAST = {"publish_period_s": 0.1, "full_map_period_s": 0.1}


class Probe:
    """A plain node that sends submaps and hears all that the manager says."""

    def __init__(self, context):
        self.node = rclpy.create_node("probe", context=context)
        self.statuses, self.maps, self.updates, self.markers = [], [], [], []
        self.transforms = {}
        node = self.node
        node.create_subscription(MergeStatus, "/merge_status", self.statuses.append, LATCHED)
        node.create_subscription(OccupancyGrid, "/map", self.maps.append, LATCHED)
        node.create_subscription(OccupancyGridUpdate, "/map_updates", self.updates.append, 10)
        node.create_subscription(MarkerArray, "/pose_graph", self.markers.append, LATCHED)
        node.create_subscription(TFMessage, "/tf", self._on_tf, 100)
        self._publishers = {}

    def _on_tf(self, msg):
        for transform in msg.transforms:
            self.transforms[transform.header.frame_id, transform.child_frame_id] = transform

    def send(self, submap, **options):
        topic = f"/{submap.vehicle_id}/submap"
        if topic not in self._publishers:
            self._publishers[topic] = self.node.create_publisher(SubmapMsg, topic, SUBMAPS)
        self._publishers[topic].publish(submap_to_msg(submap, **options))

    @property
    def num_merged(self):
        return self.statuses[-1].num_merged if self.statuses else 0

    def states(self):
        infos = self.statuses[-1].submaps if self.statuses else []
        return {(info.vehicle_id, info.sequence): info.state for info in infos}


@pytest.fixture
def manage(ros_context, spinning):
    """``with manage(settings) as (until, probe, call)``: a manager, a server, a probe."""

    @contextlib.contextmanager
    def run(*others, has_server=True, **settings):
        parameters = [Parameter(k.replace("__", "."), value=v) for k, v in settings.items()]
        probe = Probe(ros_context)
        manager = MapQueueManager(context=ros_context, parameter_overrides=parameters)
        nodes = [manager, probe.node, *others]
        if has_server:
            nodes.append(RegistrationServer(context=ros_context))

        with spinning(*nodes) as until:

            def call(service_type, name, **fields):
                client = probe.node.create_client(service_type, f"/map_queue_manager/{name}")
                until(client.service_is_ready, name)
                future = client.call_async(service_type.Request(**fields))
                until(future.done, f"answer of {name}")
                return future.result()

            yield until, probe, call

    return run


def two_submaps():
    return [room_submap(name, T_room_submap=T_ROOM[name]) for name in ("auv_1", "auv_2")]


def test_two_vehicles_become_one_map(manage):
    first, second = two_submaps()
    with manage(**FAST) as (until, probe, _):
        probe.send(first)
        until(lambda: probe.num_merged == 1, "the first submap")
        until(lambda: ("map", "auv_1/map") in probe.transforms, "TF of the first")
        assert ("map", "auv_2/map") not in probe.transforms
        probe.send(second)
        until(lambda: probe.num_merged == 2, "the merge")
        until(lambda: ("map", "auv_2/map") in probe.transforms, "TF of the second")
        until(lambda: probe.maps and probe.markers, "map and graph")
        status = probe.statuses[-1]
        transform = probe.transforms["map", "auv_2/map"].transform
        until(
            lambda: (occupancy_from_msg(probe.maps[-1]).values > 50).sum() > 300,
            "walls in the map",
        )
        occupancy = occupancy_from_msg(probe.maps[-1])
    assert status.num_components == 1
    assert status.num_servers == 1
    edges = [c for c in status.constraints if c.kind == c.REGISTRATION]
    assert len(edges) == 1
    assert edges[0].is_inlier
    # The global frame is that of the first submap: auv_2's odom is where it is seen from there.
    expected = T_ROOM["auv_1"].inverse() @ T_ROOM["auv_2"]
    assert transform.translation.x == pytest.approx(expected.x, abs=0.1)
    assert transform.translation.y == pytest.approx(expected.y, abs=0.1)
    assert probe.maps[-1].header.frame_id == "map"
    # A wall seen by both is where the first one saw it.
    wall = first.grid.spec.centers_of(np.argwhere(first.grid.values == 100))
    cells = occupancy.spec.cells_of(wall)
    assert (occupancy.values[cells[:, 0], cells[:, 1]] > 50).mean() > 0.9


def test_vehicles_that_are_not_joined_have_a_group_and_a_frame_of_their_own(manage):
    with manage(has_server=False, **FAST) as (until, probe, _):
        for submap in two_submaps():
            probe.send(submap)
        until(lambda: ("map_auv_2", "auv_2/map") in probe.transforms, "the frame of the other")
        until(lambda: len(probe.statuses[-1].groups) == 2, "the groups")
        groups = probe.statuses[-1].groups
        assert [(g.component, g.frame_id, list(g.vehicle_ids)) for g in groups] == [
            (0, "map", ["auv_1"]),
            (1, "map_auv_2", ["auv_2"]),
        ]
        probe.send(room_submap("auv_0"))  # whose name comes first, while nobody is joined
        until(lambda: ("map", "auv_0/map") in probe.transforms, "the frame that has moved")
        until(lambda: ("map_auv_1", "auv_1/map") in probe.transforms, "the other's new parent")


def test_each_group_that_is_not_joined_has_a_map_of_its_own(manage):
    with manage(has_server=False, **FAST) as (until, probe, call):
        maps = []
        probe.node.create_subscription(OccupancyGrid, "/map_auv_2", maps.append, LATCHED)
        for submap in two_submaps():
            probe.send(submap)
        until(lambda: maps and probe.maps, "both maps")
        own = two_submaps()[1].grid
        assert maps[-1].header.frame_id == "map_auv_2"
        assert (occupancy_from_msg(maps[-1]).values > 50).sum() == (own.values > 50).sum()
        assert (occupancy_from_msg(probe.maps[-1]).values > 50).sum() == (own.values > 50).sum()
        call(WithdrawSubmap, "withdraw_submap", vehicle_id="auv_2", sequence=0)
        until(lambda: maps[-1].info.width == 0, "the end of the map")
        call(RestoreSubmap, "restore_submap", vehicle_id="auv_2", sequence=0)
        until(lambda: maps[-1].info.width > 0, "the map again")


def test_a_name_belongs_to_the_topic_that_had_it_first(manage):
    first, second = two_submaps()
    with manage(has_server=False, **FAST) as (until, probe, _):
        probe.send(first)
        until(lambda: probe.num_merged == 1, "the submap")
        thief = probe.node.create_publisher(SubmapMsg, "/thief/submap", SUBMAPS)
        stolen = dataclasses.replace(second, vehicle_id="auv_1", run_id=7)
        thief.publish(submap_to_msg(stolen))
        until(lambda: "auv_1 is heard on /auv_1/submap" in probe.statuses[-1].message, "refusal")
        assert len(probe.states()) == 1


def test_transforms_can_be_left_to_others(manage):
    with manage(has_server=False, publishes_tf=False, **FAST) as (until, probe, _):
        probe.send(room_submap("auv_1"))
        until(lambda: probe.num_merged == 1, "the submap")
        until(lambda: probe.maps, "the map")
        assert probe.transforms == {}


def test_submaps_wait_for_a_server_that_starts_late(manage, ros_context):
    with manage(has_server=False, **FAST) as (until, probe, _):
        for submap in two_submaps():
            probe.send(submap)
        until(lambda: len(probe.states()) == 2, "both submaps")
        assert probe.statuses[-1].num_servers == 0
        assert probe.num_merged == 1
        server = RegistrationServer(context=ros_context)
        executor = rclpy.executors.SingleThreadedExecutor(context=ros_context)
        executor.add_node(server)

        def both_spin():
            executor.spin_once(timeout_sec=0.01)
            return probe.num_merged == 2

        until(both_spin, "the merge")
        server.destroy_node()


def test_busy_server_is_asked_again(manage):
    asked = []

    def refuse(request, response):
        asked.append(request)
        response.result = RegisterMaps.Response.BUSY
        return response

    with manage(has_server=False, **FAST) as (until, probe, _):
        probe.node.create_service(RegisterMaps, "/busy/register_maps", refuse)
        for submap in two_submaps():
            probe.send(submap)
        until(lambda: len(asked) >= 2, "the second try")
        assert probe.num_merged == 1


@pytest.mark.parametrize("is_lost_by", ["death", "silence"])
def test_lost_request_is_asked_again_of_another_server(manage, ros_context, is_lost_by):
    """The first server takes the question and never answers; it dies, or it stays silent."""
    timeout_s = 8.0 if is_lost_by == "silence" else 1000.0
    silent = rclpy.create_node("silent", context=ros_context)  # nobody spins it
    silent.create_service(RegisterMaps, "~/register_maps", lambda _, response: response)
    with manage(has_server=False, request_timeout_s=timeout_s, **FAST) as (until, probe, _):
        for submap in two_submaps():
            probe.send(submap)
        until(lambda: probe.statuses and probe.statuses[-1].num_in_flight == 1, "the question")
        server = RegistrationServer(context=ros_context)
        executor = rclpy.executors.SingleThreadedExecutor(context=ros_context)
        executor.add_node(server)
        if is_lost_by == "death":
            silent.destroy_node()

        def both_spin():
            executor.spin_once(timeout_sec=0.01)
            return probe.num_merged == 2

        until(both_spin, "the merge")
        server.destroy_node()
    silent.destroy_node()


def test_same_submap_again_changes_nothing(manage):
    with manage(has_server=False, **FAST) as (until, probe, call):
        first, _ = two_submaps()
        probe.send(first)
        until(lambda: probe.num_merged == 1, "the submap")
        before = call(ListSubmaps, "list_submaps").submaps
        probe.send(first)
        probe.send(room_submap("auv_3"))  # the queue has seen the repeat when it has seen this
        until(lambda: ("auv_3", 0) in probe.states(), "the next submap")
        assert call(ListSubmaps, "list_submaps", vehicle_id="auv_1").submaps == before


def test_a_message_that_only_moves_a_submap_keeps_its_grid(manage):
    first, _ = two_submaps()
    moved = dataclasses.replace(first, revision=1, T_odom_submap=SE2(3.0, 1.0, 0.5))
    with manage(has_server=False, **FAST) as (until, probe, call):
        probe.send(first)
        until(lambda: probe.num_merged == 1, "the submap")
        assert len(submap_to_msg(moved, is_pose_only=True).grid.data) == 0
        probe.send(moved, is_pose_only=True)
        until(lambda: probe.statuses[-1].submaps[0].revision == 1, "the move")
        got = call(GetSubmap, "get_submap", vehicle_id="auv_1", sequence=0).submap
    submap = submap_from_msg(got)
    assert max(submap.T_odom_submap.distance_to(moved.T_odom_submap)) < 1e-9
    np.testing.assert_array_equal(submap.grid.values, first.grid.values)
    assert len(submap.trajectory) == len(first.trajectory)


def test_who_lacks_a_submap_that_moved_asks_for_it(manage, ros_context):
    first, _ = two_submaps()
    moved = dataclasses.replace(first, revision=1)
    mapper = rclpy.create_node("sonar_mapper", context=ros_context, namespace="auv_1")
    publisher = mapper.create_publisher(SubmapMsg, "submap", SUBMAPS)

    def give(_, response):
        response.result, response.submap = response.DONE, submap_to_msg(moved)
        return response

    mapper.create_service(GetSubmap, "~/get_submap", give)
    with manage(mapper, has_server=False, **FAST) as (until, probe, _):
        publisher.publish(submap_to_msg(moved, is_pose_only=True))
        until(lambda: probe.num_merged == 1, "the submap that was asked for")


def test_bad_submap_is_refused_and_the_manager_lives(manage):
    with manage(has_server=False, **FAST) as (until, probe, _):
        bad = submap_to_msg(room_submap("auv_1"))
        bad.grid.info.resolution = -1.0
        publisher = probe.node.create_publisher(SubmapMsg, "/auv_1/submap", SUBMAPS)
        publisher.publish(bad)
        until(
            lambda: (
                probe.statuses and "grid.info.resolution is -1.0" in probe.statuses[-1].message
            ),
            "a complaint",
        )
        publisher.publish(submap_to_msg(room_submap("auv_1")))
        until(lambda: probe.num_merged == 1, "the good one")


def test_withdrawn_submap_stays_out_until_restored(manage):
    first, second = two_submaps()
    with manage(**FAST) as (until, probe, call):
        probe.send(first)
        probe.send(second)
        until(lambda: probe.num_merged == 2, "the merge")
        key = {"vehicle_id": "auv_2", "sequence": 0}
        response = call(WithdrawSubmap, "withdraw_submap", **key)
        assert response.result == WithdrawSubmap.Response.DONE
        until(lambda: probe.states()["auv_2", 0] == SubmapInfo.WITHDRAWN, "the withdrawal")
        probe.send(room_submap("auv_2", revision=1, T_room_submap=T_ROOM["auv_2"]))
        probe.send(room_submap("auv_3"))
        until(lambda: ("auv_3", 0) in probe.states(), "what was sent after it")
        assert probe.states()["auv_2", 0] == SubmapInfo.WITHDRAWN
        assert call(RestoreSubmap, "restore_submap", **key).result == RestoreSubmap.Response.DONE
        until(lambda: probe.states()["auv_2", 0] == SubmapInfo.MERGED, "the return")
        missing = call(WithdrawSubmap, "withdraw_submap", vehicle_id="auv_9", sequence=4)
        assert missing.result == WithdrawSubmap.Response.NOT_FOUND
        assert "auv_9/4" in missing.message


def test_services_list_and_give_submaps(manage):
    with manage(has_server=False, **FAST) as (until, probe, call):
        for sequence in (1, 0):
            probe.send(room_submap("auv_1", sequence, T_odom_submap=SE2(sequence * 1.0, 0.0, 0.0)))
        until(lambda: len(probe.states()) == 2, "both submaps")
        listed = call(ListSubmaps, "list_submaps").submaps
        assert [(info.vehicle_id, info.sequence) for info in listed] == [
            ("auv_1", 0),
            ("auv_1", 1),
        ]
        assert call(ListSubmaps, "list_submaps", vehicle_id="auv_7").submaps == []
        got = call(GetSubmap, "get_submap", vehicle_id="auv_1", sequence=1)
        assert got.result == GetSubmap.Response.DONE
        assert got.submap.pose.pose.position.x == 1.0
        assert got.info.sequence == 1
        none = call(GetSubmap, "get_submap", vehicle_id="auv_1", sequence=7)
        assert none.result == GetSubmap.Response.NOT_FOUND


def test_map_is_saved_as_map_server_files(manage, tmp_path):
    with manage(has_server=False, **FAST) as (until, probe, call):
        empty = call(SaveMap, "save_map", path=str(tmp_path / "map"))
        assert empty.result == SaveMap.Response.NOTHING_TO_SAVE
        submap = room_submap("auv_1")
        probe.send(submap)
        until(lambda: probe.num_merged == 1, "the submap")
        saved = call(SaveMap, "save_map", path=str(tmp_path / "new" / "map"))
        assert saved.result == SaveMap.Response.DONE, saved.message
        assert str(tmp_path / "new" / "map.yaml") in saved.files
        failed = call(SaveMap, "save_map", path="/proc/nowhere/map")
        assert failed.result == SaveMap.Response.FAILED
        assert "/proc/nowhere" in failed.message
    again = read_map(tmp_path / "new" / "map.yaml")
    assert (again.values == 100).sum() == (submap.grid.values == 100).sum()


def test_session_is_saved_and_loaded(manage, tmp_path):
    folder = str(tmp_path / "session")
    with manage(**FAST) as (until, probe, call):
        for submap in two_submaps():
            probe.send(submap)
        until(lambda: probe.num_merged == 2, "the merge")
        saved = call(SaveSession, "save_session", path=folder)
        assert saved.result == SaveSession.Response.DONE, saved.message
        assert any(name.endswith("graph.g2o") for name in saved.files)
    # Without any server: what was accepted before is not asked again.
    with manage(has_server=False, **FAST) as (until, probe, call):
        missing = call(LoadSession, "load_session", path=str(tmp_path / "none"))
        assert missing.result == LoadSession.Response.NOT_FOUND
        loaded = call(LoadSession, "load_session", path=folder)
        assert (loaded.result, loaded.num_submaps) == (LoadSession.Response.DONE, 2)
        until(lambda: probe.num_merged == 2, "the loaded session")


def test_session_parameter_resumes_by_itself(manage, tmp_path):
    folder = str(tmp_path / "session")
    with manage(has_server=False, session=folder, **FAST) as (until, probe, _):
        probe.send(room_submap("auv_1"))
        until(lambda: probe.num_merged == 1, "the submap")
    with manage(has_server=False, session=folder, **FAST) as (until, probe, _):
        until(lambda: probe.num_merged == 1, "the resumed session")


def test_a_disk_that_is_away_stops_nothing_and_is_used_when_back(manage, tmp_path):
    disk = tmp_path / "disk"
    disk.write_text("not mounted")
    statuses = []

    def on_diagnostics(msg):
        statuses.extend(s for s in msg.status if s.name.startswith("map_queue_manager"))

    with manage(session=str(disk / "session"), **FAST) as (until, probe, call):
        probe.node.create_subscription(DiagnosticArray, "/diagnostics", on_diagnostics, 10)
        for submap in two_submaps():
            probe.send(submap)
        until(lambda: probe.num_merged == 2, "the merge")
        until(lambda: probe.maps, "the map")
        until(lambda: statuses and statuses[-1].level == DiagnosticStatus.ERROR, "the report")
        assert "cannot write to the session" in statuses[-1].message
        disk.unlink()
        until(lambda: has_session(disk / "session"), "the save")
        until(lambda: statuses[-1].level == DiagnosticStatus.OK, "all well")
        saved = call(SaveSession, "save_session", path=str(disk / "session"))
        assert saved.result == SaveSession.Response.DONE, saved.message
    assert len(load_session(disk / "session").submaps()) == 2


def many_submaps(count):
    spec, values = GridSpec(0.5, 8, 8), np.zeros((8, 8), np.int8)
    values[2:6, 2] = 100
    first = room_submap("auv_1")
    return [
        dataclasses.replace(
            first,
            sequence=number,
            grid=OccupancyMap(spec, values),
            T_odom_submap=SE2(2.0 * number, 0.0, 0.0),
            trajectory=np.empty((0, 3)),
            trajectory_stamp_ns=np.empty(0, np.int64),
        )
        for number in range(count)
    ]


def test_a_manager_that_starts_late_asks_for_what_it_missed(manage, ros_context):
    submaps = many_submaps(130)
    mapper = rclpy.create_node("sonar_mapper", namespace="auv_1", context=ros_context)
    publisher = mapper.create_publisher(SubmapMsg, "submap", SUBMAPS)
    asked = defaultdict(list)

    def give(request, response):
        asked[request.sequence].append(time.monotonic())
        response.result = response.DONE
        response.submap = submap_to_msg(submaps[request.sequence])
        return response

    mapper.create_service(GetSubmap, "~/get_submap", give)
    for submap in submaps:
        publisher.publish(submap_to_msg(submap))
    with manage(mapper, has_server=False, **FAST) as (until, probe, _):
        until(lambda: len(probe.states()) == len(submaps), "all submaps")
    assert len(asked) >= len(submaps) - SUBMAPS.depth
    # The first answers may get lost, where the mapper does not know the manager yet: they are
    # asked for again, but not before they are overdue; the others once.
    waits_s = [wait_s for times in asked.values() for wait_s in np.diff(times)]
    assert all(wait_s > 0.5 * missing_submaps._FIRST_TIMEOUT_S for wait_s in waits_s)
    assert len(waits_s) <= 4


def test_what_is_missing_and_cannot_be_had_is_told(manage, monkeypatch):
    monkeypatch.setattr(missing_submaps, "_LOST_S", 3.0)
    statuses = []

    def on_diagnostics(msg):
        statuses.extend(s for s in msg.status if s.name.startswith("map_queue_manager"))

    with manage(**FAST) as (until, probe, _):
        probe.node.create_subscription(DiagnosticArray, "/diagnostics", on_diagnostics, 10)
        for number in (0, 4, 6):
            probe.send(many_submaps(7)[number])
        until(lambda: any("auv_1: 1 to 3, 5" in s.message for s in statuses), "the report")
    assert statuses[-1].level == DiagnosticStatus.WARN
    assert {v.key: v.value for v in statuses[-1].values}["num_submaps_missing"] == "4"


def test_what_is_set_aside_is_told(manage):
    statuses = []

    def on_diagnostics(msg):
        statuses.extend(s for s in msg.status if s.name.startswith("map_queue_manager"))

    far = SE2(5000.0, 0.0)

    def of_run(*args, **kwargs):
        return dataclasses.replace(room_submap("auv_1", *args, **kwargs), run_id=1936390121)

    with manage(**FAST) as (until, probe, _):
        probe.node.create_subscription(DiagnosticArray, "/diagnostics", on_diagnostics, 10)
        probe.send(of_run())
        until(lambda: probe.num_merged, "the first submap")
        assert probe.statuses[-1].message == "auv_1/0 revision 0 received", "not by its number"
        probe.send(of_run(sequence=1, T_odom_submap=far))
        until(lambda: SubmapInfo.SET_ASIDE in probe.states().values(), "the leap")
        until(lambda: statuses and "auv_1: set aside: odometry" in statuses[-1].message, "a word")
        assert statuses[-1].level == DiagnosticStatus.WARN
        probe.send(of_run(sequence=1, revision=1))
        until(lambda: SubmapInfo.SET_ASIDE not in probe.states().values(), "its return")
        until(lambda: "set aside" not in statuses[-1].message, "no more word of it")


def test_two_managers_do_not_share_a_session(manage, ros_context, tmp_path):
    settings = {"session": str(tmp_path / "session"), **FAST}
    with manage(has_server=False, **settings) as (until, probe, _):
        probe.send(room_submap("auv_1"))
        until(lambda: probe.num_merged == 1, "the submap")
        parameters = [Parameter("session", value=settings["session"])]
        with pytest.raises(SessionInUseError, match="give each manager a folder"):
            MapQueueManager(context=ros_context, parameter_overrides=parameters)


def test_what_is_left_is_asked_when_told_to_settle(manage):
    """While more is expected a refused pair is left alone; then it is asked as a whole."""
    asked = []

    def refuse_at_first(request, response):
        asked.append(request.options.max_seconds)
        response.result = RegisterMaps.Response.DONE
        response.registration.verdict = response.registration.AMBIGUOUS
        response.registration.reason = "for now"
        return response

    with manage(has_server=False, quiet_s=3600.0, **FAST) as (until, probe, call):
        probe.node.create_service(RegisterMaps, "/some/register_maps", refuse_at_first)
        for submap in two_submaps():
            probe.send(submap)
        until(lambda: len(asked) == 1, "the first question")
        probe.send(room_submap("auv_2", 1, T_room_submap=T_ROOM["auv_2"]))
        until(lambda: ("auv_2", 1) in probe.states(), "the larger map")
        assert len(asked) == 1
        assert call(Trigger, "settle").success
        until(lambda: len(asked) >= 2, "the rest")
    # No machine is so slow that a search within its budget of boxes takes this long.
    assert min(asked) >= 60.0


def test_known_start_poses_say_where_maps_are_searched(manage):
    options = []

    def refuse(request, response):
        options.append((request.source.header.frame_id, request.options))
        response.result = RegisterMaps.Response.DONE
        response.registration.verdict = response.registration.AMBIGUOUS
        return response

    first, second = two_submaps()
    T_room = T_ROOM["auv_1"].inverse() @ T_ROOM["auv_2"]
    poses = ["auv_1 0 0 0", f"auv_2 {T_room.x} {T_room.y} {T_room.yaw}"]
    settings = {"start_poses": poses, "start_error_m": 2.0, "start_error_rad": 0.2}
    with manage(has_server=False, **settings, **FAST) as (until, probe, _):
        probe.node.create_service(RegisterMaps, "/some/register_maps", refuse)
        probe.send(first)
        probe.send(second)
        until(lambda: options, "a question")
    frame_id, asked = options[0]
    T_expected = T_room if frame_id.startswith("auv_2") else T_room.inverse()
    assert asked.has_prior
    T_prior = SE2(asked.prior.x, asked.prior.y, asked.prior.yaw)
    assert T_prior.distance_to(T_expected)[0] < 1e-6
    # Twice the error of a start, and what the headings turn the far map by.
    distance_m = np.hypot(T_expected.x, T_expected.y)
    assert asked.prior_half_width_m == pytest.approx(4.0 + 0.2 * distance_m)
    assert asked.prior_half_width_rad == pytest.approx(0.4)


def test_provenance_is_saved_with_the_map(manage, tmp_path):
    with manage(has_server=False, **FAST) as (until, probe, call):
        probe.send(room_submap("auv_1"))
        until(lambda: probe.num_merged == 1, "the submap")
        saved = call(SaveMap, "save_map", path=str(tmp_path / "map"))
    archive = str(tmp_path / "map_provenance.npz")
    assert archive in saved.files
    provenance = read_provenance(archive)
    assert provenance.contributors == ((), (("auv_1", 0, 0),))


def test_changed_part_goes_out_as_an_update(manage):
    with manage(has_server=False, publish_period_s=0.1, full_map_period_s=3600.0) as (
        until,
        probe,
        _,
    ):
        probe.send(room_submap("auv_1"))
        until(lambda: probe.maps, "the whole map")
        num_maps = len(probe.maps)
        # The same cells of the map, seen again by the next submap.
        probe.send(room_submap("auv_1", sequence=1))
        until(lambda: probe.updates, "an update")
        update = probe.updates[-1]
        assert len(update.data) == update.width * update.height > 0
        assert update.x + update.width <= probe.maps[-1].info.width
        assert update.y + update.height <= probe.maps[-1].info.height
        assert len(probe.maps) == num_maps
