"""Messages of drivers whose bag has no definitions: through CDR and back, then read."""

import numpy as np
import pytest

from uw_dslam_ros2.io.drivers import ReadSettings, adapter_of
from uw_dslam_ros2.io.drivers.definitions import DEFINITIONS
from uw_dslam_ros2.io.interfaces import make_typestore

STORE = make_typestore()


def make(name, **fields):
    return STORE.types[name](**fields)


def header():
    stamp = make("builtin_interfaces/msg/Time", sec=12, nanosec=345)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id="sonar")


def echo():
    return {
        "angle": 1.0,
        "gain": 0,
        "number_of_samples": 4,
        "transmit_frequency": 740,
        "speed_of_sound": 1500,
        "range": 4,
        "intensities": np.array([0, 0, 200, 0], np.uint8),
    }


def ping():
    return {
        "ping_id": 1,
        "ping_firing_date": 2,
        "range": 2.0,
        "gain_percent": 50.0,
        "frequency": 1.2e6,
        "speed_of_sound_used": 1500.0,
        "range_resolution": 1.0,
        "temperature": 8.0,
        "pressure": 1.0,
        "master_mode": 1,
        "has_gains": False,
        "n_ranges": 4,
        "n_beams": 2,
        "step": 2,
        "sample_size": 1,
        "bearings": np.array([-3000, 3000], np.int16),
        "ping_data": np.array([0, 0, 0, 0, 200, 0, 0, 0], np.uint8),
    }


def raw():
    zeros = np.zeros(2, np.float32)
    info = make(
        "marine_acoustic_msgs/msg/PingInfo",
        frequency=720e3,
        sound_speed=1500.0,
        tx_beamwidths=zeros,
        rx_beamwidths=zeros,
    )
    image = make(
        "marine_acoustic_msgs/msg/SonarImageData",
        is_bigendian=False,
        dtype=0,
        beam_count=2,
        data=np.array([0, 0, 0, 0, 200, 0, 0, 0], np.uint8),
    )
    return {
        "ping_info": info,
        "sample_rate": 750.0,
        "samples_per_beam": 4,
        "sample0": 0,
        "tx_delays": zeros,
        "tx_angles": zeros,
        "rx_angles": np.array([-0.5, 0.5], np.float32),
        "image": image,
    }


@pytest.mark.parametrize(
    ("name", "fields"),
    [
        ("ping360_sonar_msgs/msg/SonarEcho", echo),
        ("oculus_interfaces/msg/Ping", ping),
        ("marine_acoustic_msgs/msg/RawSonarImage", raw),
    ],
)
def test_a_message_is_read_as_a_bag_gives_it(name, fields):
    data = STORE.serialize_cdr(make(name, header=header(), **fields()), name)
    (event,) = adapter_of(name).read(STORE.deserialize_cdr(data, name), ReadSettings("auv_1"))
    picture = event if hasattr(event, "beam_stamp_ns") else event.image
    row, column = np.unravel_index(np.argmax(picture.intensity), picture.intensity.shape)
    assert picture.range_m[row] == pytest.approx(2.5)
    assert picture.bearing_rad[column] > 0.4
    assert event.frame_id == "sonar"


def test_every_definition_has_an_adapter():
    assert [name for name in DEFINITIONS if adapter_of(name) is None] == []
