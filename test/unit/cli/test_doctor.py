"""``doctor`` names what is wrong with a recording, and writes settings by which it comes right."""

import json
import math
import re

import numpy as np
import pytest

from uw_dslam_ros2.cli.doctor import main
from uw_dslam_ros2.cli.running.mapping import sensor_config
from uw_dslam_ros2.core.conventions import Conventions
from uw_dslam_ros2.core.sonar import SonarImage
from uw_dslam_ros2.io.outgoing import MessageFactory
from uw_dslam_ros2.io.recordings import BagWriter
from uw_dslam_ros2.io.settings import SettingsFile

SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """An IMU that turns but whose orientation is never filled, and a DVL without bottom lock."""
    path = tmp_path_factory.mktemp("recordings") / "auv_1"
    with BagWriter(path) as writer:
        make = MessageFactory(writer.typestore)
        writer.add_topic("/auv_1/imu", "sensor_msgs/msg/Imu")
        writer.add_topic("/auv_1/dvl", "geometry_msgs/msg/TwistWithCovarianceStamped")
        for k in range(600):
            stamp_ns = 1000 * SECOND + k * SECOND // 10
            rate = 0.3 * math.sin(0.02 * k)
            writer.write("/auv_1/imu", stamp_ns, make.imu(stamp_ns, "", 0.0, 0.0, rate, 1e-6))
            types = writer.typestore.types
            measured = 0.8 + 0.01 * math.sin(k)  # a measurement never repeats to the last digit
            linear = types["geometry_msgs/msg/Vector3"](
                x=0.0 if 200 < k < 300 else measured, y=0.0, z=0.0
            )
            twist = types["geometry_msgs/msg/Twist"](
                linear=linear, angular=types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
            )
            header = make.imu(stamp_ns, "", 0.0, 0.0, rate, 1e-6).header
            message = types["geometry_msgs/msg/TwistWithCovarianceStamped"](
                header=header,
                twist=types["geometry_msgs/msg/TwistWithCovariance"](
                    twist=twist, covariance=np.zeros(36)
                ),
            )
            writer.write("/auv_1/dvl", stamp_ns, message)
    return path


def test_bad_messages_are_counted_among_those_that_were_looked_at(tmp_path, capsys):
    with BagWriter(tmp_path / "auv_1") as writer:
        make = MessageFactory(writer.typestore)
        writer.add_topic("/auv_1/imu", "sensor_msgs/msg/Imu")
        writer.add_topic("/auv_1/sonar", "marine_acoustic_msgs/msg/ProjectedSonarImage")
        for k in range(4000):
            stamp_ns = 1000 * SECOND + k * SECOND // 10
            writer.write("/auv_1/imu", stamp_ns, make.imu(stamp_ns, "", 0.01 * k, 0.0, 0.1, 1e-6))
            image = SonarImage(
                stamp_ns,
                np.zeros((4, 3), np.uint8),
                np.arange(1.0, 5.0),
                np.array([0.3, 0.0, -0.3]),
            )
            message = make.sonar_image("", image)
            message.ranges = np.full(4, np.nan, np.float32)
            writer.write("/auv_1/sonar", stamp_ns, message)
    assert main([str(tmp_path / "auv_1"), "--out", str(tmp_path / "out")]) == 0
    out = capsys.readouterr().out
    (line,) = (text for text in out.splitlines() if "malformed" in text)
    num_bad, num_read = re.search(r"(\d+) of (\d+) messages are malformed", line).groups()
    assert num_bad == num_read
    assert int(num_read) < 200


def test_what_is_wrong_is_told_and_mended(bag, tmp_path, capsys):
    assert main([str(bag), "--out", str(tmp_path / "first")]) == 0
    report = json.loads((tmp_path / "first" / "doctor.json").read_text())
    kinds = [finding["kind"] for finding in report["findings"]]
    assert kinds == ["imu_no_orientation", "dvl_zero_without_lock", "no_sonar"]
    assert {stream["role"] for stream in report["vehicles"][0]["streams"]} == {"imu", "velocity"}
    out = capsys.readouterr().out
    assert "auv_1 imu: its orientation never changes" in out
    page = (tmp_path / "first" / "doctor.html").read_text()
    assert "imu_no_orientation" in page

    settings = tmp_path / "first" / "settings.yaml"
    conventions = sensor_config(SettingsFile(settings), "auv_1").conventions
    assert conventions == Conventions(imu_orientation="none", velocity_zero_is_invalid=True)
    assert main([str(bag), "--out", str(tmp_path / "second"), "--config", str(settings)]) == 0
    report = json.loads((tmp_path / "second" / "doctor.json").read_text())
    # With the orientation left out, the heading is what the rates make of it.
    assert [f["kind"] for f in report["findings"]] == ["no_sonar", "no_heading"]


def test_a_bag_that_is_not_there_is_bad_input(tmp_path, capsys):
    assert main([str(tmp_path / "nothing"), "--out", str(tmp_path / "out")]) == 2
    assert "nothing" in capsys.readouterr().err


def test_what_reading_notices_is_told_too(tmp_path):
    rng = np.random.default_rng(0)
    path = tmp_path / "auv_1"
    with BagWriter(path) as writer:
        make = MessageFactory(writer.typestore)
        writer.add_topic("/auv_1/imu", "sensor_msgs/msg/Imu")
        writer.add_topic("/auv_1/sonar", "marine_acoustic_msgs/msg/ProjectedSonarImage")
        for k in range(300):
            stamp_ns = 1000 * SECOND + k * SECOND // 10
            writer.write("/auv_1/imu", stamp_ns, make.imu(stamp_ns, "", 0.01 * k, 0.0, 0.1, 1e-6))
            if k % 10 == 0:
                smooth = np.sort(rng.integers(0, 255, (40, 30)), axis=0).astype(np.uint16)
                image = SonarImage(
                    stamp_ns, (smooth * 256 + 17).byteswap(), np.arange(1.0, 41.0),
                    np.linspace(0.8, -0.8, 30),
                )  # fmt: skip
                writer.write("/auv_1/sonar", stamp_ns, make.sonar_image("head", image))
    assert main([str(path), "--out", str(tmp_path / "out")]) == 0
    report = json.loads((tmp_path / "out" / "doctor.json").read_text())
    kinds = {finding["kind"] for finding in report["findings"]}
    assert {"sonar_byte_order", "no_mounting", "no_velocity", "cannot_tell"} <= kinds
    assert all(finding["vehicle_id"] == "auv_1" for finding in report["findings"])
