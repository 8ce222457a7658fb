import math
import re
import shutil
import sqlite3

import numpy as np
import pytest
import yaml
from backports import zstd
from rosbags import rosbag1
from rosbags.typesys import Stores, get_typestore
from unit.io.bag_messages import SECOND, sonar_image, write_vehicle

from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.io.bags import (
    BagWriter,
    DepthEvent,
    ImageEvent,
    ImuEvent,
    PointsEvent,
    TransformEvent,
    TruthEvent,
    VelocityEvent,
    open_bag,
    read_events,
)
from uw_dslam_ros2.io.events import VehicleReader
from uw_dslam_ros2.io.outgoing import MessageFactory
from uw_dslam_ros2.io.sensor_settings import TopicsConfig
from uw_dslam_ros2.io.vehicles import recordings_of


def write_bag(path, storage="mcap", **kwargs):
    with BagWriter(path, storage) as writer:
        write_vehicle(writer, MessageFactory(writer.typestore), **kwargs)
    return path


def storage_file(bag):
    (path,) = [p for p in bag.iterdir() if p.suffix in (".mcap", ".db3")]
    return path


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_events_are_what_was_written(tmp_path, storage):
    bag = write_bag(tmp_path / "bag", storage)
    events = list(read_events(bag))

    assert [type(e) for e in events] == [
        TransformEvent,
        ImageEvent,
        ImuEvent,
        VelocityEvent,  # the second one has no bottom lock
        DepthEvent,
        TruthEvent,
    ]
    mount, image, imu, dvl, depth, truth = events
    assert [e.stamp_ns // SECOND for e in events[1:]] == [10, 11, 12, 15, 17]
    others = read_events(bag, topics=TopicsConfig(sonar="points", velocity="velocity"))
    twist, points = [e for e in others if isinstance(e, VelocityEvent | PointsEvent)]
    assert [e.stamp_ns // SECOND for e in (twist, points)] == [14, 16]
    assert {e.vehicle_id for e in (*events, twist, points)} == {"auv_1"}
    assert (mount.frame_id, mount.child_frame_id) == ("auv_1/base_link", "auv_1/dvl")
    assert mount.T_parent_child[:2, 3] == pytest.approx([0.1, 0.2])
    np.testing.assert_array_equal(image.image.intensity[1], [3, 4, 5])
    np.testing.assert_allclose(image.image.bearing_rad, [1.0, 0.15**3, -(0.7**3)], atol=1e-9)
    np.testing.assert_allclose(image.image.range_m, [1.0, 1.5, 2.0, 2.5, 3.0])
    assert (imu.yaw_rad, imu.yaw_variance) == pytest.approx((0.5, 0.01))
    assert imu.yaw_rate_rad_s == -0.25
    np.testing.assert_allclose(dvl.velocity_m_s, [1.0, -0.25, 0.0])  # y to starboard
    np.testing.assert_allclose(dvl.horizontal()[0], [1.0, 0.25])
    np.testing.assert_allclose(dvl.horizontal()[1], 1e-4 * np.eye(2))
    np.testing.assert_allclose(twist.horizontal()[0], [1.0, 0.25])
    assert depth.depth_m == pytest.approx(2.5)
    np.testing.assert_allclose(points.points, [[1.0, -2.0], [3.5, 4.25]])
    assert truth.T_world_base.as_array() == pytest.approx([1.0, 2.0, 3.0])


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_raw_messages_can_be_chosen_by_topic_and_time(tmp_path, storage):
    with open_bag(write_bag(tmp_path / "bag", storage)) as bag:
        assert bag.topics["/auv_1/imu"] == "sensor_msgs/msg/Imu"
        assert (bag.start_ns, bag.end_ns) == (10 * SECOND, 17 * SECOND)
        assert len(list(bag.raw())) == 9
        dvl = list(bag.raw(["/auv_1/dvl"]))
        assert [m.stamp_ns // SECOND for m in dvl] == [12, 13]
        window = list(bag.raw(start_ns=12 * SECOND, stop_ns=15 * SECOND))
        assert [m.stamp_ns // SECOND for m in window] == [12, 13, 14]
        (message,) = bag.messages(["/auv_1/imu"])
        assert message.content.angular_velocity.z == -0.25
        with pytest.raises(DataError, match="no topic /auv_1/nothing"):
            list(bag.raw(["/auv_1/nothing"]))


def test_a_single_storage_file_is_a_bag_too(tmp_path):
    bag = write_bag(tmp_path / "bag")
    assert len(list(read_events(storage_file(bag)))) == len(list(read_events(bag)))


def test_several_bags_are_merged_by_time(tmp_path):
    first = write_bag(tmp_path / "a", vehicle="auv_1", first_s=10)
    second = write_bag(tmp_path / "b", "sqlite3", vehicle="auv_2", first_s=12)
    events = list(read_events([second, first]))
    assert [type(e) for e in events[:2]] == [TransformEvent, TransformEvent]
    stamps = [e.stamp_ns for e in events[2:]]
    assert stamps == sorted(stamps)
    assert {e.vehicle_id for e in events} == {"auv_1", "auv_2"}


def test_writing_is_reproducible(tmp_path):
    files = [storage_file(write_bag(tmp_path / name / "bag")) for name in ("a", "b")]
    assert files[0].read_bytes() == files[1].read_bytes()


def test_a_topic_is_found_by_its_type_and_a_vehicle_can_be_named(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        make = MessageFactory(writer.typestore)
        writer.add_topic("/heading", "sensor_msgs/msg/Imu")
        writer.write("/heading", 5, make.imu(5, "imu", 1.0, 0.1, None, 0.0))
    (event,) = read_events(tmp_path / "bag")
    assert event.vehicle_id == "bag"
    (event,) = read_events(tmp_path / "bag", "auv_7")
    assert (event.vehicle_id, event.yaw_rate_rad_s) == ("auv_7", None)
    assert event.yaw_rad == pytest.approx(1.0)


def test_a_bag_without_a_topic_that_is_read(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/auv_1/name", "std_msgs/msg/String")
        writer.write("/auv_1/name", 5, writer.typestore.types["std_msgs/msg/String"]("x"))
    with pytest.raises(DataError, match="none of the topics has a type that is read"):
        list(read_events(tmp_path / "bag"))


def test_missing_file(tmp_path):
    with pytest.raises(DataError, match=r"nowhere does not exist; expected a rosbag2"):
        list(read_events(tmp_path / "nowhere"))


def test_folder_without_a_recording(tmp_path):
    with pytest.raises(DataError, match=r"holds no recording; expected a rosbag2 folder"):
        list(read_events(tmp_path))


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_folder_without_metadata(tmp_path, storage):
    bag = write_bag(tmp_path / "bag", storage)
    whole = [type(event) for event in read_events(bag)]
    (bag / "metadata.yaml").unlink()
    assert [type(event) for event in read_events(bag)] == whole
    with open_bag(bag) as reader:
        assert reader.damage == ""


def emptied(bag):
    (bag / "metadata.yaml").write_text("")


def without_storage_identifier(bag):
    """As reindexing leaves it."""
    path = bag / "metadata.yaml"
    path.write_text(re.sub("storage_identifier: .*", 'storage_identifier: ""', path.read_text()))


def renamed(bag):
    storage_file(bag).rename(bag / "other_0.mcap")


def edited(bag, change):
    path = bag / "metadata.yaml"
    content = yaml.safe_load(path.read_text())
    change(content["rosbag2_bagfile_information"])
    path.write_text(yaml.safe_dump(content))


def without_a_topic(bag):
    """As a recorder leaves it that found the topic late."""

    def change(information):
        topics = information["topics_with_message_count"]
        topics[:] = [t for t in topics if not t["topic_metadata"]["name"].endswith("imu")]

    edited(bag, change)


def with_another_quality_of_service(bag):
    """As merging and editing tools leave it."""

    def change(information):
        for topic in information["topics_with_message_count"]:
            topic["topic_metadata"]["offered_qos_profiles"] = []

    edited(bag, change)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("spoil", [without_a_topic, with_another_quality_of_service])
def test_what_metadata_do_not_tell_of_is_read_all_the_same(tmp_path, spoil, storage):
    bag = write_bag(tmp_path / "bag", storage)
    expected = len(list(read_events(bag)))
    spoil(bag)
    assert len(list(read_events(bag))) == expected
    with open_bag(bag) as reader:
        assert reader.damage == ""


def test_a_file_that_metadata_do_not_list_is_told(tmp_path):
    bag = write_bag(tmp_path / "bag")
    with open_bag(bag) as reader:
        assert reader.damage == ""
    shutil.copy(storage_file(bag), bag / "more_1.mcap")
    with open_bag(bag) as reader:
        assert "does not list more_1.mcap" in reader.damage


@pytest.mark.parametrize("spoil", [emptied, without_storage_identifier, renamed])
def test_metadata_that_does_not_fit_its_folder_does_no_harm(tmp_path, spoil):
    bag = write_bag(tmp_path / "bag")
    expected = len(list(read_events(bag)))
    spoil(bag)
    assert len(list(read_events(bag))) == expected


@pytest.mark.parametrize("has_metadata", [True, False])
def test_a_database_of_before_foxy_is_read(tmp_path, has_metadata):
    """Its topics have no column of QoS profiles."""
    bag = write_bag(tmp_path / "bag", "sqlite3")
    expected = len(list(read_events(bag)))
    with sqlite3.connect(storage_file(bag)) as database:
        database.execute("alter table topics drop column offered_qos_profiles")
    if not has_metadata:
        (bag / "metadata.yaml").unlink()
    assert len(list(read_events(bag))) == expected


def test_a_split_recording_is_read_in_order(tmp_path):
    folder = tmp_path / "split"
    folder.mkdir()
    for number, first_s in ((0, 10), (1, 30), (2, 50), (10, 70)):
        part = write_bag(tmp_path / f"part{number}", first_s=first_s)
        storage_file(part).rename(folder / f"split_{number}.mcap")
    stamps = [e.stamp_ns for e in read_events(folder) if isinstance(e, ImuEvent)]
    assert stamps == [first_s * SECOND for first_s in (11, 31, 51, 71)]


def test_what_lies_in_the_write_ahead_log_is_read_and_left_alone(tmp_path):
    bag = write_bag(tmp_path / "bag", "sqlite3")
    file, folder = storage_file(bag), tmp_path / "live"
    folder.mkdir()
    with sqlite3.connect(file) as connection:
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("UPDATE messages SET timestamp = timestamp + 1")
        connection.commit()
        # As a recorder leaves it that was killed: the last pages are in the log only.
        for name in (file.name, f"{file.name}-wal"):
            shutil.copy(bag / name, folder / name)
    connection.close()
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    with open_bag(folder) as reader:
        assert len(list(reader.raw())) == 9
        assert reader.start_ns == 10 * SECOND + 1
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == before


def test_compressed_files_are_read(tmp_path):
    bag = write_bag(tmp_path / "bag", "sqlite3")
    whole = len(list(read_events(bag)))
    file = storage_file(bag)
    (tmp_path / "packed").mkdir()
    packed = tmp_path / "packed" / f"{file.name}.zstd"
    packed.write_bytes(zstd.compress(file.read_bytes()))
    assert len(list(read_events(tmp_path / "packed"))) == whole


def test_a_ros_1_bag_reads_like_any_other(tmp_path):
    """Headers of ROS 1 have a sequence number, which must not shift what follows it."""
    store = get_typestore(Stores.ROS1_NOETIC)
    types = store.types
    vector = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.25)
    with rosbag1.Writer(tmp_path / "old.bag") as writer:
        connection = writer.add_connection("/auv_1/imu", "sensor_msgs/msg/Imu", typestore=store)
        for number in range(3):
            stamp = types["builtin_interfaces/msg/Time"](10 + number, 7)
            message = types["sensor_msgs/msg/Imu"](
                types["std_msgs/msg/Header"](number, stamp, "auv_1/imu"),
                types["geometry_msgs/msg/Quaternion"](0.0, 0.0, math.sin(0.2), math.cos(0.2)),
                np.zeros(9), vector, np.zeros(9), vector, np.zeros(9),
            )  # fmt: skip
            data = store.serialize_ros1(message, "sensor_msgs/msg/Imu")
            writer.write(connection, (20 + number) * SECOND, data)
    events = list(read_events(tmp_path / "old.bag"))
    assert [e.stamp_ns for e in events] == [s * SECOND + 7 for s in (10, 11, 12)]
    assert events[0].yaw_rad == pytest.approx(0.4)
    assert (events[0].frame_id, events[0].yaw_rate_rad_s) == ("auv_1/imu", 0.25)


def test_file_of_another_format(tmp_path):
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(DataError, match="is not a bag"):
        list(read_events(tmp_path / "notes.txt"))


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("keep", [0.0, 0.02, 0.3, 0.6, 0.9, 0.999])
def test_of_a_truncated_bag_what_is_readable_is_read(tmp_path, storage, keep):
    bag = tmp_path / "bag"
    num_imu = 20_000  # several pages, and several chunks
    with BagWriter(bag, storage) as writer:
        make = MessageFactory(writer.typestore)
        writer.add_topic("/auv_1/imu", "sensor_msgs/msg/Imu")
        for number in range(num_imu):
            stamp_ns = SECOND + number
            writer.write("/auv_1/imu", stamp_ns, make.imu(stamp_ns, "i", 0.1, 1e-4, 0.0, 1e-4))
    path = storage_file(bag)
    content = path.read_bytes()
    path.write_bytes(content[: int(keep * len(content))])
    for target in (bag, path):
        # A database's pages are found through others, which may lie behind the cut.
        if keep < (0.5 if storage == "sqlite3" else 0.1):
            with pytest.raises(DataError, match=f"{target.name} is damaged"):
                list(read_events(target))
            continue
        with open_bag(target) as reader:
            stamps = [raw.stamp_ns for raw in reader.raw()]
            if len(stamps) == num_imu and target is bag:  # only the index is missing
                assert reader.damage == ""
            else:
                words = "are missing" if target is bag else "its end is missing"
                assert words in reader.damage
        assert stamps == sorted(set(stamps) & set(range(SECOND, SECOND + num_imu)))
        # Where the messages end and the index begins differs.
        assert 0.5 * keep * num_imu <= len(stamps) <= num_imu


def test_what_a_stopped_driver_repeats_under_new_stamps_is_left_out_and_told(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        messages = MessageFactory(writer.typestore)
        writer.add_topic("/auv_1/sonar", "marine_acoustic_msgs/msg/ProjectedSonarImage")
        writer.add_topic("/auv_1/dvl", "marine_acoustic_msgs/msg/Dvl")
        for k in range(20):
            stamp_ns = (k + 1) * SECOND
            image = sonar_image(stamp_ns, np.uint16, 50, 40)
            image.intensity[0, 0] = min(k, 10)
            writer.write("/auv_1/sonar", stamp_ns, messages.sonar_image("auv_1/sonar", image))
            velocity = (min(k, 10) + 0.5, 0.0)
            content = messages.dvl(stamp_ns, "auv_1/dvl", velocity, 1e-4, 3.0)
            writer.write("/auv_1/dvl", stamp_ns, content)
    (recording,) = recordings_of([tmp_path / "bag"])
    with VehicleReader(recording) as reader:
        events = list(reader.events())
    images = [e.image.intensity[0, 0] for e in events if isinstance(e, ImageEvent)]
    speeds = [e.velocity_m_s[0] for e in events if isinstance(e, VelocityEvent)]
    assert images == list(range(11))
    # A few repetitions are usual, where a driver publishes faster than it measures.
    assert speeds == [*(k + 0.5 for k in range(11)), 10.5, 10.5, 10.5]
    assert [finding.kind for finding in reader.findings] == ["sonar_frozen", "dvl_frozen"]


def recording_of_images(path, images):
    with BagWriter(path) as writer:
        messages = MessageFactory(writer.typestore)
        writer.add_topic("/auv_1/sonar", "marine_acoustic_msgs/msg/ProjectedSonarImage")
        for image in images:
            content = messages.sonar_image("auv_1/sonar", image)
            writer.write("/auv_1/sonar", image.stamp_ns, content)
    (recording,) = recordings_of([path])
    return recording


def test_images_that_a_viewer_repeats_at_its_own_rate_are_left_out_untold(tmp_path):
    images = [sonar_image(SECOND + k * SECOND // 5, np.uint16, 50, 40) for k in range(60)]
    for k, image in enumerate(images):
        image.intensity[0, 0] = k // 3
    recording = recording_of_images(tmp_path / "bag", images)
    with VehicleReader(recording) as reader:
        images = [e.image.intensity[0, 0] for e in reader.events() if isinstance(e, ImageEvent)]
    assert images == list(range(20))
    assert not reader.findings


def test_white_images_are_told_and_not_taken_for_those_of_a_stopped_driver(tmp_path):
    images = [sonar_image(SECOND + k * SECOND // 2, np.uint8, 50, 40) for k in range(100)]
    for k, image in enumerate(images):
        image.intensity[:] = np.random.default_rng(k).integers(0, 200, (50, 40))
        if k > 60:
            image.intensity[5:] = 255
            image.intensity[:5] = 0
    recording = recording_of_images(tmp_path / "bag", images)
    with VehicleReader(recording) as reader:
        assert len([e for e in reader.events() if isinstance(e, ImageEvent)]) == 100
    (finding,) = reader.findings
    assert finding.kind == "sonar_saturated"
    assert finding.detail.startswith("39 of 100 images")


def test_what_a_dvl_does_not_say_is_counted_before_and_after_its_first_velocity(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        messages = MessageFactory(writer.typestore)
        writer.add_topic("/auv_1/dvl", "marine_acoustic_msgs/msg/Dvl")
        for k in range(30):
            velocity = None if k < 10 or k > 25 else (1.0, 0.01 * k)
            content = messages.dvl((k + 1) * SECOND, "auv_1/dvl", velocity, 1e-4, 3.0)
            writer.write("/auv_1/dvl", (k + 1) * SECOND, content)
    (recording,) = recordings_of([tmp_path / "bag"])
    with VehicleReader(recording) as reader:
        assert len(list(reader.events())) == 16
        count = reader.counts["velocity"]
    assert (count.num, count.num_empty, count.num_early) == (30, 14, 10)


def test_a_mounting_that_moves_late_is_seen_among_the_vehicles_own_motion(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        messages = MessageFactory(writer.typestore)
        writer.add_topic("/auv_1/imu", "sensor_msgs/msg/Imu")
        writer.add_topic("/tf", "tf2_msgs/msg/TFMessage")
        for k in range(2000):
            stamp_ns = SECOND + k * SECOND // 20
            content = messages.imu(stamp_ns, "auv_1/imu", 0.1, 1e-4, 0.0, 1e-4)
            writer.write("/auv_1/imu", stamp_ns, content)
            moved = [("auv_1/base_link", (0.1 * k, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))]
            writer.write("/tf", stamp_ns, messages.transforms(stamp_ns, "odom", moved))
            if k % 3 == 0:
                pan = [("auv_1/sonar", (0.0, 0.1 * (k > 1500), 0.0), (0.0, 0.0, 0.0, 1.0))]
                content = messages.transforms(stamp_ns, "auv_1/base_link", pan)
                writer.write("/tf", stamp_ns, content)
    (recording,) = recordings_of([tmp_path / "bag"])
    with VehicleReader(recording) as reader:
        told = [e for e in reader.transforms() if e.child_frame_id == "auv_1/sonar"]
    assert told[0].T_parent_child[1, 3] == 0.0
    assert told[-1].T_parent_child[1, 3] == 0.1
    assert len(told) < 500


def test_empty_bag(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/auv_1/imu", "sensor_msgs/msg/Imu")
    with pytest.raises(DataError, match="is empty; expected a recording with at least one"):
        list(read_events(tmp_path / "bag"))


def test_wrong_topic_type(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        make = MessageFactory(writer.typestore)
        writer.add_topic("/auv_1/sonar", "sensor_msgs/msg/Imu")
        writer.write("/auv_1/sonar", 5, make.imu(5, "imu", 1.0, 0.1, None, 0.0))
    with pytest.raises(DataError, match=r"/auv_1/sonar has type .*Imu, which cannot be its sonar"):
        list(read_events(tmp_path / "bag", topics=TopicsConfig(sonar="sonar")))


def test_malformed_message_names_bag_topic_and_field(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        make = MessageFactory(writer.typestore)
        writer.add_topic("/auv_1/sonar", "marine_acoustic_msgs/msg/ProjectedSonarImage")
        for stamp_ns, beam_count in ((5, 3), (6, 4), (7, 3)):
            message = make.sonar_image("sonar", sonar_image(stamp_ns))
            message.image.beam_count = beam_count
            writer.write("/auv_1/sonar", stamp_ns, message)
    with pytest.raises(DataError, match=r"bag: bad message on /auv_1/sonar .*beam_count"):
        list(read_events(tmp_path / "bag"))
    (recording,) = recordings_of([tmp_path / "bag"])
    with VehicleReader(recording) as reader:
        assert [event.stamp_ns for event in reader.events()] == [5, 7]
        count = reader.counts["sonar"]
    assert (count.num, count.num_bad) == (3, 1)
    assert "beam_count" in count.problem


def test_message_that_does_not_fit_its_type(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/auv_1/imu", "sensor_msgs/msg/Imu")
        writer.write_raw("/auv_1/imu", 5, b"\x00\x01\x00\x00\x07")
    with pytest.raises(DataError, match="does not fit its type sensor_msgs/msg/Imu"):
        list(read_events(tmp_path / "bag"))


def test_a_bag_is_not_overwritten(tmp_path):
    write_bag(tmp_path / "bag")
    with pytest.raises(DataError, match="exists already"):
        BagWriter(tmp_path / "bag")
