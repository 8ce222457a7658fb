"""Recorded messages in the order of their stamps: the same map, however late they were written."""

import math

import numpy as np
import pytest

from uw_dslam_ros2.core.mapping import OccupancyConfig, VehicleMapper, VehicleMapperConfig
from uw_dslam_ros2.core.sonar import SonarConfig
from uw_dslam_ros2.io.events import ImuEvent, ScanEvent, TransformEvent, VelocityEvent
from uw_dslam_ros2.io.feeding import feed, in_stamp_order

S = 1_000_000_000
CONFIG = VehicleMapperConfig(
    sonar=SonarConfig(neighbor_distance_m=0.0), occupancy=OccupancyConfig(resolution_m=0.2)
)
BEARINGS = np.linspace(-1.1, 1.1, 60)


def recording():
    """A vehicle that weaves along a quay, in order; a scan at the stamps of navigation."""
    rng = np.random.default_rng(0)
    events = []
    for i in range(200):
        key = "auv_1", i * S // 5, "auv_1/sensor"
        yaw = 0.3 * math.sin(0.1 * i)
        events.append(ImuEvent(*key, yaw + rng.normal(0.0, 0.01), None, 0.03 * math.cos(0.1 * i)))
        events.append(VelocityEvent(*key, rng.normal((1.0, 0.0), 0.02), None))
        if i % 5 == 0:
            ranges = 8.0 / np.maximum(np.abs(np.sin(BEARINGS + yaw)), 0.2)
            events.append(ScanEvent(*key, BEARINGS, ranges + rng.normal(0, 0.03, 60), 60.0))
    return events


def bytes_of(events):
    mapper = VehicleMapper(CONFIG, "auv_1")
    submaps = [submap for event in events for submap in feed(mapper, event, np.eye(4))]
    submaps += mapper.finish()
    assert mapper.diagnostics()["num_pings"] == 40
    stamps, poses = mapper.trajectory()
    return stamps.tobytes(), poses.tobytes(), [s.grid.values.tobytes() for s in submaps]


def late(events, max_delay_s, seed):
    """In the order in which they come if each is late by another time."""
    delay = np.random.default_rng(seed).uniform(0.0, max_delay_s, len(events))
    return [events[i] for i in np.argsort([e.stamp_ns + d * S for e, d in zip(events, delay)])]  # noqa: B905


@pytest.mark.parametrize("max_delay_s", [0.05, 0.5, 1.9])
@pytest.mark.parametrize("seed", range(2))
def test_late_messages_change_no_byte(max_delay_s, seed):
    events = recording()
    disordered = late(events, max_delay_s, seed)
    assert list(map(id, disordered)) != list(map(id, events))
    assert bytes_of(in_stamp_order(disordered)) == bytes_of(events)


def test_of_equal_stamps_the_ping_comes_last():
    events = recording()[:3]
    assert isinstance(events[2], ScanEvent)
    for order in ([2, 0, 1], [0, 2, 1], [1, 0, 2]):
        assert isinstance(list(in_stamp_order([events[i] for i in order]))[-1], ScanEvent)


def test_what_is_no_sensors_message_is_passed_on_at_once():
    fixed = TransformEvent("auv_1", 0, "auv_1/base_link", "auv_1/sensor", np.eye(4))
    events = recording()[:4]
    assert next(iter(in_stamp_order([*events, fixed]))) is fixed


def test_no_more_is_held_back_than_two_seconds():
    held = 0
    events = recording()

    def counted():
        nonlocal held
        for event in events:
            held += 1
            yield event

    for event in in_stamp_order(counted()):
        held -= 1
        assert held <= 1 + sum(0 <= e.stamp_ns - event.stamp_ns <= 2 * S + S // 5 for e in events)
