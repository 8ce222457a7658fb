"""Whose bags are which, on tiny recordings."""

import pytest
from unit.io.bag_messages import SECOND

from uw_dslam_ros2.core.errors import ConfigError, DataError
from uw_dslam_ros2.io.bags import BagWriter
from uw_dslam_ros2.io.events import VehicleReader
from uw_dslam_ros2.io.outgoing import MessageFactory
from uw_dslam_ros2.io.vehicles import find_recordings


def write(path, first_s, last_s, topic="/auv_1/imu"):
    """A bag with one message of the IMU at its start and one at its end."""
    with BagWriter(path) as writer:
        make = MessageFactory(writer.typestore)
        writer.add_topic(topic, "sensor_msgs/msg/Imu")
        for second in (first_s, last_s):
            stamp_ns = second * SECOND
            writer.write(topic, stamp_ns, make.imu(stamp_ns, "imu", 0.1, 1e-4, 0.0, 1e-4))
    return path


def test_bags_of_one_dive_are_one_vehicle(tmp_path):
    later, first = write(tmp_path / "a", 70, 120), write(tmp_path / "b", 10, 60)
    (recording,), findings = find_recordings([later, first])
    assert (recording.vehicle_id, recording.bags) == ("auv_1", (first, later))
    assert recording.num_messages == 4
    assert findings == []


def test_after_a_long_pause_nobody_knows_where_it_is(tmp_path):
    bags = [write(tmp_path / "a", 10, 60), write(tmp_path / "b", 600, 660)]
    recordings, (finding,) = find_recordings(bags)
    assert [r.vehicle_id for r in recordings] == ["auv_1", "auv_1_2"]
    assert finding.kind == "paused"


def test_two_at_one_time_are_two_vehicles_named_after_their_bags(tmp_path):
    bags = [write(tmp_path / "left", 10, 60), write(tmp_path / "right", 20, 70)]
    recordings, (finding,) = find_recordings(bags)
    assert [(r.vehicle_id, r.namespace) for r in recordings] == [
        ("left", "auv_1"),
        ("right", "auv_1"),
    ]
    assert finding.kind == "same_name"
    named, findings = find_recordings([], named={"p": [bags[0]], "s": [bags[1]]})
    assert [r.vehicle_id for r in named] == ["p", "s"]
    assert findings == []


def test_two_recorders_of_one_vehicle_that_ran_at_one_time_are_one_vehicle(tmp_path):
    bags = [write(tmp_path / "a", 10, 60), write(tmp_path / "b", 60, 110)]
    again = write(tmp_path / "c", 60, 80)
    for second in (bags[1], again):
        (recording,), findings = find_recordings([bags[0], second])
        assert (recording.vehicle_id, recording.bags) == ("auv_1", (bags[0], second))
        assert findings == []
    (recording,), findings = find_recordings([*bags, again])
    assert len(recording.bags) == 3
    with VehicleReader(recording) as reader:
        reader.check_clocks()
        assert len(list(reader.events())) == 4  # at 10, 60, 80 and 110 s
        assert reader.counts["imu"].num_repeated == 2


def test_names_that_cannot_be(tmp_path):
    bag = write(tmp_path / "bag", 10, 60)
    with pytest.raises(ConfigError, match="expected a name without slashes"):
        find_recordings([], named={"a/b": [bag]})
    with pytest.raises(DataError, match="is named twice"):
        find_recordings([bag, tmp_path / "." / "bag"])
