"""What happens to sessions: disks that are full or away, bits that flip, bombs, odd names."""

import dataclasses
import io
import sqlite3
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
from unit.io.test_session import FLEET, contents, filled, save_fails_at

from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.merging import MapQueue
from uw_dslam_ros2.io.sessions.array_files import arrays_from_bytes, arrays_to_bytes
from uw_dslam_ros2.io.sessions.session import (
    GOOD_FILE,
    SESSION_FILE,
    Session,
    SessionInUseError,
    has_session,
    load_session,
    save_session,
)
from uw_dslam_ros2.io.sessions.session_export import export_queue
from uw_dslam_ros2.sim.maps.fleets import KnowingMatcher, answer_all

DATA = Path(__file__).parent / "data"


def test_a_first_save_interrupted_anywhere_is_no_session_yet(tmp_path, monkeypatch):
    queue = filled()
    for fail_at in range(1000):
        folder = tmp_path / str(fail_at)
        if not save_fails_at(fail_at, folder, queue, monkeypatch):
            break
        with Session(folder) as session:
            assert session.load() is None
            session.save(queue)
            assert contents(session.load()) == contents(queue)
    assert fail_at > 10


def test_tables_without_content_are_no_session_yet(tmp_path):
    """An earlier format made its tables before the first save."""
    with sqlite3.connect(tmp_path / SESSION_FILE) as connection:
        connection.executescript((DATA / "session_v1.sql").read_text())
        for table in ("meta", "submaps", "withdrawn", "answers"):
            connection.execute(f"DELETE FROM {table}")
        connection.execute("PRAGMA user_version = 1")
    connection.close()
    assert not has_session(tmp_path)
    save_session(tmp_path, filled())
    assert contents(load_session(tmp_path)) == contents(filled())


def test_an_old_session_is_read_and_saved_in_the_new_format(tmp_path):
    with sqlite3.connect(tmp_path / SESSION_FILE) as connection:
        connection.executescript((DATA / "session_v1.sql").read_text())
        connection.execute("PRAGMA user_version = 1")
    connection.close()
    old = load_session(tmp_path)
    names = [(r.submap.vehicle_id, r.submap.sequence) for r in old.submaps()]
    assert names == [("auv_1", 0), ("auv_1", 1), ("auv_2", 0), ("auv_2", 1)]
    assert [r.state.name for r in old.submaps()][3] == "WITHDRAWN"
    assert old.num_registrations == 1
    assert old.submaps()[1].submap.T_odom_submap.x == 3.0
    save_session(tmp_path, old)
    assert contents(load_session(tmp_path)) == contents(old)
    connection = sqlite3.connect(tmp_path / SESSION_FILE)
    tables = [name for (name,) in connection.execute("SELECT name FROM sqlite_master")]
    connection.close()
    assert "submaps" not in tables


def test_a_full_disk_is_an_error_and_the_next_save_goes_through(tmp_path, monkeypatch):
    before, after = filled(), filled()
    answer_all(after, KnowingMatcher(FLEET))
    real = sqlite3.connect
    with Session(tmp_path) as session:
        session.save(before)
        num_pages = (tmp_path / SESSION_FILE).stat().st_size // 4096

        def full(*args, **kwargs):
            connection = real(*args, **kwargs)
            connection.execute(f"PRAGMA max_page_count = {num_pages}")
            return connection

        with monkeypatch.context() as patch:
            patch.setattr(sqlite3, "connect", full)
            with pytest.raises(DataError, match=rf"{SESSION_FILE}.*full"):
                session.save(after)
        assert contents(load_session(tmp_path)) == contents(before)
        session.save(after)
    assert contents(load_session(tmp_path)) == contents(after)


def test_a_session_on_a_disk_that_is_away_is_saved_when_it_is_back(tmp_path):
    folder = tmp_path / "disk" / "session"
    (tmp_path / "disk").write_text("not mounted")
    with Session(folder) as session:
        assert session.load() is None
        with pytest.raises(DataError, match="cannot write to the session"):
            session.save(filled())
        (tmp_path / "disk").unlink()
        session.save(filled())
    assert contents(load_session(folder)) == contents(filled())


def test_no_flipped_bit_changes_a_map_silently(tmp_path, rng):
    queue = filled()
    answer_all(queue, KnowingMatcher(FLEET))
    path = save_session(tmp_path, queue)
    expected, whole = contents(queue), path.read_bytes()
    num_refused = 0
    for bit in rng.choice(8 * len(whole), size=150, replace=False):
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << (bit % 8)
        path.write_bytes(damaged)
        try:
            loaded = load_session(tmp_path)
        except DataError:
            num_refused += 1
        else:
            assert contents(loaded) == expected, f"bit {bit}"
    assert num_refused > 50


def damage(path: Path, vehicle: str):
    """Flip a bit in the content of the vehicle's first record."""
    with sqlite3.connect(path) as connection:
        where = "WHERE kind = ? AND instr(key, ?) > 0 ORDER BY key LIMIT 1"
        names = b"submap", vehicle.encode()
        key, content = connection.execute(
            f"SELECT key, content FROM records {where}", names
        ).fetchone()
        content = bytearray(content)
        content[len(content) // 2] ^= 4
        connection.execute("UPDATE records SET content = ? WHERE key = ?", (bytes(content), key))
    connection.close()
    return key.decode()


def test_a_damaged_record_is_named_and_the_last_good_session_kept(tmp_path):
    queue = filled()
    save_session(tmp_path, queue)
    with Session(tmp_path) as session:
        session.load()
        later = filled()
        answer_all(later, KnowingMatcher(FLEET))
        session.save(later)
    key = damage(tmp_path / SESSION_FILE, "auv_2")
    for _ in range(2):  # a second start must not overwrite the good one with the damaged one
        with pytest.raises(DataError, match="damaged") as caught, Session(tmp_path) as session:
            session.load()
        assert f"submap {key}" in str(caught.value)
        assert GOOD_FILE in str(caught.value)
    (tmp_path / GOOD_FILE).replace(tmp_path / SESSION_FILE)
    assert contents(load_session(tmp_path)) == contents(queue)


def test_a_missing_record_is_noticed(tmp_path):
    save_session(tmp_path, filled())
    with sqlite3.connect(tmp_path / SESSION_FILE) as connection:
        connection.execute("DELETE FROM records WHERE key = (SELECT max(key) FROM records)")
    connection.close()
    with pytest.raises(DataError, match="missing"):
        load_session(tmp_path)


def peak_bytes(work):
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def refused_by_size(content, match):
    with pytest.raises(DataError, match=match):
        arrays_from_bytes(content, 1_000_000)


def lying_header(shape):
    """A block of 100 bytes that says it were an array of another shape."""
    buffer, member = io.BytesIO(), io.BytesIO()
    header = {"descr": "|i1", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(member, header)
    member.write(bytes(100))
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("values.npy", member.getvalue())
    return buffer.getvalue()


def test_a_bomb_is_refused_before_memory_is_taken():
    bomb = arrays_to_bytes({"values": np.zeros((10_000, 10_000), np.int8)})
    assert len(bomb) < 200_000
    assert peak_bytes(lambda: refused_by_size(bomb, "at most 1000000")) < 3_000_000
    for shape in ((100_000, 100_000), (-1, 100), (2**40,)):
        lie = lying_header(shape)
        assert peak_bytes(lambda lie=lie: refused_by_size(lie, "declares")) < 3_000_000
    refused_by_size(lying_header((99,)), "more than its 99")
    assert arrays_from_bytes(lying_header((10, 10)), 1_000_000)["values"].shape == (10, 10)


def test_a_submap_larger_than_the_limit_is_refused_from_a_session(tmp_path, monkeypatch):
    save_session(tmp_path, filled())
    monkeypatch.setattr("uw_dslam_ros2.io.sessions.session._EXTRA_BYTES", -15_999_000)
    with pytest.raises(DataError, match="expected at most 1000"):
        load_session(tmp_path)


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("dtype", ["i1", "<f8", "<i8"])
@pytest.mark.parametrize("shape", [(), (0, 3), (4,), (3, 5)])
def test_arrays_come_back(rng, shape, dtype, order):
    array = np.asarray(100.0 * rng.random(shape), dtype=dtype, order=order)
    again = arrays_from_bytes(arrays_to_bytes({"a": array, "b": array}), 10_000)
    assert list(again) == ["a", "b"]
    assert again["a"].dtype == array.dtype
    np.testing.assert_array_equal(again["a"], array, strict=True)


def test_two_writers_of_one_folder_are_refused(tmp_path):
    with Session(tmp_path) as first:
        first.save(filled())
        with Session(tmp_path) as second:
            with pytest.raises(SessionInUseError, match="is written by process"):
                second.load()
            with pytest.raises(SessionInUseError):
                second.save(MapQueue())
        assert contents(load_session(tmp_path)) == contents(filled())
        first.save(filled())
    with Session(tmp_path) as second:
        assert second.load() is not None


ODD_NAMES = [
    "a/b",
    "a_b",
    "a%2Fb",
    "..",
    ".a",
    "x" * 10_000,
    "x" * 9_999 + "y",
    "ä",
    "a b",
    "C:\\",
]


def test_every_vehicle_has_its_own_files_whatever_its_name(tmp_path):
    queue = MapQueue()
    submap = FLEET.submaps[min(FLEET.submaps)]
    for vehicle in ODD_NAMES:
        assert queue.add_submap(dataclasses.replace(submap, vehicle_id=vehicle))
    names = {path.name for path in export_queue(tmp_path / "out", queue)}
    assert sum(name.endswith("_0000.yaml") for name in names) == len(ODD_NAMES)
    assert "a_b_0000.yaml" in names
    inside = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert {path.parent.name for path in inside} <= {"out", "submaps", "trajectories"}
    save_session(tmp_path, queue)
    assert {r.submap.vehicle_id for r in load_session(tmp_path).submaps()} == set(ODD_NAMES)
