"""Which topic plays which role, on made-up tables of topics."""

import itertools

import pytest

from uw_dslam_ros2.core.errors import ConfigError, DataError
from uw_dslam_ros2.io.sensor_settings import SensorConfig, TopicsConfig
from uw_dslam_ros2.io.topics import find_vehicles

SONAR = "marine_acoustic_msgs/msg/ProjectedSonarImage"
DVL = "marine_acoustic_msgs/msg/Dvl"
IMU = "sensor_msgs/msg/Imu"
PRESSURE = "sensor_msgs/msg/FluidPressure"
ODOMETRY = "nav_msgs/msg/Odometry"
TF = "tf2_msgs/msg/TFMessage"

LEAVES = {
    "plain": ("sonar", "dvl", "imu", "depth"),
    "drivers": ("oculus/ping", "dvl/velocity", "imu/data", "pressure"),
    "other words": ("fls", "nav/bottom_track", "xsens", "baro"),
}
STRANGERS = {
    "/events/write_split": "rosbag2_interfaces/msg/WriteSplitEvent",
    "/rosout": "rcl_interfaces/msg/Log",
    "/joy": "sensor_msgs/msg/Joy",
    "/tf_static": TF,
    "/tf": TF,
    "/ship/odom": ODOMETRY,
    "/ship/imu": IMU,
}


def settings_of(**topics):
    return lambda _: SensorConfig(topics=TopicsConfig(**topics))


def table(namespace, leaves="plain", *, has_truth=True):
    types = (SONAR, DVL, IMU, PRESSURE)
    found = {f"{namespace}/{leaf}": t for leaf, t in zip(LEAVES[leaves], types, strict=True)}
    return found | ({f"{namespace}/truth/odom": ODOMETRY} if has_truth else {})


@pytest.mark.parametrize("leaves", LEAVES)
@pytest.mark.parametrize("above", ["", "/robots", "/a/b"])
@pytest.mark.parametrize("is_one_bag", [False, True])
def test_two_vehicles_are_found_whatever_their_topics_are_called(leaves, above, is_one_bag):
    one, two = (table(f"{above}/auv_{n}", leaves) for n in (1, 2))
    tables = [one | two | STRANGERS] if is_one_bag else [one | STRANGERS, two | STRANGERS]
    vehicles = find_vehicles(tables, ["first", "second"][: len(tables)])
    assert [v.vehicle_id for v in vehicles] == ["auv_1", "auv_2"]
    for vehicle in vehicles:
        prefix = f"{above}/{vehicle.vehicle_id}"
        assert vehicle.namespace == prefix.strip("/")
        roles = ("sonar", "velocity", "imu", "depth")
        expected = {
            role: f"{prefix}/{leaf}" for role, leaf in zip(roles, LEAVES[leaves], strict=True)
        }
        assert {role: vehicle.topics.get(role) for role in roles} == expected
        assert vehicle.topics["truth"] == f"{prefix}/truth/odom"
        assert "odometry" not in vehicle.topics


@pytest.mark.parametrize("group", ["sensors", "payload", "hull/bow"])
def test_a_group_of_sensors_has_not_the_vehicles_name(group):
    tables = [
        table(f"/auv_{n}/{group}", has_truth=False) | {f"/auv_{n}/truth/odom": ODOMETRY}
        for n in (1, 2)
    ]
    vehicles = find_vehicles(tables, ["first", "second"])
    assert [(v.vehicle_id, v.namespace) for v in vehicles] == [
        ("auv_1", "auv_1"),
        ("auv_2", "auv_2"),
    ]
    for vehicle in vehicles:
        assert vehicle.topics["sonar"] == f"/{vehicle.vehicle_id}/{group}/sonar"
        assert vehicle.topics["truth"] == f"/{vehicle.vehicle_id}/truth/odom"


def test_groups_without_a_vehicle_above_have_the_name_of_the_bag():
    (vehicle,) = find_vehicles([table("/sensors", has_truth=False)], ["dive_3"])
    assert (vehicle.vehicle_id, vehicle.namespace) == ("dive_3", "")
    assert vehicle.topics["imu"] == "/sensors/imu"


@pytest.mark.parametrize("leaves", ["plain", "drivers"])
def test_a_vehicle_without_a_namespace_has_the_name_of_its_bag(leaves):
    tables = [table("", leaves), table("", leaves)]
    vehicles = find_vehicles(tables, ["dive_3", "dive_4"])
    assert [(v.vehicle_id, v.namespace, v.tables) for v in vehicles] == [
        ("dive_3", "", (0,)),
        ("dive_4", "", (1,)),
    ]


def test_the_order_in_which_topics_are_listed_does_not_matter():
    topics = {**table("/auv_1"), "/auv_1/mavros/imu": IMU}
    found = {
        tuple(sorted(find_vehicles([dict(order)], ["bag"])[0].topics.items()))
        for order in itertools.permutations(topics.items())
    }
    assert len(found) == 1
    assert dict(found.pop())["imu"] == "/auv_1/imu"


def test_a_bag_of_the_sonar_and_one_of_the_navigation_are_one_vehicle():
    for namespace in ("", "/auv_1"):
        sonar, others = {}, table(namespace, "drivers")
        sonar[f"{namespace}/oculus/ping"] = others.pop(f"{namespace}/oculus/ping")
        (vehicle,) = find_vehicles([sonar, others], ["a", "b"])
        assert vehicle.tables == (0, 1)
        assert {"sonar", "imu", "velocity"} <= set(vehicle.topics)


def test_a_sensor_below_another_one_does_not_make_a_vehicle():
    topics = {"/auv_1/oculus/ping": SONAR, "/auv_1/oculus/imu": IMU}
    (vehicle,) = find_vehicles([topics | {"/auv_1/dvl": DVL, "/auv_1/imu": IMU}], ["bag"])
    assert (vehicle.vehicle_id, vehicle.topics["imu"]) == ("auv_1", "/auv_1/imu")
    assert vehicle.unused == {"/auv_1/oculus/imu": "/auv_1/imu is the imu"}


def test_the_vehicles_own_filter_is_its_odometry_and_its_truth_is_not():
    topics = {"/auv_1/sonar": SONAR, "/auv_1/odometry/filtered": ODOMETRY}
    (vehicle,) = find_vehicles([topics | {"/auv_1/ground_truth/odom": ODOMETRY}], ["bag"])
    assert vehicle.topics == {
        "sonar": "/auv_1/sonar",
        "odometry": "/auv_1/odometry/filtered",
        "truth": "/auv_1/ground_truth/odom",
    }


def test_the_filter_is_not_used_beside_what_it_is_made_of():
    topics = table("/auv_1") | {"/auv_1/odometry/filtered": ODOMETRY}
    (vehicle,) = find_vehicles([topics], ["bag"])
    assert "odometry" not in vehicle.topics
    assert vehicle.unused["/auv_1/odometry/filtered"] == "dvl and imu are there themselves"
    (chosen,) = find_vehicles([topics], ["bag"], settings_of(odometry="odometry/filtered"))
    assert chosen.topics["odometry"] == "/auv_1/odometry/filtered"


def test_of_two_that_are_alike_the_user_must_choose():
    topics = table("/auv_1") | {"/auv_1/imu_b": IMU, "/auv_1/imu_a": IMU}
    del topics["/auv_1/imu"]
    with pytest.raises(DataError, match=r"auv_1: two topics could be its imu: /auv_1/imu_a and "):
        find_vehicles([topics], ["bag"])
    for name in ("imu_b", "/auv_1/imu_b"):
        (vehicle,) = find_vehicles([topics], ["bag"], settings_of(imu=name))
        assert vehicle.topics["imu"] == "/auv_1/imu_b"


def test_raw_data_go_behind_what_the_driver_made_of_them():
    topics = {"/auv_1/sonar": SONAR, "/auv_1/imu/data_raw": IMU, "/auv_1/imu/data": IMU}
    (vehicle,) = find_vehicles([topics], ["bag"])
    assert vehicle.topics["imu"] == "/auv_1/imu/data"


def test_a_number_is_a_heading_only_by_its_name_and_beside_no_imu():
    number = "std_msgs/msg/Float64"
    named = {"/r/imu/temperature": number, "/r/imu/heading_rate": "std_msgs/msg/String"}
    sensors = {"/r/sonar": SONAR, "/r/dvl": DVL, **named}
    (vehicle,) = find_vehicles([sensors], ["bag"])
    assert "imu" not in vehicle.topics
    compass = {"/r/mavros/global_position/compass_hdg": number}
    (vehicle,) = find_vehicles([sensors | compass], ["bag"])
    assert vehicle.topics["imu"] == next(iter(compass))
    (vehicle,) = find_vehicles([sensors | compass | {"/r/mavros/imu/data": IMU}], ["bag"])
    assert vehicle.topics["imu"] == "/r/mavros/imu/data"


def test_a_topic_that_is_set_must_be_there_and_fit():
    with pytest.raises(DataError, match="no topic /auv_1/mavros/imu for its imu; there are /auv_"):
        find_vehicles([table("/auv_1")], ["bag"], settings_of(imu="mavros/imu"))
    with pytest.raises(DataError, match=r"/auv_1/dvl has type .*Dvl, which cannot be its imu"):
        find_vehicles([table("/auv_1")], ["bag"], settings_of(imu="dvl"))


def test_topics_as_options():
    topics = TopicsConfig.of_options(["dvl=/a/b", "sonar=ping"])
    assert topics.chosen() == {"velocity": "/a/b", "sonar": "ping"}
    assert TopicsConfig(sonar="x").over(topics).chosen() == {"velocity": "/a/b", "sonar": "x"}
    for text in ("sonar", "sonar=", "radar=/a"):
        with pytest.raises(ConfigError, match="expected ROLE=TOPIC"):
            TopicsConfig.of_options([text])
