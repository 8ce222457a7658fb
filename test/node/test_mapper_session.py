"""A mapper that is killed and started again: what it kept is drawn anew as if it had gone on."""

import dataclasses
from contextlib import closing

import numpy as np
import pytest

pytest.importorskip("rclpy")

from node.drives import Vehicle, drive, finish, mapper_of

from uw_dslam_ros2.core.chart.redraw import redrawn
from uw_dslam_ros2.core.mapping import OccupancyConfig
from uw_dslam_ros2.io.sessions.kept_runs import KeptRuns
from uw_dslam_ros2.ros.convert.core_types import submap_from_msg
from uw_dslam_ros2.ros.mapper.run_keeper import RunKeeper

pytestmark = pytest.mark.ros

_OCCUPANCY = OccupancyConfig(resolution_m=0.1)


def placed(submaps):
    """Where submaps and their paths lie, as numbers (N, 3)."""
    return np.vstack([[s.T_odom_submap.as_array(), *s.trajectory] for s in submaps])


@pytest.fixture
def killed(ros_context, spinning, tmp_path):
    """Vehicle, and what a mapper held in memory when it was killed: its submaps and pings."""
    vehicle, mapper = Vehicle(ros_context), mapper_of(ros_context, session=str(tmp_path))
    with spinning(mapper) as until:
        until(vehicle.is_connected, "connection")
        vehicle.send_mount()
        drive(until, vehicle, range(4))
        pipeline = mapper._pipeline
        until(lambda: pipeline._runs.mapper.num_pings == 8, "the pings")
        # As if killed: no last word.
        mapper._worker.call(pipeline.close_last).result()
    (mapped,) = pipeline._runs.mappers()
    return vehicle, mapped.submaps(), pipeline._last_pass.pings.of_submap


def test_the_next_mapper_draws_it_anew_as_the_killed_one_would_have(
    killed, ros_context, spinning, tmp_path
):
    vehicle, submaps, pings = killed
    (kept,) = tmp_path.glob("run_*.sqlite")
    assert kept.name == f"run_{submaps[0].run_id}.sqlite"
    mapper = mapper_of(ros_context, session=str(tmp_path))
    with spinning(mapper, vehicle.node) as until:
        until(vehicle.is_connected, "connection")
        vehicle.send_mount()
        drive(until, vehicle, range(20, 24))
        until(lambda: mapper._pipeline._runs.mapper.num_pings == 8, "the pings")
        message = finish(until, vehicle).message
        assert "1 of them drawn anew, and 1 of before it was started; 0 bad" in message
        until(lambda: len({msg.run_id for msg in vehicle.submaps}) == 2, "both runs")
        until(lambda: [msg.revision for msg in vehicle.submaps[-2:]] == [1, 1], "drawn anew")
    own, earlier = (submap_from_msg(msg) for msg in vehicle.submaps[-2:])
    assert len(earlier.trajectory) == len(own.trajectory) == 8
    assert list(tmp_path.glob("run_*")) == []

    (expected,) = redrawn(submaps, pings, _OCCUPANCY)
    assert earlier.submap_id == expected.submap_id
    np.testing.assert_array_equal(placed([earlier]), placed([expected]))
    np.testing.assert_array_equal(earlier.grid.values, expected.grid.values)


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
    _, (submap,), pings = killed
    away, complaints = tmp_path / "disk", []
    away.write_text("a file, and no folder")
    keeper = RunKeeper(str(away / "auv_1"), _OCCUPANCY, complaints.append)
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
