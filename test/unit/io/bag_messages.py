"""Hand-made messages for the bag tests."""

import numpy as np

from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar.types import SonarImage

SECOND = 1_000_000_000


def sonar_image(stamp_ns=SECOND, dtype=np.uint8, num_ranges=5, num_beams=3):
    """An asymmetric image with uneven bearings, port first."""
    pixels = np.arange(num_ranges * num_beams, dtype=dtype).reshape(num_ranges, num_beams)
    ranges = 1.0 + 0.5 * np.arange(num_ranges)
    return SonarImage(stamp_ns, pixels, ranges, np.linspace(1.0, -0.7, num_beams) ** 3)


def write_vehicle(writer, messages, vehicle="auv_1", first_s=10):
    """One of everything, a second apart, on the topics of one vehicle."""
    stamps = [(first_s + i) * SECOND for i in range(8)]
    writer.add_topic("/tf_static", "tf2_msgs/msg/TFMessage", is_latched=True)
    types = {
        "sonar": "marine_acoustic_msgs/msg/ProjectedSonarImage",
        "imu": "sensor_msgs/msg/Imu",
        "dvl": "marine_acoustic_msgs/msg/Dvl",
        "velocity": "geometry_msgs/msg/TwistWithCovarianceStamped",
        "depth": "sensor_msgs/msg/FluidPressure",
        "points": "sensor_msgs/msg/PointCloud2",
        "truth/odom": "nav_msgs/msg/Odometry",
    }
    for name, msgtype in types.items():
        writer.add_topic(f"/{vehicle}/{name}", msgtype)
    base = f"{vehicle}/base_link"
    contents = [
        ("sonar", messages.sonar_image(f"{vehicle}/sonar", sonar_image(stamps[0]))),
        ("imu", messages.imu(stamps[1], base, 0.5, 0.01, -0.25, 1e-6)),
        ("dvl", messages.dvl(stamps[2], f"{vehicle}/dvl", (1.0, 0.25), 1e-4, 3.0)),
        ("dvl", messages.dvl(stamps[3], f"{vehicle}/dvl", None, 1e-4, 3.0)),
        ("velocity", messages.twist(stamps[4], base, (1.0, 0.25), 0.1, np.eye(6))),
        ("depth", messages.pressure(stamps[5], base, 2.5, 0.01)),
        ("points", messages.points(stamps[6], base, [[1.0, -2.0], [3.5, 4.25]])),
        (
            "truth/odom",
            messages.odometry(stamps[7], "map", base, SE2(1.0, 2.0, 3.0), 2.5, (1.0, 0.0), 0.1),
        ),
    ]
    for stamp_ns, (name, content) in zip(stamps, contents, strict=True):
        writer.write(f"/{vehicle}/{name}", stamp_ns, content)
    mount = messages.transforms(
        stamps[0], base, [(f"{vehicle}/dvl", (0.1, 0.2, -0.3), (1.0, 0.0, 0.0, 0.0))]
    )
    # Recorded last on purpose: readers must hand it out first.
    writer.write("/tf_static", stamps[7], mount)
