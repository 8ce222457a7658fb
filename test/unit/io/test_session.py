"""Sessions survive: a round trip changes nothing, and no interruption loses anything."""

import math
import os
import signal
import sqlite3
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from unit.merging.fleet import map_bytes, three_vehicles

from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.merging import Decision, DecisionKind, MapQueue, SubmapState
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId
from uw_dslam_ros2.io.maps.files import read_map
from uw_dslam_ros2.io.sessions.session import SESSION_FILE, load_session, save_session
from uw_dslam_ros2.io.sessions.session_export import export_queue
from uw_dslam_ros2.io.sessions.session_file import Record, opened, read_records, write_records
from uw_dslam_ros2.io.trajectories import read_g2o, read_tum
from uw_dslam_ros2.sim.maps.fleets import KnowingMatcher, answer_all

FLEET = three_vehicles()


def filled() -> MapQueue:
    queue = MapQueue()
    for submap_id in sorted(FLEET.submaps):
        queue.add_submap(FLEET.submaps[submap_id])
    return queue


def summary(queue: MapQueue):
    return (
        map_bytes(queue),
        [(r.submap.submap_id, r.submap.revision, r.state, r.component) for r in queue.submaps()],
        queue.num_registrations,
        [
            (r.source_ids, r.target_ids)
            for r in MapQueue.from_state(queue.to_state()).next_requests(99)
        ],
    )


def test_a_saved_queue_comes_back_as_it_was(tmp_path):
    queue = filled()
    oracle = KnowingMatcher(FLEET)
    for request in queue.next_requests(2):
        queue.add_result(request.request_id, oracle(request))
    queue.withdraw(("auv_3", 0, 2))
    save_session(tmp_path / "new" / "session", queue)
    again = load_session(tmp_path / "new" / "session")
    assert summary(again) == summary(queue)
    for submap_id in FLEET.submaps:
        again.add_submap(FLEET.submaps[submap_id])
    assert summary(again) == summary(queue)
    answer_all(queue, oracle)
    answer_all(again, oracle)
    assert summary(again) == summary(queue)
    states = {r.submap.submap_id: r.state for r in again.submaps()}
    assert states["auv_3", 0, 2] is SubmapState.WITHDRAWN


def test_what_people_decided_comes_back_in_order(tmp_path):
    queue = filled()
    answer_all(queue, KnowingMatcher(FLEET))
    ends = {"source": SubmapId("auv_2", 0, 1), "target": SubmapId("auv_1", 0, 1)}
    who = {"who": "Ann", "stamp_ns": 1_700_000_000_123_456_789}
    motion = {"T_target_source": SE2(0.1, 12.0, 1e-3)}
    place = {"place": SE2(512_345.25, 5_912_345.5, 0.2), "earth_frame": "EPSG:32632"}
    kinds = DecisionKind
    for decision in (
        Decision(kinds.WITHDRAW, source=SubmapId("auv_3", 0, 2), **who),
        Decision(kinds.FORBID, is_run=True, source=ends["source"], target=ends["target"]),
        Decision(kinds.CONFIRM, sigma_m=0.5, sigma_rad=0.1, **ends, **motion),
        Decision(kinds.REGISTER, half_width_m=2.0, half_width_rad=0.1, **ends, **motion),
        Decision(kinds.PIN, source=ends["source"]),
        Decision(
            kinds.FIX, source=ends["source"], point=(1.0, 2.0), sigma_m=2.0, sigma_rad=math.inf,
            **place,
        ),
        Decision(kinds.UNDO, undone=2, **who),
        Decision(kinds.UNDO, undone=7, **who),
    ):  # fmt: skip
        queue.decide(decision)
    save_session(tmp_path, queue)
    again = load_session(tmp_path)
    assert again.to_state().decisions == queue.to_state().decisions
    assert again.decisions() == queue.decisions()
    assert summary(again) == summary(queue)


def test_a_session_from_before_there_were_decisions_is_read(tmp_path):
    save_session(tmp_path, filled())
    path = tmp_path / SESSION_FILE
    with opened(path) as (connection, _):
        records = read_records(connection)
    held = {name: Record.of(content) for name, content in records.items()}
    held["withdrawn", '["auv_3", 0, 2]'] = Record.of(b"")
    write_records(path, held)
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA user_version = 2")
    connection.close()
    again = load_session(tmp_path)
    states = {r.submap.submap_id: r.state for r in again.submaps()}
    assert states["auv_3", 0, 2] is SubmapState.WITHDRAWN
    save_session(tmp_path, again)
    assert contents(load_session(tmp_path)) == contents(again)
    with opened(path) as (_, version):
        assert version == 3


def test_saving_again_writes_only_what_is_new(tmp_path):
    queue = filled()
    save_session(tmp_path, queue)
    statements = []
    real = sqlite3.connect

    def traced(*args, **kwargs):
        connection = real(*args, **kwargs)
        connection.set_trace_callback(statements.append)
        return connection

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sqlite3, "connect", traced)
        request = queue.next_requests(1)[0]
        queue.add_result(request.request_id, KnowingMatcher(FLEET)(request))
        save_session(tmp_path, queue)
    inserted = [s for s in statements if "INSERT" in s]
    assert sum(b"submap".hex() in s.lower() for s in inserted) == 0
    assert sum(b"answer".hex() in s.lower() for s in inserted) == 1


def contents(queue: MapQueue):
    state = queue.to_state()
    submaps = [(submap.submap_id, submap.grid.values.tobytes()) for submap in state.submaps]
    return submaps, state.decisions, [answer.query.key for answer in state.answers]


class InterruptedWriteError(Exception):
    pass


def save_fails_at(fail_at, folder, queue, monkeypatch):
    """Save, interrupted at so many calls of the database; False where it was done before that."""
    calls, real = iter(range(10_000)), sqlite3.connect

    class Failing(sqlite3.Connection):
        def execute(self, *args):
            if next(calls) == fail_at:
                raise InterruptedWriteError
            return super().execute(*args)

    with monkeypatch.context() as patch:
        patch.setattr(sqlite3, "connect", lambda *a, **k: real(*a, factory=Failing, **k))
        try:
            save_session(folder, queue)
        except InterruptedWriteError:
            return True
    return False


def test_a_failure_at_any_step_leaves_the_old_session_whole(tmp_path, monkeypatch):
    """Fail at each statement in turn: what loads is the old state until the commit is through."""
    old = filled()
    save_session(tmp_path, old)
    new = filled()
    answer_all(new, KnowingMatcher(FLEET))
    new.withdraw(("auv_1", 0, 1))
    before, after = contents(old), contents(new)
    assert before != after
    for fail_at in range(1000):
        failed = save_fails_at(fail_at, tmp_path, new, monkeypatch)
        assert contents(load_session(tmp_path)) == (before if failed else after)
        if not failed:
            break
    assert fail_at > 10


_SAVE_FOR_EVER = """
import sys
from unit.merging.fleet import three_vehicles
from uw_dslam_ros2.core.merging import MapQueue
from uw_dslam_ros2.io.sessions.session import save_session
fleet = three_vehicles()
queue = MapQueue()
for submap_id in sorted(fleet.submaps):
    queue.add_submap(fleet.submaps[submap_id])
    save_session(sys.argv[1], queue)
    print(*submap_id, flush=True)
while True:
    queue.withdraw(("auv_1", 0, 1))
    save_session(sys.argv[1], queue)
    queue.restore(("auv_1", 0, 1))
    save_session(sys.argv[1], queue)
"""


@pytest.mark.parametrize("kill_after", [6])
def test_nothing_accepted_is_lost_by_kill_9(tmp_path, kill_after):
    paths = [str(Path(__file__).parents[2]), *sys.path]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    process = subprocess.Popen(
        [sys.executable, "-c", _SAVE_FOR_EVER, str(tmp_path)],
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
    )
    saved = []
    for line in process.stdout:
        vehicle, *numbers = line.split()
        saved.append((vehicle, *map(int, numbers)))
        if len(saved) == kill_after:
            break
    process.send_signal(signal.SIGKILL)
    process.wait(10)
    process.stdout.close()
    assert len(saved) == kill_after
    held = {record.submap.submap_id for record in load_session(tmp_path).submaps()}
    assert held >= set(saved)


def test_bad_sessions_are_refused_by_name(tmp_path):
    with pytest.raises(DataError, match="does not exist"):
        load_session(tmp_path)
    (tmp_path / SESSION_FILE).write_bytes(b"no database at all" * 100)
    with pytest.raises(DataError, match=SESSION_FILE):
        load_session(tmp_path)
    with pytest.raises(DataError, match=SESSION_FILE):
        save_session(tmp_path, filled())
    (tmp_path / SESSION_FILE).unlink()
    save_session(tmp_path, filled())
    connection = sqlite3.connect(tmp_path / SESSION_FILE)
    connection.execute("PRAGMA user_version = 77")
    connection.commit()
    connection.close()
    with pytest.raises(DataError, match="format 77"):
        load_session(tmp_path)


def test_the_export_is_read_by_the_readers(tmp_path):
    queue = filled()
    answer_all(queue, KnowingMatcher(FLEET))
    paths = export_queue(tmp_path, queue)
    assert all(path.is_file() for path in paths)
    fused = queue.global_map()
    read = read_map(tmp_path / "map.yaml")
    assert read.spec == fused.spec
    np.testing.assert_array_equal(read.values == 100, fused.values > 50)
    assert (tmp_path / "submaps" / "auv_2_0003.yaml").is_file()
    stamps_ns, poses = read_tum(tmp_path / "trajectories" / "auv_1.tum")
    expected = queue.trajectories()["auv_1"]
    np.testing.assert_array_equal(stamps_ns, expected[0])
    np.testing.assert_allclose(poses, expected[1], atol=1e-8)
    vertices, edges = read_g2o(tmp_path / "graph.g2o")
    assert len(vertices) == len(FLEET.submaps)
    assert len(edges) == sum(c.is_inlier for c in queue.constraints())


def test_an_empty_queue_can_be_saved_and_exported(tmp_path):
    save_session(tmp_path, MapQueue())
    assert load_session(tmp_path).submaps() == []
    assert [path.name for path in export_queue(tmp_path, MapQueue())] == ["graph.g2o"]
