"""Scans, clouds and beams, of sonars that turn and of those that do not."""

from dataclasses import replace
from types import SimpleNamespace as Msg

import numpy as np
import pytest
from unit.io.drivers.messages import STAMP_NS, header

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.io.drivers import ReadSettings, adapter_of
from uw_dslam_ros2.io.interfaces import make_typestore
from uw_dslam_ros2.io.outgoing import MessageFactory
from uw_dslam_ros2.io.readings import BeamsEvent, ImageEvent, PointsEvent, ScanEvent

SETTINGS = ReadSettings(vehicle_id="auv_1")
SECOND = 1_000_000_000


def read(msgtype, msg, settings=SETTINGS):
    return adapter_of(msgtype).read(msg, settings)


def echo(**changes):
    fields = {
        "header": header(),
        "angle": np.pi / 2,
        "gain": 0,
        "number_of_samples": 10,
        "transmit_frequency": 740,
        "speed_of_sound": 1500,
        "range": 5,
        "intensities": np.array([0, 0, 0, 0, 9, 200, 9, 0, 0, 0], np.uint8),
    }
    return Msg(**fields | changes)


@pytest.mark.parametrize("package", ["ping360_sonar", "ping360_sonar_msgs"])
def test_a_beam_of_a_ping360_to_port(package):
    (event,) = read(f"{package}/msg/SonarEcho", echo())
    assert isinstance(event, BeamsEvent)
    assert (event.stamp_ns, event.beam_stamp_ns.tolist()) == (STAMP_NS, [STAMP_NS])
    assert np.degrees(event.bearing_rad).tolist() == pytest.approx([90.0])
    assert event.intensity.shape == (10, 1)
    assert event.range_m[np.argmax(event.intensity)] == pytest.approx(2.75)
    assert event.range_max_m == 5.0


def test_angles_of_a_ping360_wrap_and_have_a_unit():
    name = "ping360_sonar_msgs/msg/SonarEcho"
    (event,) = read(name, echo(angle=3.5))
    assert event.bearing_rad[0] == pytest.approx(3.5 - 2.0 * np.pi)
    (event,) = read(name, echo(angle=100.0), replace(SETTINGS, sonar_angle_unit="gradian"))
    assert np.degrees(event.bearing_rad[0]) == pytest.approx(90.0)
    with pytest.raises(InvalidInputError, match=r"angle is 100.0 radian.* sonar_angle_unit"):
        read(name, echo(angle=100.0))
    with pytest.raises(InvalidInputError, match="range is 0"):
        read(name, echo(range=0))
    assert read(name, echo(intensities=[])) == ()


def scan(ranges, **changes):
    fields = {
        "header": header(),
        "angle_min": -0.5,
        "angle_max": 0.5,
        "angle_increment": 0.25,
        "time_increment": 0.0,
        "scan_time": 0.0,
        "range_min": 0.3,
        "range_max": 20.0,
        "ranges": np.array(ranges, np.float32),
        "intensities": np.empty(0, np.float32),
    }
    return Msg(**fields | changes)


LASER = "sensor_msgs/msg/LaserScan"


def test_a_fan_keeps_inf_and_drops_what_is_too_near():
    (event,) = read(LASER, scan([0.1, 5.0, np.inf, np.nan], scan_time=2.0))
    assert isinstance(event, ScanEvent)  # of one moment: scan_time is that to the next one
    assert event.angles_rad.tolist() == [-0.5, -0.25, 0.0, 0.25]
    np.testing.assert_array_equal(event.ranges_m, [np.nan, 5.0, np.inf, np.nan])
    assert event.range_max_m == 20.0


def test_rays_of_a_slow_scan_have_their_own_time():
    (event,) = read(LASER, scan([4.0, 5.0, 6.0], time_increment=1.0))
    assert isinstance(event, BeamsEvent)
    assert (event.beam_stamp_ns - STAMP_NS).tolist() == [0, SECOND, 2 * SECOND]
    assert event.bearing_rad.tolist() == [-0.5, -0.25, 0.0]
    assert event.range_m.tolist() == [4.0, 5.0, 6.0]
    assert event.intensity is None


@pytest.mark.parametrize("seconds", [14, 1])
def test_a_turn_without_times_takes_as_long_as_it_is_to_the_next(seconds):
    told = []
    settings = replace(SETTINGS, tell=told.append, memory={})
    found = []
    for number in range(3):
        turn = scan(np.full(8, 4.0), angle_increment=np.pi / 4)
        turn.header.stamp.sec += seconds * number
        found.append(read(LASER, turn, settings))
    for number in range(3):
        (event,) = found[number]
        # Of the first nobody knows yet.
        assert isinstance(event, BeamsEvent if seconds == 14 and number else ScanEvent)
        assert event.stamp_ns == STAMP_NS + seconds * number * SECOND
        if isinstance(event, BeamsEvent):
            np.testing.assert_allclose(np.diff(event.beam_stamp_ns) / SECOND, 14.0 / 8.0)
    assert [finding.kind for finding in told] == ["scan_times"] * (seconds == 14)


def test_a_turn_is_spread_over_its_scan_time():
    ranges = np.arange(1.0, 9.0)
    turn = scan(ranges, angle_increment=np.pi / 4, scan_time=16.0)
    (event,) = read(LASER, turn)
    assert (event.beam_stamp_ns - STAMP_NS).tolist() == [2 * i * SECOND for i in range(8)]
    # A driver that stamps the end, turns the other way, and says nothing of the time.
    settings = replace(SETTINGS, scan_period_s=8.0, scan_stamp="last")
    (event,) = read(LASER, scan(ranges, angle_increment=-np.pi / 4), settings)
    assert (event.beam_stamp_ns - STAMP_NS).tolist() == [(i - 7) * SECOND for i in range(8)]
    assert event.stamp_ns == STAMP_NS - 7 * SECOND
    assert event.bearing_rad[1] < event.bearing_rad[0]


def test_a_scan_that_runs_backwards_is_put_in_order():
    (event,) = read(LASER, scan([4.0, 5.0, 6.0], time_increment=-1.0))
    assert event.range_m.tolist() == [6.0, 5.0, 4.0]
    assert (np.diff(event.beam_stamp_ns) > 0).all()


def test_one_ray_is_a_beam():
    (event,) = read(LASER, scan([4.0], angle_min=1.0))
    assert isinstance(event, BeamsEvent)
    assert (event.bearing_rad.tolist(), event.range_m.tolist()) == ([1.0], [4.0])


def test_one_ray_with_the_profile_of_its_echo():
    profile = np.zeros(10, np.float32)
    profile[5] = 200.0
    msg = scan([], angle_min=1.0, range_min=0.0, range_max=5.0, intensities=profile)
    (event,) = read(LASER, msg)
    assert event.bearing_rad.tolist() == [1.0]
    assert event.intensity.dtype == np.uint8
    assert event.range_m[np.argmax(event.intensity)] == pytest.approx(2.75)


def test_a_scan_says_what_is_wrong():
    with pytest.raises(InvalidInputError, match="angle_increment"):
        read(LASER, scan([1.0], angle_increment=np.nan))
    with pytest.raises(InvalidInputError, match="time_increment"):
        read(LASER, scan([1.0, 2.0], time_increment=np.inf))
    with pytest.raises(InvalidInputError, match="range_min < range_max"):
        read(LASER, scan([], range_max=0.0, intensities=np.ones(10)))
    assert read(LASER, scan([])) == ()


CLOUD = "sensor_msgs/msg/PointCloud2"
_CODES = {"f4": 7, "f8": 8, "u4": 6}


def cloud(fields, rows, is_bigendian=False):
    """A ``PointCloud2`` with these fields (name, type) and rows."""
    order = ">" if is_bigendian else "<"
    dtype = np.dtype([(name, order + kind) for name, kind in fields])
    data = np.array([tuple(row) for row in rows], dtype)
    return Msg(
        header=header(),
        height=1,
        width=len(rows),
        fields=[
            Msg(name=name, offset=dtype.fields[name][1], datatype=_CODES[kind], count=1)
            for name, kind in fields
        ],
        is_bigendian=is_bigendian,
        point_step=dtype.itemsize,
        row_step=dtype.itemsize * len(rows),
        data=data.view(np.uint8).reshape(-1) if len(rows) else np.empty(0, np.uint8),
        is_dense=True,
    )


XYZ = [("x", "f4"), ("y", "f4"), ("z", "f4")]


@pytest.mark.parametrize("is_bigendian", [False, True])
def test_points_of_space_come_with_a_gate(is_bigendian):
    rows = [(4, 3, 0.5), (5, 0, -3.0), (np.nan, 0, 0), (1, -2, 0)]
    (event,) = read(CLOUD, cloud(XYZ, rows, is_bigendian))
    assert isinstance(event, PointsEvent)
    assert event.points.tolist() == [[4.0, 3.0, 0.5], [5.0, 0.0, -3.0], [1.0, -2.0, 0.0]]
    assert event.max_height_m == 1.0
    (event,) = read(CLOUD, cloud(XYZ, rows[2:]))
    assert event.points.tolist() == [[1.0, -2.0]]


def test_the_sea_bed_is_no_beam():
    rows = [(4, 3, 0.5, 0.0), (5, 0, -3.0, 1.0), (0, 2, 0.0, 2.0)]
    (event,) = read(CLOUD, cloud([*XYZ, ("t", "f4")], rows))
    assert event.range_m.tolist() == [5.0, 2.0]
    bed = [(4, 3, -3.0, 0.0), (5, 0, -3.0, 1.0)]
    (event,) = read(CLOUD, cloud([*XYZ, ("t", "f4")], bed))
    assert isinstance(event, PointsEvent)
    assert len(event.points) == 0


@pytest.mark.parametrize(
    ("name", "kind", "values"),
    [
        ("t", "f4", [0.0, 2.0, 1.0]),
        ("time", "u4", [0, 2_000_000_000, 1_000_000_000]),
        ("timestamp", "f8", [1.7e9, 1.7e9 + 2.0, 1.7e9 + 1.0]),
        ("timestamp", "f8", [1.7e18, 1.7e18 + 2e9, 1.7e18 + 1e9]),
        ("stamp", "f8", [1.7e15, 1.7e15 + 2e6, 1.7e15 + 1e6]),
        ("timestamp", "f8", [1.7e9 + 3600.0, 1.7e9 + 3602.0, 1.7e9 + 3601.0]),  # another clock
        ("t", "f4", [-2.0, 0.0, -1.0]),  # from the end
    ],
)
def test_points_with_times_are_beams(name, kind, values):
    rows = [(4, 3, 0, values[0]), (0, 6, 0, values[1]), (5, 0, 0, values[2])]
    msg = cloud([*XYZ, (name, kind)], rows)
    if kind == "f8":
        msg.header.stamp.sec = 1_700_000_000
    (event,) = read(CLOUD, msg)
    assert isinstance(event, BeamsEvent)
    offsets = (event.beam_stamp_ns - event.beam_stamp_ns[0]) * 1e-9
    np.testing.assert_allclose(offsets, [0.0, 1.0, 2.0], atol=1e-6)
    if kind == "f8":
        assert event.stamp_ns == pytest.approx(1_700_000_000 * SECOND, abs=2 * SECOND)
    np.testing.assert_allclose(event.range_m, [5.0, 5.0, 6.0])
    np.testing.assert_allclose(np.degrees(event.bearing_rad), [36.8699, 0.0, 90.0], atol=1e-3)
    assert (event.range_m < event.range_max_m).all()


def test_times_of_one_moment_are_left_out():
    rows = [(4, 3, 0, 0.0), (0, 6, 0, 0.01)]
    (event,) = read(CLOUD, cloud([*XYZ, ("t", "f4")], rows))
    assert isinstance(event, PointsEvent)


def test_times_without_the_digits_they_need_are_left_out():
    rows = [(4, 3, 0, 1.7e9), (0, 6, 0, 1.7e9 + 128.0)]
    msg = cloud([*XYZ, ("timestamp", "f4")], rows)
    msg.header.stamp.sec = 1_700_000_000
    assert isinstance(read(CLOUD, msg)[0], PointsEvent)


@pytest.mark.parametrize("name", ["intensity", "i", "amplitude"])
@pytest.mark.parametrize("bearings", [[40.0], list(range(-60, 60, 2))])
def test_bins_of_beams_are_no_points(name, bearings):
    rows = [
        (r * np.cos(b), r * np.sin(b), 0.0, 200.0 if r == 3.0 else 4.0)
        for b in np.radians(bearings)
        for r in np.arange(0.5, 6.0, 0.5)
    ]
    (event,) = read(CLOUD, cloud([*XYZ, (name, "f4")], rows))
    assert isinstance(event, BeamsEvent if len(bearings) == 1 else ImageEvent)
    seen = event if isinstance(event, BeamsEvent) else event.image
    np.testing.assert_allclose(np.degrees(seen.bearing_rad), bearings, atol=1e-4)
    np.testing.assert_allclose(seen.range_m[np.argmax(seen.intensity, axis=0)], 3.0, atol=1e-5)


def test_echoes_with_an_intensity_are_points():
    """Also where a wall recedes from beam to beam, so that their ranges rise."""
    bearing = np.linspace(0.2, 1.2, 30)
    rows = [(4.0, 4.0 * np.tan(b), 0.0, 50.0) for b in bearing]
    (event,) = read(CLOUD, cloud([*XYZ, ("intensity", "f4")], rows))
    assert isinstance(event, PointsEvent)
    assert len(event.points) == 30


def test_an_organised_cloud_keeps_the_beams_that_heard_something():
    rows = [(4, 3, 0), (np.nan, np.nan, np.nan), (5, 0, 0), (np.inf, 0, 0)]
    msg = cloud(XYZ, rows)
    msg.height, msg.width, msg.row_step = 2, 2, 2 * msg.point_step
    assert read(CLOUD, msg)[0].points.tolist() == [[4.0, 3.0], [5.0, 0.0]]


def test_cloud_with_padding():
    make = MessageFactory(make_typestore())
    msg = make.points(0, "sonar", [[1.0, -2.0], [np.nan, 0.0], [3.0, 4.0]])
    assert read(CLOUD, msg)[0].points.tolist() == [[1.0, -2.0], [3.0, 4.0]]
    rows = np.zeros((3, 20), np.uint8)
    rows[:, 4:16] = np.asarray(msg.data).reshape(3, 12)
    for field in msg.fields:
        field.offset += 4
    padded = replace(msg, point_step=20, row_step=60, data=rows.reshape(-1))
    assert read(CLOUD, padded)[0].points.tolist() == [[1.0, -2.0], [3.0, 4.0]]
    with pytest.raises(InvalidInputError, match="data has 59 bytes"):
        read(CLOUD, replace(padded, data=rows.reshape(-1)[:-1]))
    with pytest.raises(InvalidInputError, match="no field 'y'"):
        read(CLOUD, replace(msg, fields=msg.fields[:1]))
    assert read(CLOUD, make.points(0, "sonar", np.empty((0, 2))))[0].points.shape == (0, 2)


OLD = "sensor_msgs/msg/PointCloud"


def micron(bearings_deg, num_bins=10, **changes):
    points, values = [], []
    for bearing in np.radians(bearings_deg):
        for k in range(1, num_bins + 1):
            points.append(Msg(x=0.5 * k * np.cos(bearing), y=0.5 * k * np.sin(bearing), z=0.0))
            values.append(200.0 if k == 6 else 3.0)
    fields = {
        "header": header(),
        "points": points,
        "channels": [Msg(name="intensity", values=np.array(values, np.float32))],
    }
    return Msg(**fields | changes)


@pytest.mark.parametrize("bearings", [[40.0], [40.0, 35.0, -10.0]])
def test_a_beam_or_a_sector_of_a_micron(bearings):
    (event,) = read(OLD, micron(bearings))
    assert isinstance(event, BeamsEvent)
    np.testing.assert_allclose(np.degrees(event.bearing_rad), bearings)
    assert event.intensity.shape == (10, len(bearings))
    assert event.intensity.dtype == np.uint8
    np.testing.assert_allclose(event.range_m[np.argmax(event.intensity, axis=0)], 3.0)
    assert event.range_max_m == pytest.approx(5.25)


def test_an_old_cloud_of_echoes():
    points = [Msg(x=4.0, y=3.0, z=0.0), Msg(x=np.nan, y=0.0, z=0.0), Msg(x=0.0, y=-2.0, z=0.0)]
    (event,) = read(OLD, Msg(header=header(), points=points, channels=[]))
    assert event.points.tolist() == [[4.0, 3.0], [0.0, -2.0]]
    assert read(OLD, Msg(header=header(), points=[], channels=[])) == ()
    with pytest.raises(InvalidInputError, match=r"channels\[intensity\] has 1 values"):
        read(OLD, micron([1.0], channels=[Msg(name="intensity", values=[1.0])]))


def test_a_scan_without_a_maximum_takes_the_longest_range():
    settings = replace(SETTINGS, memory={})
    adapter = adapter_of(LASER)
    fan = {"angle_increment": 0.01, "time_increment": 0.0, "scan_time": 0.0, "range_max": 0.0}
    assert adapter.read(scan([np.inf, np.nan, 0.0], range_min=0.1, **fan), settings) == ()
    (first,) = adapter.read(scan([4.0, np.inf, 7.0], **fan), settings)
    (second,) = adapter.read(scan([2.0, np.inf, 3.0], **fan), settings)
    assert first.range_max_m == second.range_max_m == pytest.approx(7.0, rel=0.01)
    assert first.range_max_m > 7.0
