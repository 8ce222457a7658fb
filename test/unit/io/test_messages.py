import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from unit.io.bag_messages import sonar_image

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.io import messages
from uw_dslam_ros2.io.interfaces import make_typestore
from uw_dslam_ros2.io.outgoing import MessageFactory
from uw_dslam_ros2.io.readings import FixEvent, ImuEvent, VelocityEvent


@pytest.fixture(scope="module")
def make():
    return MessageFactory(make_typestore())


def test_a_beam_to_port_has_positive_bearing(make):
    # The message's y axis points to starboard: literal numbers, not a round trip.
    msg = make.sonar_image("sonar", sonar_image(num_beams=2))
    s, c = math.sin(math.radians(30)), math.cos(math.radians(30))
    msg = replace(msg, beam_directions=[make.vector(0, -s, c), make.vector(0, s, c)])
    image = messages.sonar_image_of(msg)
    np.testing.assert_allclose(np.degrees(image.bearing_rad), [30.0, -30.0])


@pytest.mark.parametrize("dtype", ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "f4", "f8"])
@pytest.mark.parametrize("is_bigendian", [False, True])
def test_every_pixel_type_and_byte_order(make, dtype, is_bigendian):
    msg = make.sonar_image("sonar", sonar_image(dtype=np.dtype(dtype)))
    data = np.arange(15).astype((">" if is_bigendian else "<") + dtype)
    msg = replace(
        msg, image=replace(msg.image, is_bigendian=is_bigendian, data=data.view(np.uint8))
    )
    image = messages.sonar_image_of(msg)
    assert image.intensity.dtype == np.dtype(dtype)
    np.testing.assert_array_equal(image.intensity, np.arange(15).reshape(5, 3))


def test_both_data_orders(make):
    msg = make.sonar_image("sonar", sonar_image())
    by_range = messages.sonar_image_of(msg)
    assert by_range.intensity[0].tolist() == [0, 1, 2]
    by_beam = messages.sonar_image_of(msg, "beam_major")
    assert by_beam.intensity[:, 0].tolist() == [0, 1, 2, 3, 4]
    swapped = make.sonar_image("sonar", sonar_image(), data_order="beam_major")
    again = messages.sonar_image_of(swapped, "beam_major")
    np.testing.assert_array_equal(again.intensity, by_range.intensity)


def test_wrong_lengths_are_named(make):
    msg = make.sonar_image("sonar", sonar_image())
    short = replace(msg, image=replace(msg.image, data=msg.image.data[:-1]))
    with pytest.raises(InvalidInputError, match=r"image\.data has 14 bytes, expected 15"):
        messages.sonar_image_of(short)
    fewer = replace(msg, beam_directions=msg.beam_directions[:-1])
    with pytest.raises(InvalidInputError, match=r"beam_directions has 2 entries.* 3"):
        messages.sonar_image_of(fewer)
    with pytest.raises(InvalidInputError, match=r"image\.dtype is 11"):
        messages.sonar_image_of(replace(msg, image=replace(msg.image, dtype=11)))
    with pytest.raises(InvalidInputError, match="not finite and rising"):
        messages.sonar_image_of(replace(msg, ranges=msg.ranges[::-1]))


def test_dvl_frame_has_starboard_y(make):
    msg = make.dvl(0, "dvl", (1.0, 0.25), 1e-4, 3.0)
    assert (msg.velocity.x, msg.velocity.y) == (1.0, -0.25)
    msg.velocity_covar[1] = msg.velocity_covar[3] = 2e-5
    velocity, covariance = messages.velocity_of_dvl(msg)
    event = VelocityEvent("auv_1", 0, "dvl", velocity, covariance, is_z_down=True)
    velocity, covariance = event.horizontal()
    assert velocity.tolist() == [1.0, 0.25]
    np.testing.assert_allclose(covariance, [[1e-4, -2e-5], [-2e-5, 1e-4]])


def test_dvl_without_velocity_over_ground(make):
    msg = make.dvl(0, "dvl", (1.0, 0.25), 1e-4, 3.0)
    assert messages.velocity_of_dvl(replace(msg, velocity_mode=2)) is None
    assert messages.velocity_of_dvl(replace(msg, num_good_beams=2)) is None
    assert messages.velocity_of_dvl(replace(msg, num_good_beams=0)) is not None
    assert messages.velocity_of_dvl(replace(msg, velocity=make.vector(math.nan, 0, 0))) is None
    unknown = replace(msg, velocity_covar=np.full(9, -1.0))
    assert messages.velocity_of_dvl(unknown)[1] is None


def test_imu_says_what_it_lacks(make):
    msg = make.imu(0, "imu", 2.5, 0.01, 0.5, 1e-6)
    orientation, variance, rates = messages.readings_of_imu(msg)
    assert (variance, rates.tolist()) == (pytest.approx(0.01), [0.0, 0.0, 0.5])
    event = ImuEvent("auv_1", 0, "imu", orientation, variance, rates)
    assert (event.yaw_rad, event.yaw_rate_rad_s) == pytest.approx((2.5, 0.5))
    no_orientation = make.imu(0, "imu", None, 0.01, 0.5, 1e-6)
    assert messages.readings_of_imu(no_orientation)[:2] == (None, None)
    no_rate = make.imu(0, "imu", 2.5, 0.01, None, 1e-6)
    assert messages.readings_of_imu(no_rate)[2] is None
    zero = replace(msg, orientation=make.quaternion((0, 0, 0, 0)))
    assert messages.readings_of_imu(zero)[0] is None
    bad = replace(msg, orientation=make.quaternion((0, 0, 0, 2)))
    with pytest.raises(InvalidInputError, match="quaternion"):
        messages.readings_of_imu(bad)


def test_depth_of_ten_metres_of_sea_water():
    # 1025 kg/m^3 * 9.80665 m/s^2 * 10 m on top of one atmosphere.
    msg = SimpleNamespace(fluid_pressure=101325.0 + 100518.1625)
    assert messages.depth_of_pressure(msg) == pytest.approx(10.0)


def test_scan_keeps_inf_and_drops_what_is_too_near():
    msg = SimpleNamespace(
        angle_min=-0.5,
        angle_increment=0.25,
        range_min=0.3,
        range_max=20.0,
        ranges=np.array([0.1, 5.0, np.inf, np.nan], np.float32),
    )
    angles, ranges, range_max = messages.scan_of_laser_scan(msg)
    assert angles.tolist() == [-0.5, -0.25, 0.0, 0.25]
    np.testing.assert_array_equal(ranges, [np.nan, 5.0, np.inf, np.nan])
    assert range_max == 20.0


def test_cloud_with_padding_and_nan(make):
    msg = make.points(0, "sonar", [[1.0, -2.0], [np.nan, 0.0], [3.0, 4.0]])
    assert messages.points_of_cloud(msg).tolist() == [[1.0, -2.0], [3.0, 4.0]]
    rows = np.zeros((3, 20), np.uint8)
    rows[:, 4:16] = np.asarray(msg.data).reshape(3, 12)
    for field in msg.fields:
        field.offset += 4
    padded = replace(msg, point_step=20, row_step=60, data=rows.reshape(-1))
    assert messages.points_of_cloud(padded).tolist() == [[1.0, -2.0], [3.0, 4.0]]
    with pytest.raises(InvalidInputError, match="data has 59 bytes"):
        messages.points_of_cloud(replace(padded, data=rows.reshape(-1)[:-1]))
    with pytest.raises(InvalidInputError, match="no field 'y'"):
        messages.points_of_cloud(replace(msg, fields=msg.fields[:1]))


def test_empty_cloud(make):
    assert messages.points_of_cloud(make.points(0, "sonar", np.empty((0, 2)))).shape == (0, 2)


def test_a_satellite_fix_becomes_metres_east_and_north():
    # One arc second of latitude is 30.9 m, one of longitude 30.9 m times cos(60 degrees).
    fix = FixEvent("auv_1", 0, "gps", np.array([60.0, 10.0]) + 1.0 / 3600.0, None, True)
    np.testing.assert_allclose(fix.position_m((60.0, 10.0)), [15.5, 30.95], atol=0.05)
    acoustic = FixEvent("auv_1", 0, "map", np.array([3.0, 4.0]), None)
    assert acoustic.position_m((60.0, 10.0)).tolist() == [3.0, 4.0]
