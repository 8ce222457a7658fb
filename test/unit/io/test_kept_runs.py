"""What a mapper keeps of a run comes back as it was given away last."""

import dataclasses
import sqlite3
from contextlib import closing

import numpy as np
import pytest
from unit.chart.test_redraw import _CONFIG, mapped
from unit.mapping.test_resuming import drive

from uw_dslam_ros2.core.chart.pings import DrawnPing, KeptPings
from uw_dslam_ros2.core.chart.redraw import redrawn
from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.mapping import VehicleMapper
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap
from uw_dslam_ros2.io.sessions import kept_runs
from uw_dslam_ros2.io.sessions.array_files import arrays_to_bytes
from uw_dslam_ros2.io.sessions.folder_lock import SessionInUseError
from uw_dslam_ros2.io.sessions.kept_runs import KeptRuns

RUN_ID = 77


def submap_of(rng, sequence):
    return Submap(
        vehicle_id="auv_1",
        sequence=sequence,
        revision=0,
        is_final=True,
        stamp_ns=5 * sequence,
        T_odom_submap=SE2(*rng.normal(size=3)),
        covariance=np.diag(rng.random(3)),
        grid=OccupancyMap(GridSpec(0.1, 30, 40), rng.integers(-1, 101, (30, 40)).astype(np.int8)),
        points=rng.normal(size=(5, 2)),
        trajectory=rng.normal(size=(4, 3)),
        trajectory_stamp_ns=np.arange(4, dtype=np.int64),
        run_id=RUN_ID,
    )


def ping_of(rng, stamp_ns, bearing_rad, num_points):
    return DrawnPing(
        stamp_ns,
        SE2(*rng.normal(size=3)),
        rng.normal(size=(num_points, 2)).astype(np.float32),
        rng.random(num_points).astype(np.float32),
        bearing_rad,
        rng.random(len(bearing_rad)).astype(np.float32),
        0.01,
        0.05,
        SE2(*rng.normal(size=3)) if num_points else None,
    )


@pytest.fixture
def run(rng):
    """Three submaps, of which the last has no pings, and those of the others."""
    submaps = [submap_of(rng, sequence) for sequence in range(3)]
    fan, turn = np.linspace(-1.0, 1.0, 7), np.linspace(-3.0, 3.0, 4)
    pings = {
        submaps[0].submap_id: [ping_of(rng, t, fan, n) for t, n in ((1, 3), (2, 0), (3, 6))],
        submaps[1].submap_id: [ping_of(rng, 4, fan, 2), ping_of(rng, 5, turn, 1)],
    }
    return submaps, pings


def assert_equal(found, expected):
    for name in (field.name for field in dataclasses.fields(expected)):
        one, other = getattr(found, name), getattr(expected, name)
        if isinstance(other, np.ndarray):
            assert one.dtype == other.dtype, name
            np.testing.assert_array_equal(one, other)
        elif name == "grid":
            assert one.spec == other.spec
            np.testing.assert_array_equal(one.values, other.values)
        else:
            assert one == other, name


def test_a_run_comes_back_with_its_pings_and_its_last_poses(run, rng, tmp_path):
    submaps, pings = run
    kept = KeptRuns(tmp_path)
    kept.save(submaps[:2], pings)
    moved = dataclasses.replace(submaps[0], revision=4, T_odom_submap=SE2(*rng.normal(size=3)))
    kept.save([moved, submaps[2]], pings)
    kept.close()

    with closing(KeptRuns(tmp_path)) as later:
        (path,) = later.earlier
        found, found_pings = later.load(path)
    for one, other in zip(found, [moved, *submaps[1:]], strict=True):
        assert_equal(one, other)
    for submap in submaps:
        of_it = found_pings[submap.submap_id]
        for one, other in zip(of_it, pings.get(submap.submap_id, []), strict=True):
            assert_equal(one, other)
    # What one sonar's pings have in common takes memory once.
    first, second, _ = found_pings[submaps[0].submap_id]
    assert first.bearing_rad is second.bearing_rad


def test_a_run_that_comes_back_is_drawn_anew_as_from_memory(tmp_path):
    mapper, memory, _ = mapped()
    pings = memory.of_submap
    with closing(KeptRuns(tmp_path)) as kept:
        kept.save(mapper.submaps(), pings)
        (path,) = tmp_path.glob("run_*.sqlite")
        found = redrawn(*kept.load(path), _CONFIG.occupancy)
    for one, other in zip(found, redrawn(mapper.submaps(), pings, _CONFIG.occupancy), strict=True):
        assert_equal(one, other)
    # What instruments alone say of the way is part of that.
    without = {
        submap_id: [dataclasses.replace(ping, T_dead_sonar=None) for ping in of_it]
        for submap_id, of_it in pings.items()
    }
    others = redrawn(mapper.submaps(), without, _CONFIG.occupancy)
    assert [s.T_odom_submap for s in others] != [s.T_odom_submap for s in found]


def test_a_file_of_before_dead_reckoning_was_kept_is_read(run, tmp_path, monkeypatch):
    submaps, pings = run

    def as_before(arrays):
        return arrays_to_bytes({n: a for n, a in arrays.items() if n != "T_dead_sonar"})

    monkeypatch.setattr(kept_runs, "arrays_to_bytes", as_before)
    with closing(KeptRuns(tmp_path)) as kept:
        kept.save(submaps, pings)
        (path,) = tmp_path.glob("run_*.sqlite")
        _, found = kept.load(path)
    for submap_id, of_it in pings.items():
        for one, other in zip(found[submap_id], of_it, strict=True):
            assert_equal(one, dataclasses.replace(other, T_dead_sonar=None))


def test_a_damaged_run_is_named(run, tmp_path):
    kept = KeptRuns(tmp_path)
    kept.save(*run)
    (path,) = tmp_path.glob("run_*.sqlite")
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with closing(kept), pytest.raises(DataError, match=f"{path.name} is not a whole run"):
        kept.load(path)


def test_two_mappers_do_not_share_a_folder(tmp_path):
    kept = KeptRuns(tmp_path)
    with pytest.raises(SessionInUseError, match="give each mapper a folder of its own"):
        KeptRuns(tmp_path)
    kept.close()
    KeptRuns(tmp_path).close()


def test_what_is_forgotten_is_gone(run, tmp_path):
    kept = KeptRuns(tmp_path)
    kept.save(*run)
    kept.close()
    later = KeptRuns(tmp_path)
    later.save([dataclasses.replace(run[0][0], run_id=78)], {})
    later.forget(later.earlier[0])
    assert [path.name for path in tmp_path.glob("run_*")] == ["run_78.sqlite"]
    later.forget_own()
    assert list(tmp_path.glob("run_*")) == []
    assert later.earlier == []
    later.close()


SETUP = b"settings of one!"


def killed_in(folder, num_pings=70):
    """A mapper whose process was killed after a ping, with all that it kept on the way."""
    pings = KeptPings()
    mapper, kept = VehicleMapper(_CONFIG, "auv_1", RUN_ID, pings), KeptRuns(folder)
    for i in range(num_pings):
        kept.save(drive(mapper, [i]), pings.of_submap)
        if i % 7 == 6:
            kept.save_open(mapper, pings.of_submap, SETUP)
    kept.close()
    return mapper, pings


def test_a_run_is_gone_on_with_where_it_was_kept_last(tmp_path):
    mapper, pings = killed_in(tmp_path)
    with closing(KeptRuns(tmp_path)) as later:
        run = later.resume("auv_1", SETUP)
        assert len(later.earlier) == 1
        later.take(run)
        assert later.earlier == []
    state, expected = run.state, mapper.state()
    assert (state.run_id, state.sequence) == (RUN_ID, expected.sequence)
    assert state.sequence > 0
    for name in ("trajectory", "stamps_ns", "weight", "points"):
        np.testing.assert_array_equal(
            getattr(state.section, name), getattr(expected.section, name)
        )
    np.testing.assert_array_equal(state.navigation.mean, expected.navigation.mean)
    np.testing.assert_array_equal(
        state.dead_reckoning.covariance, expected.dead_reckoning.covariance
    )
    for submap_id, own in pings.of_submap.items():
        for one, other in zip(run.pings[submap_id], own, strict=True):
            assert_equal(one, other)
    # What is in a submap weighs as much as its echoes did.
    (first, weight), section = run.held.closed[0], mapper._submaps.closed[0]
    assert_equal(first, mapper.submaps()[0])
    np.testing.assert_allclose(weight.sum(), section.weight.sum(), rtol=0.01)

    again = VehicleMapper(_CONFIG, "auv_1", RUN_ID)
    again.resume(run.state, run.held)
    drive(again, range(70, 160))
    again.finish()
    assert len(again.trajectory()[0]) == 160


def test_what_closed_after_it_was_kept_last_is_not_mapped_twice(tmp_path):
    mapper, pings = killed_in(tmp_path)
    kept = KeptRuns(tmp_path)
    kept.take(kept.resume("auv_1", SETUP))
    kept.save(mapper.finish(), pings.of_submap)  # told to end, it gave its open submap away
    kept.close()
    with closing(KeptRuns(tmp_path)) as later:
        run = later.resume("auv_1", SETUP)
    again = VehicleMapper(_CONFIG, "auv_1", RUN_ID)
    again.resume(run.state, run.held)
    assert len(again.submaps()) == len(mapper.submaps())
    issued = drive(again, range(70, 160)) + again.finish()
    assert min(s.sequence for s in issued) == len(mapper.submaps())
    assert len(again.trajectory()[0]) == again.num_pings == 160


def test_a_file_that_is_cut_off_loses_its_last_second(tmp_path):
    killed_in(tmp_path)
    path = tmp_path / "open_submap"
    path.write_bytes(path.read_bytes()[:-1])
    with closing(KeptRuns(tmp_path)) as later:
        run = later.resume("auv_1", SETUP)
    assert run.state.last_ping_ns == (70 - 7 - 1) * 500_000_000
    assert run.held.num_pings(run.state) == 63


def test_with_other_settings_no_run_is_gone_on_with(tmp_path):
    killed_in(tmp_path)
    with closing(KeptRuns(tmp_path)) as later:
        with pytest.raises(DataError, match="other settings: what was in its open submap is lost"):
            later.resume("auv_1", b"settings of two!")
        assert len(later.earlier) == 1  # it is drawn anew as before


def test_a_run_that_lacks_a_submap_is_not_gone_on_with(tmp_path):
    killed_in(tmp_path)
    (path,) = tmp_path.glob("run_*.sqlite")
    path.unlink()
    with closing(KeptRuns(tmp_path)) as later, pytest.raises(DataError, match="holds 0 submaps"):
        later.resume("auv_1", SETUP)


def test_a_run_that_lacks_a_record_is_told_as_it_is_where_it_is_drawn_anew(tmp_path):
    killed_in(tmp_path)
    (path,) = tmp_path.glob("run_*.sqlite")
    with closing(sqlite3.connect(path)) as connection, connection:
        assert connection.execute("DELETE FROM records WHERE kind = ?", (b"pose",)).rowcount
    with closing(KeptRuns(tmp_path)) as later:
        for read in (lambda: later.load(path), lambda: later.resume("auv_1", SETUP)):
            with pytest.raises(DataError, match="is not a whole run"):
                read()


def test_where_pings_are_left_out_no_run_is_gone_on_with(tmp_path):
    pings = KeptPings(max_bytes=1.0)
    mapper, kept = VehicleMapper(_CONFIG, "auv_1", RUN_ID, pings), KeptRuns(tmp_path)
    drive(mapper, range(5))
    kept.save_open(mapper, pings.of_submap, SETUP)
    assert kept.resume("auv_1", SETUP) is None
    kept.close()
