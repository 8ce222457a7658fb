"""The mapper as a node: topics, frames, bad messages, a bag that loops."""

import dataclasses
import math

import numpy as np
import pytest

pytest.importorskip("rclpy")

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TransformStamped, TwistWithCovarianceStamped
from node.drives import SPEED_M_S, START_NS, Vehicle, drive, finish, mapper_of
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import FluidPressure, Imu, LaserScan
from tf2_msgs.msg import TFMessage
from uw_dslam_msgs.srv import GetSubmap

from uw_dslam_ros2.core.chart import redraw
from uw_dslam_ros2.core.errors import ConfigError
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.messages import stamp_of
from uw_dslam_ros2.ros.convert.core_types import occupancy_from_msg, stamp_to_msg, submap_from_msg
from uw_dslam_ros2.ros.mapper import sensor_silence
from uw_dslam_ros2.ros.plumbing.qos import STATIC_TF

pytestmark = pytest.mark.ros

_SURFACE_PA, _PA_PER_M = 101_325.0, 1025.0 * 9.80665
"""Of sea water, by the defaults."""


def test_room_becomes_map_submap_odometry_and_frames(ros_context, spinning):
    vehicle, mapper = Vehicle(ros_context), mapper_of(ros_context)
    with spinning(mapper, vehicle.node) as until:
        until(vehicle.is_connected, "connection")
        vehicle.send_mount()
        drive(until, vehicle, range(10))
        until(lambda: vehicle.values().get("num_scan") == "20", "all scans")
        until(lambda: vehicle.values().get("num_imu") == "100", "all of the IMU")
        response = finish(until, vehicle)
        assert response.success
        assert "20 pings mapped into 1 submaps, 1 of them drawn anew; 0 bad" in response.message
        until(lambda: len(vehicle.submaps) == 2 and vehicle.maps and vehicle.paths, "results")
        until(lambda: ("auv_1/odom", "auv_1/base_link") in vehicle.frames, "TF")
        last_ns = START_NS + 9_900_000_000
        until(lambda: stamp_of(vehicle.odometry[-1]) == last_ns, "the last odometry")
        client = vehicle.node.create_client(GetSubmap, "sonar_mapper/get_submap")
        until(client.service_is_ready, "the service")
        futures = [
            client.call_async(GetSubmap.Request(vehicle_id="auv_1", sequence=number))
            for number in (0, 1)
        ]
        until(lambda: all(future.done() for future in futures), "answers")
    again, unknown = (future.result() for future in futures)
    assert (again.result, again.submap) == (GetSubmap.Response.DONE, vehicle.submaps[-1])
    assert unknown.result == GetSubmap.Response.NOT_FOUND
    assert "no submap 1" in unknown.message
    assert [msg.revision for msg in vehicle.submaps] == [0, 1]
    submap = submap_from_msg(vehicle.submaps[-1])  # drawn anew, and so whole
    assert (submap.vehicle_id, submap.sequence) == ("auv_1", 0)
    assert submap.run_id > 0
    assert submap.is_final
    assert vehicle.submaps[-1].header.frame_id == "auv_1/submap_0"
    assert vehicle.maps[-1].header.frame_id == "auv_1/map"
    assert ("auv_1/map", "auv_1/odom") in vehicle.frames
    newest = vehicle.odometry[-1]
    assert (newest.header.frame_id, newest.child_frame_id) == ("auv_1/odom", "auv_1/base_link")
    # The mean of many matches: within a cell of the way that was driven.
    assert newest.pose.pose.position.x == pytest.approx(9.9 * SPEED_M_S, abs=0.1)
    assert newest.pose.pose.position.y == pytest.approx(0.0, abs=0.1)
    assert newest.twist.twist.linear.x == pytest.approx(SPEED_M_S, abs=0.05)
    # The left wall is 4 m to the left of the start, the far one 9 m ahead: asymmetric on purpose.
    occupancy = occupancy_from_msg(vehicle.maps[-1])
    walls = occupancy.spec.centers_of(np.argwhere(occupancy.values > 65))
    assert walls[:, 0].max() == pytest.approx(9.0, abs=0.3)
    assert walls[:, 1].max() == pytest.approx(4.0, abs=0.3)
    assert len(vehicle.paths[-1].poses) == 20


def test_replay_faster_than_time_draws_few_maps_and_the_last_one(ros_context, spinning):
    vehicle, mapper = Vehicle(ros_context), mapper_of(ros_context, map_period_s=3600.0)
    with spinning(mapper, vehicle.node) as until:
        until(vehicle.is_connected, "connection")
        vehicle.send_mount()
        drive(until, vehicle, range(4))
        until(lambda: vehicle.values().get("num_scan") == "8", "all scans")
        assert finish(until, vehicle).success
        until(lambda: vehicle.paths and len(vehicle.paths[-1].poses) == 8, "the last path")
    # One with the first ping, one where the idle timer may have come in, one at the end.
    assert 1 <= len(vehicle.maps) <= 3


def test_mounts_may_come_after_the_first_messages(ros_context, spinning):
    vehicle, mapper = Vehicle(ros_context), mapper_of(ros_context)
    with spinning(mapper, vehicle.node) as until:
        until(vehicle.is_connected, "connection")
        vehicle.send_second(0)
        until(lambda: vehicle.values().get("num_scan") == "2", "the scans")
        vehicle.send_mount()
        response = finish(until, vehicle)
        assert "2 pings mapped" in response.message


@pytest.mark.parametrize("topic", ["/tf", "/auv_1/tf_static"])
def test_mounts_are_heard_wherever_they_are_sent(ros_context, spinning, topic):
    vehicle, mapper = Vehicle(ros_context), mapper_of(ros_context)
    vehicle.static_pub = vehicle.node.create_publisher(
        TFMessage, topic, 100 if topic == "/tf" else STATIC_TF
    )
    with spinning(mapper, vehicle.node) as until:
        until(vehicle.is_connected, "connection")
        vehicle.send_mount()
        vehicle.send_second(0)
        assert "2 pings mapped" in finish(until, vehicle).message
    assert vehicle.frames  # what the mapper itself sends on /tf is no mount


def test_a_sonar_that_looks_down_is_told(ros_context, spinning):
    vehicle, mapper = Vehicle(ros_context), mapper_of(ros_context)
    with spinning(mapper, vehicle.node) as until:
        until(vehicle.is_connected, "connection")
        half_rad = math.radians(10.0)
        mount = TransformStamped(child_frame_id="auv_1/sonar")
        mount.header.frame_id = "auv_1/base_link"
        mount.transform.rotation.y = math.sin(half_rad)
        mount.transform.rotation.w = math.cos(half_rad)
        vehicle.static_pub.publish(TFMessage(transforms=[mount]))
        vehicle.send_second(0)
        assert finish(until, vehicle).success
        until(lambda: "points 20 degrees up or down" in vehicle.message(), "it")


def test_bad_messages_are_told_and_survived(ros_context, spinning):
    vehicle, mapper = Vehicle(ros_context), mapper_of(ros_context)
    with spinning(mapper, vehicle.node) as until:
        until(vehicle.is_connected, "connection")
        vehicle.send_mount()
        bad = vehicle.scan_msg(START_NS, 0.0)
        bad.angle_increment = float("nan")
        vehicle.scan_pub.publish(bad)
        until(lambda: vehicle.values().get("num_bad") == "1", "the count")
        assert "bad message on scan: angle_min" in vehicle.message()
        unstamped = vehicle.scan_msg(0, 0.0)
        vehicle.scan_pub.publish(unstamped)
        until(lambda: "header.stamp is 0.0 s" in vehicle.message(), "the complaint")
        drive(until, vehicle, range(2))
        until(lambda: vehicle.values().get("num_scan") == "6", "all scans")
        assert "4 pings mapped" in finish(until, vehicle).message


def test_odometry_does_not_jump_where_the_map_is_corrected(ros_context, spinning):
    """A new run, like a closed loop, moves the frame; depth and noise of the velocity are told."""
    vehicle, mapper = Vehicle(ros_context), mapper_of(ros_context)
    with spinning(mapper, vehicle.node) as until:
        until(vehicle.is_connected, "connection")
        vehicle.send_mount()
        drive(until, vehicle, range(4))
        drive(until, vehicle, range(20, 24))  # 16 s without anything
        until(lambda: int(vehicle.values().get("num_restarts", "0")) >= 1, "the new run")
        finish(until, vehicle)
        last_ns = START_NS + 23_900_000_000
        until(lambda: stamp_of(vehicle.odometry[-1]) == last_ns, "the last odometry")
    x = np.array([msg.pose.pose.position.x for msg in vehicle.odometry])
    assert np.abs(np.diff(x)).max() < 3 * SPEED_M_S * 0.1
    # The new run's own map begins at zero again; its frame says where odometry lies in it.
    T_map_odom = vehicle.frames["auv_1/map", "auv_1/odom"].transform.translation.x
    assert T_map_odom + x[-1] == pytest.approx(SPEED_M_S * 3.9, abs=0.2)
    covariance = np.reshape(vehicle.odometry[-1].twist.covariance, (6, 6))
    assert 0.0 < covariance[0, 0] < 1.0
    assert covariance[5, 5] > 0.0
    assert vehicle.odometry[-1].pose.covariance[14] == 1e6  # no depth was measured


def test_depth_becomes_the_odometrys_height(ros_context, spinning):
    vehicle, mapper = Vehicle(ros_context), mapper_of(ros_context)
    depth_pub = vehicle.node.create_publisher(FluidPressure, "depth", 10)
    with spinning(mapper, vehicle.node) as until:
        until(vehicle.is_connected, "connection")
        until(depth_pub.get_subscription_count, "the depth's subscription")
        vehicle.send_mount()
        msg = FluidPressure(fluid_pressure=_SURFACE_PA + _PA_PER_M * 7.0)
        msg.header.stamp = stamp_to_msg(START_NS)
        depth_pub.publish(msg)
        until(lambda: vehicle.values().get("num_depth") == "1", "the depth")
        drive(until, vehicle, range(3))
        until(lambda: vehicle.values().get("num_scan") == "6", "all scans")
        until(lambda: vehicle.values().get("num_imu") == "30", "all of the IMU")
        assert finish(until, vehicle).success
        last_ns = START_NS + 2_900_000_000
        until(lambda: vehicle.odometry and stamp_of(vehicle.odometry[-1]) == last_ns, "the end")
        key = ("auv_1/odom", "auv_1/base_link")
        until(lambda: key in vehicle.frames, "TF")
    newest = vehicle.odometry[-1].pose
    assert newest.pose.position.z == pytest.approx(-7.0, abs=0.1)
    covariance = np.reshape(newest.covariance, (6, 6))
    assert 0.0 < covariance[2, 2] < 1.0
    assert np.count_nonzero(covariance[2]) == 1
    assert vehicle.frames[key].transform.translation.z == newest.pose.position.z


def test_where_the_last_pass_moves_the_map_the_frame_goes_along(
    ros_context, spinning, monkeypatch
):
    T_after_before = SE2(0.3, -0.2, 0.1)

    def moved(submaps, _pings, _config):
        return [
            dataclasses.replace(
                submap,
                T_odom_submap=T_after_before @ submap.T_odom_submap,
                revision=submap.revision + 1,
            )
            for submap in submaps
        ]

    monkeypatch.setattr(redraw, "redrawn", moved)
    vehicle, mapper = Vehicle(ros_context), mapper_of(ros_context)
    key = ("auv_1/map", "auv_1/odom")
    with spinning(mapper, vehicle.node) as until:
        until(vehicle.is_connected, "connection")
        vehicle.send_mount()
        drive(until, vehicle, range(4))
        assert finish(until, vehicle).success
        last_ns = START_NS + 3_900_000_000
        # Later than the last odometry, so that who buffers transforms takes it.
        until(lambda: stamp_of(vehicle.frames[key]) == last_ns + 1, "the frame")
        until(lambda: stamp_of(vehicle.odometry[-1]) == last_ns, "the last odometry")
    frame = vehicle.frames[key].transform
    yaw = 2.0 * math.atan2(frame.rotation.z, frame.rotation.w)
    # One drive, one submap and no loop: before the last pass, map and odom are the same.
    found = SE2(frame.translation.x, frame.translation.y, yaw)
    assert found.as_array() == pytest.approx(T_after_before.as_array(), abs=1e-6)
    assert stamp_of(vehicle.frames["auv_1/odom", "auv_1/base_link"]) == last_ns + 1
    end = vehicle.paths[-1].poses[-1].pose.position  # of the last ping, 0.4 s before
    base = found @ SE2(vehicle.odometry[-1].pose.pose.position.x, 0.0, 0.0)
    assert math.hypot(end.x - base.x, end.y - base.y) < 0.6 * SPEED_M_S


def test_frames_can_be_named_and_transforms_left_to_others(ros_context, spinning):
    vehicle = Vehicle(ros_context)
    settings = {"publishes_tf": False, "map_frame": "chart", "odom_frame": "reckoning"}
    mapper = mapper_of(ros_context, **settings)
    with spinning(mapper, vehicle.node) as until:
        until(vehicle.is_connected, "connection")
        vehicle.send_mount()
        drive(until, vehicle, range(2))
        finish(until, vehicle)
        until(lambda: vehicle.maps and vehicle.odometry, "results")
    assert vehicle.maps[-1].header.frame_id == "chart"
    assert vehicle.odometry[-1].header.frame_id == "reckoning"
    assert vehicle.frames == {}


def test_an_unknown_frame_is_named_and_taken_to_look_ahead(ros_context, spinning):
    vehicle, mapper = Vehicle(ros_context), mapper_of(ros_context)
    with spinning(mapper, vehicle.node) as until:
        until(vehicle.is_connected, "connection")
        for second in range(3):
            vehicle.send_second(second)
        until(lambda: vehicle.values().get("num_scan") == "6", "the scans")
        assert "6 pings mapped" in finish(until, vehicle, num_frames=0).message
        until(lambda: "says where its frame 'auv_1/sonar' sits" in vehicle.message(), "the name")


def test_recording_that_begins_again_begins_a_new_run_and_keeps_the_old_one(ros_context, spinning):
    vehicle, mapper = Vehicle(ros_context), mapper_of(ros_context)
    with spinning(mapper, vehicle.node) as until:
        until(vehicle.is_connected, "connection")
        vehicle.send_mount()
        drive(until, vehicle, range(8))
        until(lambda: vehicle.values().get("num_scan") == "16", "the first round")
        drive(until, vehicle, range(4))
        until(lambda: int(vehicle.values().get("num_restarts", "0")) >= 1, "the restart")
        response = finish(until, vehicle)
        until(lambda: len(vehicle.submaps) == 4, "a submap of each run, and both drawn anew")
        # Odometry goes on; only its frame is elsewhere in the map of the new run.
        way_m = SPEED_M_S * (7.9 + 3.9)
        until(
            lambda: abs(vehicle.odometry[-1].pose.pose.position.x - way_m) < 0.1, "odometry's end"
        )
    assert "24 pings mapped" in response.message
    first, second = (submap_from_msg(msg) for msg in vehicle.submaps[2:])
    assert first.run_id != second.run_id
    assert (len(first.trajectory), len(second.trajectory)) == (16, 8)


def test_one_late_message_changes_nothing(ros_context, spinning):
    vehicle, mapper = Vehicle(ros_context), mapper_of(ros_context)
    with spinning(mapper, vehicle.node) as until:
        until(vehicle.is_connected, "connection")
        vehicle.send_mount()
        drive(until, vehicle, range(4))
        vehicle.send_yaw(START_NS + 500_000_000)
        drive(until, vehicle, range(4, 6))
        until(lambda: vehicle.values().get("num_scan") == "12", "all scans")
        response = finish(until, vehicle)
    assert "12 pings mapped into 1 submaps" in response.message
    assert vehicle.values().get("num_restarts", "0") == "0"


def test_sensors_with_other_names_are_found_by_their_types(ros_context, spinning):
    names = {"scan": "oculus/front", "imu": "xsens/data", "dvl": "nav/over_ground"}
    vehicle = Vehicle(ros_context, names=names)
    mapper = mapper_of(ros_context, input="any", velocity="any")
    with spinning(mapper, vehicle.node) as until:
        until(vehicle.is_connected, "connection")
        vehicle.send_mount()
        for second in range(3):
            vehicle.send_second(second)
        until(lambda: vehicle.values().get("num_sonar") == "6", "all scans")
        until(lambda: vehicle.values().get("num_imu") == "30", "all of the IMU")
        assert "6 pings mapped" in finish(until, vehicle).message


def test_a_sensor_that_falls_silent_is_told(ros_context, spinning, monkeypatch):
    monkeypatch.setattr(sensor_silence, "_SILENT_S", 0.5)
    monkeypatch.setattr(sensor_silence, "_LOST_S", 4.0)
    vehicle, mapper = Vehicle(ros_context), mapper_of(ros_context)
    with spinning(mapper, vehicle.node) as until:
        until(vehicle.is_connected, "connection")
        vehicle.send_mount()
        drive(until, vehicle, range(2))
        until(lambda: "imu: no message for" in vehicle.message(), "the silence")
        levels = {msg.status[0].level for msg in vehicle.diagnostics}
        assert DiagnosticStatus.WARN in levels
        until(lambda: vehicle.diagnostics[-1].status[0].level == DiagnosticStatus.ERROR, "lost")


def test_wrong_type_on_a_topic_is_told(ros_context, ros_domain_id, spinning):
    mapper = mapper_of(ros_context, velocity="dvl")
    # A process of its own would be a context of its own: one context has one type for a topic.
    other = rclpy.Context()
    rclpy.init(context=other, domain_id=ros_domain_id)
    driver = rclpy.create_node("driver", context=other)
    driver.create_publisher(TwistWithCovarianceStamped, "/auv_1/dvl", 10)
    probe, heard = rclpy.create_node("probe", context=ros_context), []
    probe.create_subscription(DiagnosticArray, "/diagnostics", heard.append, 10)
    words = "topic /auv_1/dvl has type geometry_msgs/msg/TwistWithCovarianceStamped, expected"
    with spinning(mapper, probe) as until:
        until(lambda: heard and words in heard[-1].status[0].message, "the complaint")
    driver.destroy_node()
    other.try_shutdown()


def test_best_effort_driver_is_heard(ros_context, spinning):
    mapper = mapper_of(ros_context, is_reliable=False)
    vehicle = Vehicle(ros_context)
    publisher = vehicle.node.create_publisher(LaserScan, "scan", qos_profile_sensor_data)
    with spinning(mapper, vehicle.node) as until:
        until(publisher.get_subscription_count, "connection")
        publisher.publish(vehicle.scan_msg(START_NS, 0.0))
        until(lambda: vehicle.values().get("num_scan") == "1", "the scan")


@pytest.mark.parametrize(
    ("namespace", "settings", "words"),
    [
        ("", {}, "vehicle_id is empty and the node has no namespace"),
        ("auv_1", {"input": "lidar"}, "input is 'lidar', expected one of any, image, scan"),
        ("auv_1", {"mapper.submap.max_length": 3.0}, "did you mean mapper.submap.max_length_m"),
    ],
)
def test_bad_setting_is_refused(ros_context, namespace, settings, words):
    with pytest.raises(ConfigError, match=words):
        mapper_of(ros_context, namespace or None, **settings)


def test_a_convention_that_is_not_followed_is_told_by_diagnostics(ros_context, spinning):
    vehicle, mapper = Vehicle(ros_context), mapper_of(ros_context, reorder_s=1.0)

    def level():
        return [status.level for msg in vehicle.diagnostics[-1:] for status in msg.status]

    with spinning(mapper, vehicle.node) as until:
        until(vehicle.is_connected, "connection")
        vehicle.send_mount()
        for half_second in range(320):
            imu = Imu()
            imu.header.stamp = stamp_to_msg(START_NS + half_second * 500_000_000)
            imu.orientation_covariance[8] = 1e-4
            imu.angular_velocity.z = 0.3
            vehicle.imu_pub.publish(imu)
            until(
                lambda n=half_second: int(vehicle.values().get("num_imu", "0")) > n - 80, "the IMU"
            )
        until(lambda: "its orientation never changes" in vehicle.message(), "the finding")
        assert level() == [DiagnosticStatus.WARN]
