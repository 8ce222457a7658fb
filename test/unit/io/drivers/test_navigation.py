"""Velocities, orientations, depths, poses and fixes."""

import math
from dataclasses import replace
from types import SimpleNamespace as Msg

import numpy as np
import pytest
from unit.io.drivers.messages import STAMP_NS, header, pose, quaternion, vector

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.io.drivers import ADAPTERS, ReadSettings, adapter_of
from uw_dslam_ros2.io.readings import DepthEvent, FixEvent, PoseEvent, VelocityEvent

SETTINGS = ReadSettings(vehicle_id="auv_1")
NAN = math.nan


def read(msgtype, msg, **settings):
    return adapter_of(msgtype).read(msg, replace(SETTINGS, memory={}, **settings))


DVL = "marine_acoustic_msgs/msg/Dvl"


def dvl(**changes):
    fields = {
        "header": header("dvl"),
        "velocity_mode": 1,
        "dvl_type": 0,
        "velocity": vector(1.0, -0.25, 0.1),
        "velocity_covar": np.diag([1e-4, 2e-4, 3e-4]).reshape(-1),
        "altitude": 3.0,
        "course_gnd": 0.0,
        "speed_gnd": 1.0,
        "num_good_beams": 4,
        "sound_speed": 1500.0,
        "beam_ranges_valid": False,
        "beam_velocities_valid": False,
        "beam_unit_vec": [vector(0, 0, 0)] * 4,
        "range": np.zeros(4),
        "range_covar": np.zeros(4),
        "beam_quality": np.zeros(4),
        "beam_velocity": np.zeros(4),
        "beam_velocity_covar": np.full(4, -1.0),
    }
    return Msg(**fields | changes)


def test_dvl_has_starboard_y():
    (event,) = read(DVL, dvl())
    assert (event.vehicle_id, event.stamp_ns, event.frame_id) == ("auv_1", STAMP_NS, "dvl")
    assert event.is_z_down
    assert event.velocity_m_s.tolist() == [1.0, -0.25, 0.1]
    assert event.horizontal()[0].tolist() == [1.0, 0.25]
    np.testing.assert_allclose(event.covariance, np.diag([1e-4, 2e-4, 3e-4]))
    (event,) = read(DVL, dvl(velocity_covar=np.full(9, -1.0), velocity=vector(1.0, 0.0, NAN)))
    assert event.covariance is None
    assert event.velocity_m_s.tolist() == [1.0, 0.0, 0.0]


@pytest.mark.parametrize(
    "changes",
    [
        {"velocity_mode": 2},
        {"num_good_beams": 2},
        {"velocity": vector(NAN, NAN, NAN)},
        {"velocity": vector(0, 0, 0), "altitude": -1.0},
        {"velocity": vector(0, 0, 0), "altitude": NAN},
        {"velocity": vector(0, 0, 0), "velocity_covar": np.full(9, -1.0)},
        {"velocity": vector(0, 0, 0), "num_good_beams": 0},
        # waterlinked_dvl: ranges are always valid, the lock is in beam_velocities_valid.
        {"num_good_beams": 0, "beam_ranges_valid": True},
        {"num_good_beams": 3, "beam_ranges_valid": True, "beam_velocity": np.full(4, 0.3)},
    ],
)
def test_dvl_without_bottom_lock(changes):
    assert read(DVL, dvl(**changes)) == ()


@pytest.mark.parametrize(
    "changes",
    [
        {"num_good_beams": 0},  # never counted by this driver
        {"velocity": vector(0, 0, 0)},  # at rest
        {"beam_ranges_valid": True},  # ranges, and velocities already solved
        {"num_good_beams": 3, "beam_ranges_valid": True, "beam_velocities_valid": True},
    ],
)
def test_dvl_with_bottom_lock(changes):
    assert len(read(DVL, dvl(**changes))) == 1


@pytest.mark.parametrize("num_beams", [3, 4])
@pytest.mark.parametrize("missing", [0.0, NAN])
def test_beams_alone_are_solved(num_beams, missing):
    velocity = np.array([1.0, -0.25, 0.1])
    tilt, azimuths = np.radians(30.0), np.radians([45.0, 135.0, 225.0, 315.0])
    directions = np.column_stack(
        [
            np.sin(tilt) * np.cos(azimuths),
            np.sin(tilt) * np.sin(azimuths),
            np.full(4, np.cos(tilt)),
        ]
    )
    speeds = directions @ velocity
    speeds[num_beams:] = NAN
    msg = dvl(
        velocity=vector(missing, missing, missing),
        num_good_beams=num_beams,
        beam_velocities_valid=True,
        beam_unit_vec=[vector(*d) for d in directions],
        beam_velocity=speeds,
    )
    (event,) = read(DVL, msg)
    np.testing.assert_allclose(event.velocity_m_s, velocity, atol=1e-9)
    msg.beam_unit_vec = [vector(0, 0, 0)] * 4
    assert len(read(DVL, msg)) == (missing == 0.0)  # zeros beside a lock and an altitude


def waterlinked(**changes):
    fields = {
        "header": header("dvl_link"),
        "time": 100.0,
        "velocity": vector(1.0, -0.25, 0.1),
        "fom": 0.02,
        "altitude": 3.0,
        "beams": [],
        "velocity_valid": True,
        "status": 0,
        "form": "json_v3",
    }
    return Msg(**fields | changes)


@pytest.mark.parametrize("package", ["dvl_msgs", "waterlinked_a50_ros_driver"])
def test_water_linked(package):
    name = f"{package}/msg/DVL"
    (event,) = read(name, waterlinked())
    assert event.horizontal()[0].tolist() == [1.0, 0.25]
    np.testing.assert_allclose(event.covariance, 4e-4 * np.eye(3))
    assert read(name, waterlinked(velocity_valid=False, velocity=vector(0, 0, 0))) == ()
    assert read(name, waterlinked(velocity=vector(NAN, 0, 0))) == ()
    assert read(name, waterlinked(fom=NAN))[0].covariance is None


def test_simulated_dvl():
    msg = Msg(
        header=header("dvl"),
        velocity=vector(1.0, -0.25, 0.0),
        velocity_covariance=np.diag([1e-4] * 3).reshape(-1),
        altitude=3.0,
        beams=[],
    )
    (event,) = read("cola2_msgs/msg/DVL", msg)
    assert event.horizontal()[0].tolist() == [1.0, 0.25]
    msg.velocity_covariance = np.full(9, -1.0)
    assert read("cola2_msgs/msg/DVL", msg) == ()


def nucleus(**changes):
    fields = {f"{axis}_velocity_valid": True for axis in "xyz"}
    fields |= {f"{axis}_fom_valid": True for axis in "xyz"}
    fields |= {f"fom_{axis}": 0.01 for axis in "xyz"}
    fields |= {"velocity_x": 1.0, "velocity_y": -0.25, "velocity_z": 0.1, "timestamp": 5}
    return Msg(**fields | changes)


def test_nucleus_has_no_header():
    name = "interfaces/msg/BottomTrack"
    (event,) = read(name, nucleus())
    assert (event.stamp_ns, event.frame_id, event.is_z_down) == (0, "", True)
    assert event.velocity_m_s.tolist() == [1.0, -0.25, 0.1]
    np.testing.assert_allclose(event.covariance, 1e-4 * np.eye(3))
    assert read(name, nucleus(z_velocity_valid=False))[0].velocity_m_s[2] == 0.0
    assert read(name, nucleus(x_velocity_valid=False)) == ()
    assert read(name, nucleus(velocity_y=-32.768)) == ()


def twist(x=1.0, y=0.25, z=0.0):
    return Msg(linear=vector(x, y, z), angular=vector(0, 0, 0))


def test_twists_have_port_y():
    covariance = np.zeros((6, 6))
    covariance[0, 0], covariance[1, 1], covariance[0, 1] = 1e-4, 2e-4, 1e-5
    full = Msg(twist=twist(), covariance=covariance.reshape(-1))
    messages = {
        "TwistWithCovarianceStamped": Msg(header=header("dvl"), twist=full),
        "TwistStamped": Msg(header=header("dvl"), twist=twist()),
        "Twist": twist(),
    }
    for name, msg in messages.items():
        (event,) = read(f"geometry_msgs/msg/{name}", msg)
        assert not event.is_z_down
        assert event.horizontal()[0].tolist() == [1.0, 0.25]
        assert (event.covariance is None) == (name != "TwistWithCovarianceStamped")
    name = "geometry_msgs/msg/TwistWithCovarianceStamped"
    assert read(name, messages["TwistWithCovarianceStamped"])[0].covariance[0, 1] == 1e-5
    full.covariance = np.full(36, -1.0)
    assert read(name, messages["TwistWithCovarianceStamped"]) == ()
    assert read("geometry_msgs/msg/Twist", twist(x=NAN)) == ()
    with pytest.raises(InvalidInputError, match=r"twist\.linear is"):
        read("geometry_msgs/msg/Twist", twist(x=math.inf))


def imu(**changes):
    fields = {
        "header": header("imu"),
        "orientation": quaternion(0, 0, math.sin(1.0), math.cos(1.0)),
        "orientation_covariance": np.diag([1e-4, 1e-4, 0.01]).reshape(-1),
        "angular_velocity": vector(0.1, -0.2, 0.5),
        "angular_velocity_covariance": np.zeros(9),
        "linear_acceleration": vector(0, 0, 9.8),
        "linear_acceleration_covariance": np.zeros(9),
    }
    return Msg(**fields | changes)


IMU = "sensor_msgs/msg/Imu"
NONE = np.array([-1.0] + [0.0] * 8)


def test_imu_keeps_all_three_axes():
    (event,) = read(IMU, imu())
    assert (event.yaw_rad, event.yaw_rate_rad_s) == pytest.approx((2.0, 0.5))
    assert event.yaw_variance == pytest.approx(0.01)
    assert event.angular_velocity_rad_s.tolist() == [0.1, -0.2, 0.5]


@pytest.mark.parametrize(
    "changes",
    [
        {"orientation_covariance": NONE},
        {"orientation": quaternion(0, 0, 0, 0)},
        {"orientation": quaternion(NAN, NAN, NAN, NAN)},
    ],
)
def test_imu_without_orientation(changes):
    (event,) = read(IMU, imu(**changes))
    assert (event.orientation_xyzw, event.yaw_variance, event.yaw_rad) == (None, None, None)
    assert event.yaw_rate_rad_s == 0.5


def test_imu_without_rates_or_with_nothing():
    for changes in (
        {"angular_velocity_covariance": NONE},
        {"angular_velocity": vector(NAN, NAN, NAN)},
    ):
        (event,) = read(IMU, imu(**changes))
        assert event.angular_velocity_rad_s is None
        assert event.yaw_rad == pytest.approx(2.0)
        assert read(IMU, imu(orientation_covariance=NONE, **changes)) == ()


def test_quaternions_of_another_scale_are_read_and_those_of_any_norm_are_not():
    told = []
    settings = replace(SETTINGS, role="imu", memory={}, tell=told.append)
    adapter = adapter_of(IMU)
    for yaw in (0.4, -2.0):
        q = quaternion(0, 0, 0.5 * math.sin(yaw / 2), 0.5 * math.cos(yaw / 2))
        (event,) = adapter.read(imu(orientation=q), settings)
        assert event.yaw_rad == pytest.approx(yaw)
    assert [f.kind for f in told] == ["imu_quaternion_norm"]
    with pytest.raises(InvalidInputError, match="quaternion"):
        adapter.read(imu(orientation=quaternion(0, 0, 0, 0.7)), settings)


PRESSURE = "sensor_msgs/msg/FluidPressure"
# 1025 kg/m^3 * 9.80665 m/s^2 * 10 m.
TEN_METRES_PA = 100518.1625


def pressure(value):
    return Msg(header=header("base"), fluid_pressure=value, variance=0.0)


@pytest.mark.parametrize(
    ("first", "value", "kind"),
    [
        (101325.0, 101325.0 + TEN_METRES_PA, None),
        (0.0, TEN_METRES_PA, "depth_gauge"),  # ten metres of it look absolute
        (-300.0, TEN_METRES_PA, "depth_gauge"),
        (1013.25, 1013.25 + TEN_METRES_PA / 100.0, "depth_mbar"),
        (101.325, 101.325 + TEN_METRES_PA / 1000.0, "depth_kpa"),
        (1.01325, 1.01325 + TEN_METRES_PA / 1e5, "depth_bar"),
    ],
)
def test_the_first_pressure_tells_the_convention(first, value, kind):
    told = []
    settings = replace(SETTINGS, memory={}, tell=told.append)
    adapter = adapter_of(PRESSURE)
    for _ in range(2):
        (start,) = adapter.read(pressure(first), settings)
        (deep,) = adapter.read(pressure(value), settings)
    assert abs(start.depth_m) < 0.05
    assert deep.depth_m == pytest.approx(10.0)
    assert [f.kind for f in told] == ([kind] if kind else [])


def test_pressure_as_set():
    assert read(PRESSURE, pressure(TEN_METRES_PA), pressure="gauge")[0].depth_m == (
        pytest.approx(10.0)
    )
    assert read(PRESSURE, pressure(1013.25), pressure="absolute")[0].depth_m < -9.0
    fresh = read(PRESSURE, pressure(101325.0 + 98066.5), water_density_kg_m3=1000.0)
    assert fresh[0].depth_m == pytest.approx(10.0)
    with pytest.raises(InvalidInputError, match="fluid_pressure is nan"):
        read(PRESSURE, pressure(NAN))


def test_depth_as_a_number():
    for name in ("std_msgs/msg/Float32", "std_msgs/msg/Float64"):
        for value in (2.5, -2.5):
            (event,) = read(name, Msg(data=value))
            assert (event.stamp_ns, event.frame_id, event.depth_m) == (0, "", 2.5)
        assert read(name, Msg(data=NAN)) == ()
        with pytest.raises(InvalidInputError, match="data is inf"):
            read(name, Msg(data=math.inf))


@pytest.mark.parametrize(("degrees", "yaw_deg"), [(0.0, 90.0), (90.0, 0.0), (300.0, 150.0)])
def test_a_heading_as_a_number_is_in_degrees_from_north(degrees, yaw_deg):
    for name in ("std_msgs/msg/Float32", "std_msgs/msg/Float64"):
        (event,) = read(name, Msg(data=degrees), role="imu")
        assert event.yaw_rad == pytest.approx(math.radians(yaw_deg))
        assert (event.stamp_ns, event.angular_velocity_rad_s) == (0, None)
        assert read(name, Msg(data=NAN), role="imu") == ()
        with pytest.raises(InvalidInputError, match="data is 1000"):
            read(name, Msg(data=1000.0), role="imu")


def with_covariance(diagonal, **kwargs):
    return Msg(pose=pose(**kwargs), covariance=np.diag(diagonal).reshape(-1))


def odometry(diagonal=(1, 2, 3, 4, 5, 6), velocity=(1.0, 0.25, 0.0), **kwargs):
    return Msg(
        header=header("odom"),
        child_frame_id="base_link",
        pose=with_covariance(diagonal, **kwargs),
        twist=Msg(
            twist=Msg(linear=vector(*velocity), angular=vector(0, 0, 0)), covariance=np.zeros(36)
        ),
    )


ODOMETRY = "nav_msgs/msg/Odometry"


def test_odometry_is_a_pose_with_a_velocity():
    (event,) = read(ODOMETRY, odometry(x=1.0, y=2.0, z=-3.0, yaw=0.5))
    assert isinstance(event, PoseEvent)
    assert (event.frame_id, event.child_frame_id) == ("odom", "base_link")
    assert event.T_frame_base.as_array() == pytest.approx([1.0, 2.0, 0.5])
    np.testing.assert_array_equal(event.covariance, np.diag([1, 2, 6]))
    assert event.velocity_m_s.tolist() == [1.0, 0.25, 0.0]
    (event,) = read(ODOMETRY, odometry(diagonal=[0] * 6, velocity=(0, 0, 0), x=1.0))
    assert (event.covariance, event.velocity_m_s) == (None, None)
    assert read(ODOMETRY, odometry(x=NAN)) == ()
    assert read(ODOMETRY, odometry(velocity=(0, 0, 0))) == ()  # nobody filled anything in
    bad = odometry(x=1.0)
    bad.pose.pose.orientation = quaternion(0, 0, 0, 0)
    with pytest.raises(InvalidInputError, match="quaternion"):
        read(ODOMETRY, bad)


def test_odometry_whose_pose_nobody_filled_in_is_a_velocity():
    (event,) = read(ODOMETRY, odometry())
    assert isinstance(event, VelocityEvent)
    assert (event.frame_id, event.is_z_down, event.covariance) == ("base_link", False, None)
    assert event.velocity_m_s.tolist() == [1.0, 0.25, 0.0]
    assert read(ODOMETRY, odometry(x=NAN)) == ()  # lost, not left out
    assert read(ODOMETRY, odometry(velocity=(NAN, 0.0, 0.0))) == ()


def test_the_same_type_as_depth_or_fix():
    (depth,) = read(ODOMETRY, odometry(z=-3.0), role="depth")
    assert isinstance(depth, DepthEvent)
    assert depth.depth_m == 3.0
    name = "geometry_msgs/msg/PoseWithCovarianceStamped"
    msg = Msg(header=header("map"), pose=with_covariance([1, 2, 3, 4, 5, 6], x=4.0, y=5.0, z=2.0))
    assert read(name, msg, role="depth")[0].depth_m == 2.0
    (fix,) = read(name, msg, role="fix")
    assert isinstance(fix, FixEvent)
    assert fix.position.tolist() == [4.0, 5.0]
    np.testing.assert_array_equal(fix.covariance, np.diag([1, 2]))
    (own,) = read(name, msg)
    assert isinstance(own, PoseEvent)
    msg.pose.pose.position.z = NAN
    assert read(name, msg, role="depth") == ()


def test_pose_stamped():
    msg = Msg(header=header("map"), pose=pose(x=1.0, y=2.0, yaw=-0.5))
    (event,) = read("geometry_msgs/msg/PoseStamped", msg)
    assert event.T_frame_base.as_array() == pytest.approx([1.0, 2.0, -0.5])
    assert event.covariance is None


def satellite(**changes):
    fields = {
        "header": header("gps"),
        "status": Msg(status=0, service=1),
        "latitude": 60.0,
        "longitude": 10.0,
        "altitude": 0.0,
        "position_covariance": np.diag([1.0, 2.0, 9.0]).reshape(-1),
        "position_covariance_type": 2,
    }
    return Msg(**fields | changes)


def test_satellite_fix():
    name = "sensor_msgs/msg/NavSatFix"
    (event,) = read(name, satellite())
    assert event.is_geodetic
    assert event.position.tolist() == [60.0, 10.0]
    np.testing.assert_array_equal(event.covariance, np.diag([1.0, 2.0]))
    assert read(name, satellite(position_covariance_type=0))[0].covariance is None
    assert read(name, satellite(status=Msg(status=-1, service=1))) == ()
    assert read(name, satellite(latitude=NAN)) == ()
    with pytest.raises(InvalidInputError, match="latitude, longitude are"):
        read(name, satellite(latitude=600.0))


def test_acoustic_fix():
    msg = Msg(header=header("map"), point=vector(1.0, 2.0, -3.0))
    (event,) = read("geometry_msgs/msg/PointStamped", msg)
    assert (event.position.tolist(), event.is_geodetic) == ([1.0, 2.0], False)
    assert (
        read("geometry_msgs/msg/PointStamped", Msg(header=header(), point=vector(NAN, 0, 0))) == ()
    )


def test_a_wrong_setting_is_named():
    with pytest.raises(InvalidInputError, match="data_order is 'columns'"):
        ReadSettings(data_order="columns")
    with pytest.raises(InvalidInputError, match="image_aperture_rad is -1"):
        ReadSettings(image_aperture_rad=-1.0)


def test_types_are_known_by_both_names():
    assert adapter_of("sensor_msgs/Imu") is ADAPTERS["sensor_msgs/msg/Imu"]
    assert adapter_of("sensor_msgs/msg/Joy") is None
