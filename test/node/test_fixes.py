"""Position fixes on topics pull the map of a running manager, as those of recordings do."""

import dataclasses
import math

import pytest

pytest.importorskip("rclpy")

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from node.test_map_queue_manager import FAST, manage  # noqa: F401
from places import room_submap
from rclpy.parameter import Parameter
from sensor_msgs.msg import NavSatFix
from uw_dslam_msgs.srv import ListDecisions

from uw_dslam_ros2.core.errors import ConfigError
from uw_dslam_ros2.core.merging import MapQueue
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.fixes import FixLog
from uw_dslam_ros2.io.readings import FixEvent
from uw_dslam_ros2.ros.convert.core_types import transform2d_from_msg
from uw_dslam_ros2.ros.manager import fix_inputs
from uw_dslam_ros2.ros.nodes.map_queue_manager import MapQueueManager
from uw_dslam_ros2.ros.plumbing.qos import sensor_qos

pytestmark = pytest.mark.ros

SECOND = 1_000_000_000
T_EARTH_MAP = SE2(1000.0, 2000.0, 0.5)
SIGMA_M = 0.5


def submap(sequence):
    """Ten metres of a way that is straight by odometry."""
    stamps_ns = np.arange(10 * sequence, 10 * sequence + 11) * SECOND + SECOND
    return dataclasses.replace(
        room_submap("auv_1", sequence, T_odom_submap=SE2(10.0 * sequence)),
        stamp_ns=int(stamps_ns[-1]),
        covariance=np.diag([0.01, 0.01, 0.001]) * (sequence + 1),
        trajectory=np.column_stack([np.arange(11.0), np.zeros((11, 2))]),
        trajectory_stamp_ns=stamps_ns,
    )


def bent_way():
    """Time [s] and position on earth: to port of what odometry says, more and more."""
    for time_s in (3, 13, 23, 33):
        along_m = time_s - 1.0
        yield time_s, T_EARTH_MAP.apply(np.array([[along_m, 0.002 * along_m**2]]))[0]


def test_a_vehicles_fixes_pull_the_map_as_those_of_a_recording_do(
    manage,  # noqa: F811
    monkeypatch,
):
    monkeypatch.setattr(fix_inputs, "_PERIOD_S", 0.2)
    plain, log = MapQueue(), FixLog(SIGMA_M)
    settings = {"fix_topics": ["/auv_1/usbl"], "fix_sigma_m": SIGMA_M} | FAST
    with manage(has_server=False, **settings) as (until, probe, call):
        sender = probe.node.create_publisher(
            PoseWithCovarianceStamped, "/auv_1/usbl", sensor_qos(100, is_reliable=True)
        )
        until(lambda: sender.get_subscription_count() == 1, "the manager at the topic")
        submaps = [submap(sequence) for sequence in range(4)]
        for one in submaps:
            probe.send(one)
            plain.add_submap(one)
        bad = PoseWithCovarianceStamped()
        sender.publish(bad)  # without a time: refused, and nothing comes of it
        for time_s, (x_m, y_m) in bent_way():
            msg = PoseWithCovarianceStamped()
            msg.header.frame_id = "harbour"
            msg.header.stamp.sec = time_s
            msg.pose.pose.position.x, msg.pose.pose.position.y = x_m, y_m
            sender.publish(msg)
            position = np.array([x_m, y_m])
            log.note(FixEvent("auv_1/usbl", time_s * SECOND, "harbour", position, None))
        straight = [r.T_component_submap for r in plain.submaps()]
        plain.add_fixes(log.fixes(submaps))
        expected = plain.georeference()
        poses = [r.T_component_submap for r in plain.submaps()]
        assert poses[3].distance_to(straight[3])[0] > 0.05, "there is something to see"

        def shown():
            infos = probe.statuses[-1].submaps if probe.statuses else []
            return [transform2d_from_msg(info.t_component_submap, "pose") for info in infos]

        def is_pulled():
            found = shown()
            return len(found) == 4 and all(
                one.distance_to(other)[0] < 1e-6 for one, other in zip(found, poses, strict=True)
            )

        until(is_pulled, "the poses that the fixes say")
        found = call(ListDecisions, "list_decisions")
    assert found.earth_frame == "harbour"
    metres, radians = transform2d_from_msg(found.t_earth_map, "pose").distance_to(
        expected.T_earth_map
    )
    assert (metres, radians) == (pytest.approx(0.0, abs=1e-6), pytest.approx(0.0, abs=1e-6))


def test_latitude_and_longitude_place_the_map_in_utm(manage, monkeypatch):  # noqa: F811
    monkeypatch.setattr(fix_inputs, "_PERIOD_S", 0.2)
    settings = {"fix_topics": ["auv_1/gps/fix"], "fix_sigma_m": 1.0} | FAST
    with manage(has_server=False, **settings) as (until, probe, call):
        sender = probe.node.create_publisher(NavSatFix, "/auv_1/gps/fix", 10)
        until(lambda: sender.get_subscription_count() == 1, "the manager at the topic")
        probe.send(submap(0))
        probe.send(submap(1))
        for time_s, latitude in ((3, 54.0), (17, 54.0 + 14.0 / 111_300.0)):
            msg = NavSatFix(latitude=latitude, longitude=9.0)
            msg.header.stamp.sec = time_s
            msg.status.status = msg.status.STATUS_FIX
            sender.publish(msg)
        until(
            lambda: any("2 submaps have position fixes" in s.message for s in probe.statuses),
            "the fixes",
        )
        listed = call(ListDecisions, "list_decisions")
        found = transform2d_from_msg(listed.t_earth_map, "pose")
    assert listed.earth_frame == "EPSG:32632"
    assert found.yaw == pytest.approx(0.5 * math.pi, abs=0.01), "northwards"
    assert found.x == pytest.approx(500_000.0, abs=0.5), "on the zone's meridian"


def test_topics_of_fixes_need_a_standard_deviation(ros_context):
    settings = [Parameter("fix_topics", value=["/auv_1/usbl"])]
    with pytest.raises(ConfigError, match=r"fix_sigma_m is 0\.0, expected metres > 0"):
        MapQueueManager(context=ros_context, parameter_overrides=settings)
    assert rclpy.ok(context=ros_context)
