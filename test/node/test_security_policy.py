"""The SROS2 policy allows each node what it does, and nothing that it does not do."""

from fnmatch import fnmatchcase
from xml.etree import ElementTree as ET

import pytest

pytest.importorskip("rclpy")

import rclpy
from rclpy.parameter import Parameter

from uw_dslam_ros2.ros.nodes.map_queue_manager import MapQueueManager
from uw_dslam_ros2.ros.nodes.registration_server import RegistrationServer
from uw_dslam_ros2.ros.nodes.sonar_mapper import SonarMapper
from uw_dslam_ros2.ros.plumbing.security_policy import policy_of, rights_of

pytestmark = pytest.mark.ros

NOT_ALWAYS = {
    # Only where another input is chosen, with simulated time, or for groups that are not joined.
    "sonar_mapper": {"/auv_1/scan", "/auv_1/points", "/clock"},
    "registration_server": {"/clock"},
    "map_queue_manager": {"/clock", "/map_*"},
}


def resolved(rights, names):
    """Whole names, as a node of this name and namespace resolves them."""
    namespace = rights.namespace.rstrip("/")
    heads = {"/": "", "~": f"{namespace}/{rights.node}"}
    return {
        heads[name[0]] + name.removeprefix("~") if name[0] in heads else f"{namespace}/{name}"
        for name in names
    }


@pytest.fixture
def graph(ros_context, spinning):
    """A probe that sees a mapper, a server and a manager."""
    manager = MapQueueManager(
        context=ros_context, parameter_overrides=[Parameter("vehicles", value=["auv_1"])]
    )
    mapper = SonarMapper(context=ros_context, namespace="auv_1")
    server = RegistrationServer(context=ros_context)
    probe = rclpy.create_node("probe", context=ros_context)
    asked = "/registration_server/register_maps"
    with spinning(manager, mapper, server, probe) as until:
        until(
            lambda: any(
                name == asked
                for name, _ in probe.get_client_names_and_types_by_node("map_queue_manager", "/")
            ),
            "that the manager has found the server",
        )
        yield probe


def test_nodes_have_the_rights_that_they_use_and_no_others(graph):
    for rights in rights_of(["auv_1"]):
        if rights.node == "bag_player":
            continue  # it publishes whatever its bags hold
        node = rights.node, rights.namespace
        actions = resolved(rights, rights.execute)
        for act, seen in (
            ("publish", graph.get_publisher_names_and_types_by_node(*node)),
            ("subscribe", graph.get_subscriber_names_and_types_by_node(*node)),
            ("reply", graph.get_service_names_and_types_by_node(*node)),
            ("request", graph.get_client_names_and_types_by_node(*node)),
        ):
            names = {name for name, _ in seen if name.split("/_action/")[0] not in actions}
            allowed = resolved(rights, getattr(rights, act))
            refused = {n for n in names if not any(fnmatchcase(n, a) for a in allowed)}
            assert refused == set(), (rights.node, act)
            unused = allowed - names - NOT_ALWAYS[rights.node]
            # A mapper is asked for a submap only when one is missing.
            unused = {name for name in unused if not name.endswith("/sonar_mapper/get_submap")}
            assert unused - actions == set(), (rights.node, act)


def test_the_policy_is_as_sros2_reads_it():
    root = ET.fromstring(policy_of(["auv_1", "auv_2"]).encode())
    assert (root.tag, root.get("version")) == ("policy", "0.2.0")
    paths = [enclave.get("path") for enclave in root.findall("enclaves/enclave")]
    assert paths == [
        *("/auv_1/sonar_mapper", "/auv_2/sonar_mapper"),
        *("/registration_server", "/map_queue_manager", "/bag_player"),
    ]
    for profile in root.iter("profile"):
        assert profile.get("ns").startswith("/")
        for group in profile:
            assert set(group.attrib.values()) == {"ALLOW"}
            assert {child.tag for child in group} == {group.tag.removesuffix("s")}
            assert all(child.text for child in group)


def test_nobody_but_its_mapper_may_send_a_vehicles_submaps():
    root = ET.fromstring(policy_of(["auv_1", "auv_2"]).encode())
    senders = set()
    for profile in root.iter("profile"):
        for group in profile.findall("topics[@publish='ALLOW']"):
            for topic in group:
                name = topic.text if topic.text[0] == "/" else f"{profile.get('ns')}/{topic.text}"
                if name == "/auv_1/submap":
                    senders.add((profile.get("ns"), profile.get("node")))
    assert senders == {("/auv_1", "sonar_mapper")}
