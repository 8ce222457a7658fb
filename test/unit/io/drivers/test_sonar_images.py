"""Sonars that see a fan at once. Every target lies to port, so that a mirrored one shows."""

from dataclasses import replace
from types import SimpleNamespace as Msg

import cv2
import numpy as np
import pytest
from unit.io.drivers.messages import STAMP_NS, header, image_data, target_at, vector

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.io.drivers import ReadSettings, adapter_of
from uw_dslam_ros2.io.drivers.pixels import without_pedestal

SETTINGS = ReadSettings(vehicle_id="auv_1")
PORT, STARBOARD = np.radians(30.0), np.radians(-30.0)


def read(msgtype, msg, settings=SETTINGS):
    if settings.memory is SETTINGS.memory:  # each message is the first of its topic
        settings = replace(settings, memory={})
    return adapter_of(msgtype).read(msg, settings)


def projected(directions, pixels, **image):
    return Msg(
        header=header(),
        ping_info=Msg(frequency=0.0, sound_speed=1500.0, tx_beamwidths=[], rx_beamwidths=[]),
        beam_directions=[vector(*d) for d in directions],
        ranges=np.arange(1.0, 1.0 + len(pixels), dtype=np.float32),
        image=image_data(pixels, len(directions), **image),
    )


def one_target(shape, row, column, dtype=np.uint8):
    pixels = np.ones(shape, dtype)
    pixels[row, column] = 200
    return pixels


Z_FORWARD = [(0.0, -np.sin(b), np.cos(b)) for b in (PORT, STARBOARD)]
X_FORWARD = [(np.cos(b), np.sin(b), 0.0) for b in (PORT, STARBOARD)]


def test_projected_image_with_z_forward_has_y_to_starboard():
    (event,) = read(
        "marine_acoustic_msgs/msg/ProjectedSonarImage",
        projected(Z_FORWARD, one_target((4, 2), 2, 0)),
    )
    assert (event.vehicle_id, event.stamp_ns, event.frame_id) == ("auv_1", STAMP_NS, "sonar")
    assert event.forward == "z"
    target_at(30.0, 3.0, event)


def test_projected_image_with_x_forward_has_y_to_port():
    (event,) = read(
        "marine_acoustic_msgs/ProjectedSonarImage",  # as ROS 1 names it
        projected(X_FORWARD, one_target((4, 2), 2, 0)),
    )
    assert event.forward == "x"
    target_at(30.0, 3.0, event)


def test_ranges_may_fall():
    msg = projected(X_FORWARD, one_target((4, 2), 1, 0))
    msg.ranges = msg.ranges[::-1]
    (event,) = read("marine_acoustic_msgs/msg/ProjectedSonarImage", msg)
    assert (np.diff(event.image.range_m) > 0.0).all()
    target_at(30.0, 3.0, event)


def test_ranges_in_millimetres_become_metres():
    msg, told = projected(X_FORWARD, one_target((4, 2), 1, 0)), []
    metres = np.array(msg.ranges)
    msg.ranges = metres * 1000.0
    settings = ReadSettings(tell=told.append)
    (event,) = read("marine_acoustic_msgs/msg/ProjectedSonarImage", msg, settings)
    np.testing.assert_allclose(event.image.range_m, metres)
    assert [finding.kind for finding in told] == ["sonar_range_unit"]


def test_pixels_that_are_no_number_hold_nothing():
    pixels = one_target((4, 2), 2, 0, np.float32)
    pixels[0] = np.nan
    msg = projected(X_FORWARD, pixels, dtype=8)
    (event,) = read("marine_acoustic_msgs/msg/ProjectedSonarImage", msg)
    target_at(30.0, 3.0, event)
    assert event.image.intensity[0].tolist() == [0.0, 0.0]


def test_decibels_of_the_simulator_become_amplitudes():
    decibels = np.full((4, 2), -60.0, np.float32)
    decibels[2, 0] = -20.0
    decibels[0, 1] = -np.inf
    (event,) = read(
        "marine_acoustic_msgs/msg/ProjectedSonarImage", projected(X_FORWARD, decibels, dtype=8)
    )
    target_at(30.0, 3.0, event)
    intensity = event.image.intensity
    assert intensity[2, 0] / intensity[1, 1] == pytest.approx(100.0)
    assert intensity.min() >= 0.0
    assert intensity.max() == 1.0


def test_a_projected_image_says_what_is_wrong():
    msg = projected(Z_FORWARD, one_target((4, 2), 2, 0))
    name = "marine_acoustic_msgs/msg/ProjectedSonarImage"
    with pytest.raises(InvalidInputError, match=r"beam_directions has 1 entries, expected .* 2"):
        read(name, Msg(**{**vars(msg), "beam_directions": msg.beam_directions[:1]}))
    with pytest.raises(InvalidInputError, match=r"image\.data has 8 bytes, expected 6"):
        read(name, Msg(**{**vars(msg), "ranges": msg.ranges[:3]}))
    with pytest.raises(InvalidInputError, match="not finite and rising"):
        read(name, Msg(**{**vars(msg), "ranges": msg.ranges[[0, 2, 1, 3]]}))
    with pytest.raises(InvalidInputError, match=r"image\.dtype is 11"):
        read(name, projected(Z_FORWARD, one_target((4, 2), 2, 0), dtype=11))
    with pytest.raises(InvalidInputError, match="without a bearing"):
        read(name, projected([*Z_FORWARD, (1.0, 0.0, 0.0)], np.ones((4, 3), np.uint8)))


def test_a_sonar_that_has_not_begun_holds_nothing():
    for directions, shape in (([], (0, 0)), ([], (4, 0)), (Z_FORWARD, (0, 2))):
        empty = projected(directions, np.empty(shape, np.uint8))
        assert read("marine_acoustic_msgs/msg/ProjectedSonarImage", empty) == ()


@pytest.mark.parametrize("dtype", ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "f4", "f8"])
@pytest.mark.parametrize("is_bigendian", [False, True])
def test_every_pixel_type_and_byte_order(dtype, is_bigendian):
    codes = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")
    pixels = np.arange(8).reshape(4, 2).astype((">" if is_bigendian else "<") + dtype)
    msg = projected(X_FORWARD, pixels, dtype=codes.index(dtype), is_bigendian=is_bigendian)
    (event,) = read("marine_acoustic_msgs/msg/ProjectedSonarImage", msg)
    assert event.image.intensity.dtype == np.dtype(dtype)
    np.testing.assert_array_equal(event.image.intensity, np.arange(8).reshape(4, 2))


def raw(**changes):
    beams = one_target((2, 100), 0, 39)  # beam by beam, as the Gemini's driver writes
    fields = {
        "header": header(),
        "ping_info": Msg(frequency=720e3, sound_speed=1500.0, tx_beamwidths=[], rx_beamwidths=[]),
        "sample_rate": 7500.0,  # 0.1 m per sample
        "samples_per_beam": 100,
        "sample0": 0,
        "tx_delays": [0.0, 0.0],
        "tx_angles": [0.0, 0.0],
        "rx_angles": [-PORT, -STARBOARD],  # steered to starboard
        "image": image_data(beams, 2),
    }
    return Msg(**fields | changes)


def test_raw_image_of_a_gemini():
    name = "marine_acoustic_msgs/msg/RawSonarImage"
    by_beam = replace(SETTINGS, data_order="beam_major")
    (event,) = read(name, raw(), by_beam)
    assert event.forward is None
    target_at(30.0, 3.95, event)
    (event,) = read(name, raw(sample0=10), by_beam)
    target_at(30.0, 4.95, event)
    with pytest.raises(InvalidInputError, match="sample_rate is 0"):
        read(name, raw(sample_rate=0.0), by_beam)
    with pytest.raises(InvalidInputError, match="rx_angles has 1 entries"):
        read(name, raw(rx_angles=[0.0]), by_beam)
    assert read(name, raw(samples_per_beam=0), by_beam) == ()
    assert read(name, raw(rx_angles=[], image=image_data([], 0)), by_beam) == ()


def test_angles_of_a_raw_image_that_go_beyond_a_turn_are_degrees():
    told = []
    settings = replace(SETTINGS, data_order="beam_major", memory={}, tell=told.append)
    angles = np.degrees([-PORT, -STARBOARD])
    for _ in range(2):
        (event,) = adapter_of("marine_acoustic_msgs/msg/RawSonarImage").read(
            raw(rx_angles=angles), settings
        )
        target_at(30.0, 3.95, event)
    assert [finding.kind for finding in told] == ["sonar_angle_unit"]


def ensta(rows, *, has_gains=False, size=1, before=b"", **changes):
    data = np.frombuffer(before + rows.tobytes(), np.uint8)
    fields = {
        "header": header("oculus"),
        "ping_id": 1,
        "range": 2.0,
        "range_resolution": 0.5,
        "has_gains": has_gains,
        "n_ranges": 4,
        "n_beams": 2,
        "step": 2 * size + 4 * has_gains,
        "sample_size": size,
        "bearings": np.array([-3000, 3000], np.int16),  # hundredths of a degree, to starboard
        "ping_data": data,
    }
    return Msg(**fields | changes)


@pytest.mark.parametrize("before", [b"", b"header and bearings of the sonar's packet"])
@pytest.mark.parametrize("size", [1, 2])
def test_ping_of_an_oculus_by_ensta(before, size):
    pixels = one_target((4, 2), 2, 0).astype(f"<u{size}")
    (event,) = read("oculus_interfaces/msg/Ping", ensta(pixels, size=size, before=before))
    assert (event.frame_id, event.forward) == ("oculus", None)
    target_at(30.0, 1.25, event)


def test_gains_of_rows_are_taken_out():
    # Equal echoes, of which the third row was amplified by a gain of 16.
    rows = np.zeros((4, 6), np.uint8)
    rows[:, 4:] = [[10, 10], [10, 10], [40, 40], [10, 10]]
    rows[:, :4] = np.array([1, 1, 16, 1], "<u4").view(np.uint8).reshape(4, 4)
    (event,) = read("oculus_interfaces/msg/Ping", ensta(rows, has_gains=True))
    np.testing.assert_allclose(event.image.intensity, 10.0 / 255.0, rtol=1e-6)


def test_a_ping_by_ensta_says_what_is_wrong():
    pixels = one_target((4, 2), 2, 0)
    name = "oculus_interfaces/msg/Ping"
    with pytest.raises(InvalidInputError, match="step is 3, expected 2"):
        read(name, ensta(pixels, step=3))
    with pytest.raises(InvalidInputError, match="ping_data has 6 bytes"):
        read(name, ensta(pixels[:3]))
    with pytest.raises(InvalidInputError, match="range_resolution is 0"):
        read(name, ensta(pixels, range_resolution=0.0))
    with pytest.raises(InvalidInputError, match="sample_size is 3"):
        read(name, ensta(pixels, sample_size=3))
    assert read(name, ensta(pixels, n_ranges=0)) == ()


def bruce(ping, **changes):
    fields = {
        "header": header(),
        "ping_id": 1,
        "bearings": np.array([-3000, 3000], np.int16),
        "range_resolution": 0.5,
        "num_ranges": 4,
        "num_beams": 2,
        "ping": ping,
    }
    return Msg(**fields | changes)


def test_ping_of_an_oculus_by_bruce():
    pixels = one_target((4, 2), 2, 0)
    png = cv2.imencode(".png", pixels)[1].reshape(-1)
    (event,) = read("sonar_oculus/msg/OculusPing", bruce(Msg(format="png", data=png)))
    target_at(30.0, 1.25, event)
    # An older driver sends an Image, with the number of ranges for a step.
    image = Msg(
        height=4, width=2, encoding="8UC1", is_bigendian=0, step=4, data=pixels.reshape(-1)
    )
    (event,) = read("sonar_oculus/msg/OculusPingUncompressed", bruce(image))
    target_at(30.0, 1.25, event)
    with pytest.raises(InvalidInputError, match=r"ping\.data \(5 bytes\) is no JPEG or PNG"):
        read("sonar_oculus/msg/OculusPing", bruce(Msg(format="jpeg", data=b"hello")))
    with pytest.raises(InvalidInputError, match=r"expected \(num_ranges, bearings\) = \(5, 2\)"):
        read("sonar_oculus/msg/OculusPing", bruce(Msg(format="png", data=png), num_ranges=5))
    assert read("sonar_oculus/msg/OculusPing", bruce(None, bearings=[], num_beams=0)) == ()


def fan(pixels, encoding="mono8", is_bigendian=0):
    data = np.ascontiguousarray(pixels).reshape(-1).view(np.uint8)
    height, width = pixels.shape[:2]
    return Msg(
        header=header(),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=is_bigendian,
        step=data.size // height,
        data=data,
    )


FAN = replace(SETTINGS, image_aperture_rad=np.radians(60.0), image_max_range_m=4.0)


@pytest.mark.parametrize(
    ("encoding", "dtype", "is_bigendian"),
    [("mono8", "u1", 0), ("mono16", "<u2", 0), ("16UC1", ">u2", 1), ("32FC1", "<f4", 0)],
)
def test_image_whose_geometry_is_set(encoding, dtype, is_bigendian):
    msg = fan(one_target((4, 2), 2, 0).astype(dtype), encoding, is_bigendian)
    (event,) = read("sensor_msgs/msg/Image", msg, FAN)
    assert event.forward is None
    target_at(30.0, 2.5, event)


def test_image_with_the_range_from_the_bottom_and_starboard_first():
    msg = fan(one_target((4, 2), 1, 1))
    other = replace(
        FAN, image_nearest_row="bottom", image_first_column="starboard", image_min_range_m=2.0
    )
    (event,) = read("sensor_msgs/msg/Image", msg, other)
    target_at(30.0, 3.25, event)


def test_an_image_without_geometry_says_what_to_set():
    with pytest.raises(InvalidInputError, match=r"image_aperture_rad .* image_max_range_m"):
        read("sensor_msgs/msg/Image", fan(one_target((4, 2), 2, 0)))
    with pytest.raises(InvalidInputError, match="encoding is 'bayer_rggb8'"):
        read("sensor_msgs/msg/Image", fan(np.ones((4, 2), np.uint8), "bayer_rggb8"), FAN)
    no_span = replace(FAN, image_min_range_m=4.0)
    with pytest.raises(InvalidInputError, match="expected more than image_min_range_m"):
        read("sensor_msgs/msg/Image", fan(one_target((4, 2), 2, 0)), no_span)
    assert read("sensor_msgs/msg/Image", Msg(height=0, width=0), FAN) == ()


def test_coloured_pictures_are_refused_and_grey_ones_are_not():
    pixels = np.repeat(one_target((4, 2), 2, 0)[:, :, None], 3, axis=2)
    (event,) = read("sensor_msgs/msg/Image", fan(pixels, "rgb8"), FAN)
    target_at(30.0, 2.5, event)
    pixels[:, :, 0] = 0
    with pytest.raises(InvalidInputError, match="rgb8 with colours"):
        read("sensor_msgs/msg/Image", fan(pixels, "rgb8"), FAN)
    png = cv2.imencode(".png", one_target((4, 2), 2, 0))[1].reshape(-1)
    compressed = Msg(header=header(), format="png", data=png)
    (event,) = read("sensor_msgs/msg/CompressedImage", compressed, FAN)
    target_at(30.0, 2.5, event)


def echo_16(rng):
    """A wall in speckle: the high byte is smooth, the low one is not."""
    rows = np.exp(-0.5 * ((np.arange(120) - 60) / 8.0) ** 2)[:, None] * np.ones(80)
    return (40000.0 * rows + rng.uniform(0.0, 2000.0, rows.shape)).astype(np.uint16)


@pytest.mark.parametrize("declared", ["<u2", ">u2"])
@pytest.mark.parametrize("written", ["<u2", ">u2"])
def test_bytes_in_the_wrong_order_are_swapped_and_told_once(rng, declared, written):
    pixels, told = echo_16(rng), []
    settings = replace(FAN, tell=told.append, memory={})
    msg = fan(pixels.astype(written), "mono16", declared == ">u2")
    for _ in range(2):
        (event,) = read("sensor_msgs/msg/Image", msg, settings)
        np.testing.assert_array_equal(event.image.intensity, pixels)
    assert [f.kind for f in told] == ["sonar_byte_order"] * (declared != written)


def test_eight_bits_in_the_upper_byte_are_found_too(rng):
    pixels = (echo_16(rng) // 256 * 256 + 17).astype(np.uint16)
    settings = replace(FAN, memory={})
    (event,) = read("sensor_msgs/msg/Image", fan(pixels.astype(">u2"), "mono16"), settings)
    np.testing.assert_array_equal(event.image.intensity, pixels)


@pytest.mark.parametrize("scale", [0.0, 1.0])
def test_an_image_that_cannot_tell_is_left_alone(rng, scale):
    # Black, or noise in every bit.
    pixels = (scale * rng.integers(0, 65536, (120, 80))).astype("<u2")
    settings = replace(FAN, memory={})
    (event,) = read("sensor_msgs/msg/Image", fan(pixels, "mono16"), settings)
    np.testing.assert_array_equal(event.image.intensity, pixels)
    assert "is_swapped" not in settings.memory


@pytest.mark.parametrize("dtype", ["u2", "u4", "f4"])
def test_pixels_that_never_come_near_zero_stand_on_a_pedestal(rng, dtype):
    # The first rows are blanked by the driver, and stay so.
    amplitude = np.zeros((120, 80))
    amplitude[10:] = 1.0 + np.round(rng.rayleigh(100.0, (110, 80)))
    amplitude[60, 20:60] = 2000.0
    stands = np.where(amplitude > 0.0, amplitude + 3000.0, 0.0).astype(dtype)
    least = amplitude[amplitude > 0.0].min()
    found = without_pedestal(stands)
    assert found.dtype == stands.dtype
    np.testing.assert_array_equal(found, np.where(amplitude > 0.0, amplitude - least, 0.0))
    plain = amplitude.astype(dtype)
    assert without_pedestal(plain) is plain


def wall_in_speckle(rng, num_ranges, num_beams):
    rows = np.arange(num_ranges)[:, None] - 0.5 * num_ranges - 0.1 * np.arange(num_beams)
    clean = 150.0 * np.exp(-0.5 * (rows / 4.0) ** 2) + 40.0
    return (clean * np.sqrt(rng.exponential(1.0, clean.shape))).clip(0.0, 255.0).astype(np.uint8)


@pytest.mark.parametrize("shape", [(200, 96), (96, 200), (128, 64)])
@pytest.mark.parametrize("is_by_beam", [False, True])
def test_the_order_of_the_bytes_is_found(rng, shape, is_by_beam):
    settings = replace(SETTINGS, memory={})
    bearings = np.linspace(1.0, -1.0, shape[1])
    directions = [(0.0, -np.sin(b), np.cos(b)) for b in bearings]
    for _ in range(12):
        pixels = wall_in_speckle(rng, *shape)
        msg = projected(directions, pixels)
        if is_by_beam:
            msg.image.data = np.ascontiguousarray(pixels.T).reshape(-1)
        (event,) = read("marine_acoustic_msgs/msg/ProjectedSonarImage", msg, settings)
        np.testing.assert_array_equal(event.image.intensity, pixels)
    assert settings.memory["data_order"] == ("beam_major" if is_by_beam else "range_major")


def test_black_images_do_not_tell_the_order():
    settings = replace(SETTINGS, memory={})
    msg = projected(X_FORWARD, np.zeros((4, 2), np.uint8))
    for _ in range(12):
        read("marine_acoustic_msgs/msg/ProjectedSonarImage", msg, settings)
    assert settings.memory == {}
