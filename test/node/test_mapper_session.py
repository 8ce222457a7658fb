"""A mapper that is killed and started again goes on with its run, or begins another."""

import dataclasses
from contextlib import closing

import numpy as np
import pytest

pytest.importorskip("rclpy")

from node.drives import SPEED_M_S, START_NS, Vehicle, drive, finish, mapper_of

from uw_dslam_ros2.core.chart.redraw import redrawn
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.mapping import OccupancyConfig, VehicleMapperConfig
from uw_dslam_ros2.core.navigation import filter
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap
from uw_dslam_ros2.io.sessions.kept_runs import KeptRuns
from uw_dslam_ros2.ros.convert.core_types import submap_from_msg
from uw_dslam_ros2.ros.mapper.run_keeper import RunKeeper

pytestmark = pytest.mark.ros

_CONFIG = VehicleMapperConfig(occupancy=OccupancyConfig(resolution_m=0.1))


def placed(submaps):
    """Where submaps and their paths lie, as numbers (N, 3)."""
    return np.vstack([[s.T_odom_submap.as_array(), *s.trajectory] for s in submaps])


def submap_of(state):
    """The submap that was open, closed."""
    grid = OccupancyMap(GridSpec(0.1, 1, 1), np.full((1, 1), -1, np.int8))
    section = state.section
    return Submap(
        "auv_1", state.sequence, 0, True, state.last_ping_ns, SE2(), np.eye(3), grid,
        trajectory=section.trajectory, trajectory_stamp_ns=section.stamps_ns, run_id=state.run_id,
    )  # fmt: skip


@pytest.fixture
def killed(ros_context, spinning, tmp_path):
    """Vehicle, and a mapper with an open submap that was killed after four seconds."""
    vehicle, mapper = Vehicle(ros_context), mapper_of(ros_context, session=str(tmp_path))
    with spinning(mapper) as until:
        until(vehicle.is_connected, "connection")
        vehicle.send_mount()
        drive(until, vehicle, range(4))
        pipeline = mapper._pipeline
        until(lambda: pipeline._runs.mapper.num_pings == 8, "the pings")
        mapper._say_last = lambda: None  # a process that is killed says no last word
        mapper._worker.call(pipeline.flush).result()
        state = pipeline._runs.mapper.state()
        pipeline.is_finished = True
    return vehicle, state, pipeline._last_pass.pings.of_submap


def test_the_next_mapper_goes_on_with_the_run(killed, ros_context, spinning, tmp_path):
    vehicle, state, _ = killed
    assert list(tmp_path.glob("run_*")) == []  # no submap has closed yet
    mapper = mapper_of(ros_context, session=str(tmp_path))
    with spinning(mapper, vehicle.node) as until:
        until(vehicle.is_connected, "connection")
        vehicle.send_mount()
        drive(until, vehicle, range(6, 10))  # two seconds are missing
        until(lambda: mapper._pipeline._runs.mapper.num_pings == 16, "the pings")
        message = finish(until, vehicle).message
        assert "2 submaps, 2 of them drawn anew; 0 bad" in message
        until(lambda: len(vehicle.submaps) >= 4, "both submaps, and both drawn anew")
    first, second = (submap_from_msg(msg) for msg in vehicle.submaps[-2:])
    assert [(s.run_id, s.sequence) for s in (first, second)] == [(state.run_id, i) for i in (0, 1)]
    assert len(first.trajectory) + len(second.trajectory) == 16
    # It has gone on at half a metre per second.
    x_m = [s.T_odom_submap.apply(s.trajectory[:, :2])[:, 0] for s in (first, second)]
    stamps_s = [(s.trajectory_stamp_ns - START_NS) * 1e-9 for s in (first, second)]
    np.testing.assert_allclose(
        np.concatenate(x_m) - x_m[0][0], SPEED_M_S * np.concatenate(stamps_s), atol=0.1
    )
    assert list(tmp_path.glob("run_*")) == list(tmp_path.glob("open_submap")) == []


def test_after_a_long_time_a_new_run_begins_and_nothing_is_lost(
    killed, ros_context, spinning, tmp_path
):
    vehicle, state, pings = killed
    mapper = mapper_of(ros_context, session=str(tmp_path))
    with spinning(mapper, vehicle.node) as until:
        until(vehicle.is_connected, "connection")
        vehicle.send_mount()
        drive(until, vehicle, range(20, 24))
        until(lambda: len(vehicle.submaps) == 1, "the submap that was open")
        until(lambda: mapper._pipeline._runs.mapper.num_pings == 8, "the pings")
        assert "2 submaps, 2 of them drawn anew; 0 bad" in finish(until, vehicle).message
        until(lambda: len(vehicle.submaps) >= 4, "the other one, and both drawn anew")
    given, earlier, own = (submap_from_msg(vehicle.submaps[i]) for i in (0, -2, -1))
    assert given.run_id == earlier.run_id == state.run_id != own.run_id
    assert (given.revision, earlier.revision, own.revision) == (0, 1, 1)
    assert len(earlier.trajectory) == len(own.trajectory) == 8
    assert list(tmp_path.glob("run_*")) == list(tmp_path.glob("open_submap")) == []

    (expected,) = redrawn([given], pings, _CONFIG.occupancy)
    np.testing.assert_array_equal(placed([earlier]), placed([expected]))
    np.testing.assert_array_equal(earlier.grid.values, expected.grid.values)


def test_what_was_mapped_with_other_settings_is_drawn_anew_as_it_is(
    killed, ros_context, spinning, tmp_path
):
    vehicle, state, pings = killed
    with closing(KeptRuns(tmp_path)) as kept:
        kept.save([submap_of(state)], pings)
    mapper = mapper_of(ros_context, session=str(tmp_path), **{"mapper.submap.min_pings": 4})
    with spinning(mapper, vehicle.node) as until:
        until(vehicle.is_connected, "connection")
        vehicle.send_mount()
        drive(until, vehicle, range(5, 9))
        until(lambda: mapper._pipeline._runs.mapper.num_pings == 8, "the pings")
        message = finish(until, vehicle).message
        # That what had come into the open submap is lost is told, as what is damaged is.
        assert "1 of them drawn anew, and 1 of before it was started; 1 bad" in message


def test_a_state_of_another_version_begins_a_new_run(
    killed, ros_context, spinning, tmp_path, monkeypatch
):
    _, state, pings = killed
    with closing(KeptRuns(tmp_path)) as kept:
        kept.save([submap_of(state)], pings)
    monkeypatch.setattr(filter, "NUM_STATES", filter.NUM_STATES + 1)
    mapper = mapper_of(ros_context, session=str(tmp_path))
    with spinning(mapper):
        mapper._worker.call(lambda: None).result()
        assert mapper._pipeline._runs.mapper.run_id != state.run_id
        assert len(mapper._pipeline._keeper._runs.earlier) == 1


def test_a_disk_that_takes_nothing_stops_no_mapping(ros_context, spinning, tmp_path):
    away = tmp_path / "disk"
    away.write_text("a file, and no folder")
    vehicle, mapper = Vehicle(ros_context), mapper_of(ros_context, session=str(away / "auv_1"))
    with spinning(mapper, vehicle.node) as until:
        until(vehicle.is_connected, "connection")
        until(lambda: "cannot write to the session" in vehicle.message(), "the complaint")
        vehicle.send_mount()
        drive(until, vehicle, range(4))
        assert "1 submaps, 1 of them drawn anew" in finish(until, vehicle).message


def test_what_the_disk_did_not_take_is_kept_when_it_is_back(killed, tmp_path):
    _, state, pings = killed
    submap = submap_of(state)
    away, complaints = tmp_path / "disk", []
    away.write_text("a file, and no folder")
    keeper = RunKeeper(str(away / "auv_1"), "auv_1", _CONFIG, complaints.append)
    keeper.keep([submap], pings)
    assert len(complaints) == 2
    away.unlink()
    keeper.keep([dataclasses.replace(submap, sequence=1)], pings)
    keeper.close()
    assert len(complaints) == 2
    with closing(KeptRuns(away / "auv_1")) as kept:
        found, found_pings = kept.load(*kept.earlier)
    assert [s.sequence for s in found] == [0, 1]
    assert len(found_pings[submap.submap_id]) == len(pings[submap.submap_id]) > 0
