"""Messages in any order, late or twice, through the nodes: once settled, the same map."""

import pytest

pytest.importorskip("rclpy")

import rclpy
from places import room_submap
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger
from uw_dslam_msgs.msg import MergeStatus
from uw_dslam_msgs.msg import Submap as SubmapMsg
from uw_dslam_msgs.srv import SaveMap

from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.ros.convert.core_types import submap_to_msg
from uw_dslam_ros2.ros.nodes.map_queue_manager import MapQueueManager
from uw_dslam_ros2.ros.nodes.registration_server import RegistrationServer
from uw_dslam_ros2.ros.plumbing.qos import LATCHED, SUBMAPS

pytestmark = [pytest.mark.ros, pytest.mark.timeout(300)]

T_ROOM = {
    "auv_1": SE2(2.0, 3.0, 0.0),
    "auv_2": SE2(5.0, 4.0, 2.0),
    "auv_3": SE2(7.0, 5.0, -1.0),
}
FAST = {"publish_period_s": 0.1, "full_map_period_s": 0.1}


def messages():
    """Two submaps of each vehicle; of the first of auv_2 there is a newer revision, too."""
    found = []
    for name, T_room in T_ROOM.items():
        for sequence in range(2):
            step = SE2(0.5 * sequence, 0.0, 0.0)
            found.append(
                room_submap(name, sequence, T_room_submap=T_room @ step, T_odom_submap=step)
            )
    revised = room_submap("auv_2", 0, 1, T_ROOM["auv_2"], SE2(0.01, 0.0, 0.0))
    return [*found, revised]


ORDERS = {
    "in turn": (0, 2, 4, 1, 3, 5, 6),
    "backwards, some twice": (6, 5, 4, 4, 3, 2, 6, 1, 3, 0),  # the first one joins the others last
}


def settled_map(context, spinning, order, folder):
    """Bytes of the files of the global map, and where each submap lies."""
    parameters = [Parameter(name, value=value) for name, value in FAST.items()]
    manager = MapQueueManager(context=context, parameter_overrides=parameters)
    server = RegistrationServer(context=context)
    probe = rclpy.create_node("probe", context=context)
    statuses = []
    probe.create_subscription(MergeStatus, "/merge_status", statuses.append, LATCHED)
    publishers = {
        name: probe.create_publisher(SubmapMsg, f"/{name}/submap", SUBMAPS) for name in T_ROOM
    }
    with spinning(manager, server, probe) as until:

        def call(service_type, name, **fields):
            client = probe.create_client(service_type, f"/map_queue_manager/{name}")
            until(client.service_is_ready, name)
            future = client.call_async(service_type.Request(**fields))
            until(future.done, f"answer of {name}")
            return future.result()

        def newest():
            infos = statuses[-1].submaps if statuses else []
            return {(info.vehicle_id, info.sequence): info for info in infos}

        def is_settled(begun):
            last = statuses[max(begun, len(statuses) - 4) :]
            is_quiet = len(last) == 4 and not any(status.num_in_flight for status in last)
            return is_quiet and len({status.num_registrations for status in last}) == 1

        def settle():
            call(Trigger, "settle")
            begun = len(statuses)
            until(lambda: is_settled(begun), "all answers", 120.0)

        until(lambda: all(p.get_subscription_count() for p in publishers.values()), "the manager")
        seen = set()
        for count, index in enumerate(order):
            if count == len(order) - 1:
                settle()
            submap = messages()[index]
            publishers[submap.vehicle_id].publish(submap_to_msg(submap))
            seen.add((submap.vehicle_id, submap.sequence))
            # One after the other, so that the order is the one that is meant.
            until(lambda: seen <= set(newest()), f"{submap.vehicle_id}/{submap.sequence}")
        until(lambda: newest()["auv_2", 0].revision == 1, "the revision")
        settle()
        assert all(info.state == info.MERGED for info in newest().values())
        assert call(SaveMap, "save_map", path=str(folder / "map")).files
        places = {
            name: (info.t_component_submap.x, info.t_component_submap.y)
            for name, info in newest().items()
        }
    return {path.name: path.read_bytes() for path in folder.iterdir()}, places


def test_the_settled_map_is_the_same_in_any_order(ros_context, spinning, tmp_path):
    found = {}
    for name, order in ORDERS.items():
        found[name] = settled_map(ros_context, spinning, order, tmp_path / name)
    files, places = found.pop("in turn")
    assert "map.pgm" in files
    for name, (other_files, other_places) in found.items():
        assert other_places == places, name
        assert other_files == files, name
