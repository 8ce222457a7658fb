"""Where instruments sit: which frame is the body's, and what is done about frames not known."""

import numpy as np
import pytest

from uw_dslam_ros2.core.sonar import SonarImage
from uw_dslam_ros2.io.mountings import Mountings, base_frame_of, usual_mounting
from uw_dslam_ros2.io.readings import ImageEvent, PointsEvent, TransformEvent, VelocityEvent

OFFSET = np.array(
    [[0.0, -1.0, 0.0, 0.4], [1.0, 0.0, 0.0, 0.1], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)


@pytest.mark.parametrize(
    ("links", "expected"),
    [
        ([("auv_1/base_link", "auv_1/sonar"), ("base_link", "x")], "auv_1/base_link"),
        ([("rov/base_link", "rov/sonar")], "rov/base_link"),
        ([("base_footprint", "auv_1/sonar"), ("base_footprint", "auv_1/dvl")], "base_footprint"),
        ([("/odom", "/body"), ("/body", "/sonar_mount"), ("/sonar_mount", "/sonar")], "body"),
        ([("map_ned", "map"), ("map", "odom"), ("odom", "hull"), ("hull", "dvl")], "hull"),
        ([("auv_1/body", "auv_1/sonar"), ("auv_2/body", "auv_2/sonar")], "auv_1/body"),
        ([("body_a", "sonar"), ("body_b", "dvl")], "auv_1/base_link"),  # it cannot be known
        ([], "auv_1/base_link"),
    ],
)
def test_the_body_is_what_instruments_hang_from(links, expected):
    assert base_frame_of(links, "auv_1") == expected


def points(frame_id):
    return PointsEvent("auv_1", 0, frame_id, np.ones((1, 2)))


def mounted(*frames):
    mountings = Mountings("auv_1/base_link")
    for frame_id in frames:
        mountings.add(TransformEvent("auv_1", 0, "auv_1/base_link", frame_id, OFFSET))
    return mountings


@pytest.mark.parametrize("frame_id", ["", "oculus_link", "auv_1/sonar_lnk"])
def test_a_frame_not_known_is_that_of_the_only_sonar(frame_id):
    mountings = mounted("auv_1/sonar_link", "auv_1/dvl")
    np.testing.assert_array_equal(mountings.of(points(frame_id)), OFFSET)
    (finding,) = mountings.findings("auv_1")
    assert "'auv_1/sonar_link'" in finding.detail
    assert finding.severity == ("warning" if frame_id else "info")
    assert not mountings.unknown
    assert mountings.is_known(points(frame_id))


@pytest.mark.parametrize("others", [(), ("auv_1/camera",), ("auv_1/sonar", "auv_1/oculus")])
def test_of_none_or_two_nothing_is_guessed(others):
    mountings = mounted(*others)
    np.testing.assert_array_equal(mountings.of(points("fls_link")), np.eye(4))
    assert mountings.unknown == {"fls_link": "sonar"}


def test_every_instrument_takes_its_own():
    mountings = mounted("auv_1/sonar")
    down = VelocityEvent("auv_1", 0, "", np.zeros(3), None, is_z_down=True)
    np.testing.assert_array_equal(mountings.of(down), usual_mounting(down))
    image = SonarImage(0, np.zeros((2, 2), np.uint8), np.array([1.0, 2.0]), np.array([0.1, 0.0]))
    np.testing.assert_array_equal(mountings.of(ImageEvent("auv_1", 0, "", image)), OFFSET)


def test_points_in_the_frame_of_an_odometry_are_told():
    mountings = mounted("auv_1/sonar")
    mountings.of(points("auv_1/odom"))
    (finding,) = mountings.findings("auv_1")
    assert finding.severity == "warning"
    assert "'auv_1/odom' is not the vehicle's" in finding.detail


def turned_by(angle_rad):
    T = np.eye(4)
    T[:2, :2] = [[np.cos(angle_rad), -np.sin(angle_rad)], [np.sin(angle_rad), np.cos(angle_rad)]]
    return T


@pytest.mark.parametrize(("step_rad", "is_told"), [(0.0, False), (0.005, True)])
def test_a_mounting_that_moves_bit_by_bit_is_told(step_rad, is_told):
    mountings = Mountings("auv_1/base_link")
    for k in range(100):
        pan = turned_by(k * step_rad)
        mountings.add(TransformEvent("auv_1", k, "auv_1/base_link", "auv_1/pan", pan))
        mountings.add(TransformEvent("auv_1", k, "auv_1/pan", "auv_1/sonar", np.eye(4)))
        # The vehicle's own motion, and a camera's, are no concern of the sonar's.
        mountings.add(TransformEvent("auv_1", k, "odom", "auv_1/base_link", turned_by(0.1 * k)))
        mountings.add(TransformEvent("auv_1", k, "auv_1/base_link", "camera", turned_by(0.1 * k)))
    mountings.of(points("auv_1/sonar"))
    found = mountings.findings("auv_1")
    assert [f.kind for f in found] == ["mounting_moves"] * is_told
    assert all("differ by up to 28 degrees" in f.detail for f in found)


def test_two_vehicles_on_one_topic_are_told():
    def kinds(*frames):
        mountings = mounted("auv_1/sonar", "auv_1/sonar_up")
        for frame_id in frames:
            mountings.of(points(frame_id))
        return [f.kind for f in mountings.findings("auv_1")]

    assert "several_frames" in kinds(*["auv_1/sonar", "auv_2/sonar"] * 20)
    # One that was set up anew, and two whose places are known.
    assert "several_frames" not in kinds(*["auv_1/sonar"] * 20, *["auv_2/sonar"] * 20)
    assert not kinds(*["auv_1/sonar", "auv_1/sonar_up"] * 20)
