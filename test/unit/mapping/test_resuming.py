"""A mapper that goes on from a state comes to what one that was never interrupted comes to."""

import dataclasses

import numpy as np
import pytest
from unit.chart.test_redraw import _BEARINGS, _CONFIG, ranges_in_room, there_and_back

from uw_dslam_ros2.core.chart.pings import KeptPings
from uw_dslam_ros2.core.mapping import LoopConfig, VehicleMapper
from uw_dslam_ros2.core.mapping.mapper_state import HeldSubmaps
from uw_dslam_ros2.core.se2 import SE2

_S = 1_000_000_000


def drive(mapper, pings):
    """The navigation and the scans of some pings of the way; what was given away meanwhile."""
    rng, issued = np.random.default_rng(1), []
    poses = there_and_back()
    for i in pings:
        pose, stamp_ns = poses[i], i * _S // 2
        way = np.diff(poses[max(0, i - 1) : i + 1, :2], axis=0).sum(axis=0) / 0.5
        v_body = SE2(0.0, 0.0, pose[2]).inverse().apply(way)
        mapper.add_imu(stamp_ns, pose[2], 0.0, 0.002)
        mapper.add_velocity(stamp_ns, v_body, 1e-4 * np.eye(2))
        issued += mapper.add_scan(stamp_ns, _BEARINGS, ranges_in_room(pose, rng), 40.0, SE2())
    return issued


def begun(num_pings, config=_CONFIG):
    kept = KeptPings()
    mapper = VehicleMapper(config, "auv_1", 77, kept)
    drive(mapper, range(num_pings))
    return mapper, kept


def resumed(mapper, kept, config=_CONFIG):
    """Another mapper in its place, as it is read from a disk."""
    state = mapper.state()
    closed = [(submap, np.ones(len(submap.points))) for submap in mapper.submaps()]
    own = [pings for key, pings in kept.of_submap.items() if key.sequence == state.sequence]
    drawn = [(ping.detections(), ping.T_submap_sonar) for pings in own for ping in pings]
    later = VehicleMapper(config, "auv_1", state.run_id)
    later.resume(state, HeldSubmaps(closed, drawn))
    return later


def whole():
    mapper, _ = begun(160)
    mapper.finish()
    return mapper


@pytest.mark.parametrize("num_lost", [0, 3])
def test_the_run_goes_on_as_if_nothing_had_been(num_lost):
    mapper, kept = begun(70)
    later = resumed(mapper, kept)
    T_odom_base = mapper.T_odom_base.as_array()
    np.testing.assert_allclose(later.T_odom_base.as_array(), T_odom_base, atol=1e-12)
    np.testing.assert_array_equal(later.pose_covariance, mapper.pose_covariance)
    issued = drive(later, range(70 + num_lost, 160)) + later.finish()
    expected = whole()

    assert later.run_id == 77
    numbers = [s.sequence for s in later.submaps()]
    assert numbers == list(range(len(numbers)))
    assert {s.sequence for s in issued} == set(numbers[len(mapper.submaps()) :])
    stamps_ns, poses = later.trajectory()
    kept_ones = np.isin(expected.trajectory()[0], stamps_ns)
    assert len(stamps_ns) == later.num_pings == 160 - num_lost
    # The way between is that of navigation: nothing else places these scans.
    np.testing.assert_allclose(poses, expected.trajectory()[1][kept_ones], atol=0.01)


@pytest.mark.parametrize("estimator", ["scan_matching", "particle_filter"])
def test_every_estimator_goes_on(estimator):
    config = dataclasses.replace(_CONFIG, estimator=estimator, loop=LoopConfig())
    mapper, kept = begun(70, config)
    later = resumed(mapper, kept, config)
    drive(later, range(73, 160))
    later.finish()
    expected, _ = begun(160, config)
    expected.finish()
    stamps_ns, poses = later.trajectory()
    kept_ones = np.isin(expected.trajectory()[0], stamps_ns)
    np.testing.assert_allclose(poses, expected.trajectory()[1][kept_ones], atol=0.1)


def test_what_was_open_is_drawn_as_it_was():
    mapper, kept = begun(70)
    later = resumed(mapper, kept)
    one, other = mapper.finish()[-1], later.finish()[-1]
    assert one.submap_id == other.submap_id
    T_odom_submap = one.T_odom_submap.as_array()
    np.testing.assert_allclose(other.T_odom_submap.as_array(), T_odom_submap, atol=1e-12)
    assert one.grid.spec == other.grid.spec
    # Echoes are kept in single precision.
    assert np.mean(one.grid.values != other.grid.values) < 0.001
    np.testing.assert_array_equal(one.trajectory, other.trajectory)
    np.testing.assert_allclose(one.points, other.points, atol=1e-9)
    np.testing.assert_array_equal(one.covariance, other.covariance)


def test_a_long_way_without_messages_lies_between_two_submaps():
    mapper, kept = begun(70)
    soon, late = resumed(mapper, kept), resumed(mapper, kept)
    num = len(mapper.submaps())
    for later, first in ((soon, 70), (late, 78)):
        drive(later, range(first, 100))
        later.finish()
    sigma_m = [np.sqrt(m.submaps()[num + 1].covariance[0, 0]) for m in (soon, late)]
    assert sigma_m[1] > 2.0 * sigma_m[0]


def test_a_few_pings_are_no_submap_of_their_own():
    mapper, kept = begun(2)
    later = resumed(mapper, kept)
    drive(later, range(2, 20))
    (submap,) = later.finish()
    assert len(submap.trajectory) == 20


def test_late_messages_stay_late():
    mapper, kept = begun(70)
    later = resumed(mapper, kept)
    drive(later, range(60, 70))
    assert later.num_pings == 70
    assert later.diagnostics()["num_pings_dropped"] == 10
