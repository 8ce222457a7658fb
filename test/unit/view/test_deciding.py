"""What people decide on the page: taken, saved, worked out, and refused from anywhere else."""

import asyncio
import dataclasses
import io
import json
import math
import threading
import time
import zipfile

import aiohttp
import cv2
import numpy as np
import pytest
from unit.cli import missions

from uw_dslam_ros2.core.errors import DataError, InvalidInputError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging import Decision, DecisionKind, MapQueue
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId
from uw_dslam_ros2.io.sessions.session import (
    Session,
    SessionInUseError,
    load_session,
    save_session,
)
from uw_dslam_ros2.view import registering
from uw_dslam_ros2.view.export import export_zip
from uw_dslam_ros2.view.laying import lay_out, run_map
from uw_dslam_ros2.view.queue_source import QueueSource
from uw_dslam_ros2.view.server import ViewServer

ONE, TWO, THREE = (SubmapId(f"auv_{number}", 0, 0) for number in (1, 2, 3))
WITHDRAW = {"kind": "withdraw", "source": list(TWO), "who": "Ann"}


@pytest.fixture(autouse=True)
def _quick_answers(monkeypatch):
    """The engine's answers are tested elsewhere."""

    def refuse(*_):
        return missions.RegistrationResult.refused(missions.Verdict.IMPROBABLE, "not here")

    monkeypatch.setattr(registering, "register_by_engine", refuse)


@pytest.fixture
def view_of():
    """Views of sessions, closed in the end."""
    made = []

    def view(folder):
        made.append(QueueSource("a harbour", load_session(folder), folder))
        return made[-1]

    yield view
    for source in made:
        rested(source).close()


def rested(source):
    """The source once nothing is open."""
    deadline_s = time.monotonic() + 20.0
    while source.status()["notes"]:
        assert time.monotonic() < deadline_s, source.status()
        time.sleep(0.01)
    return source


def posted(source, body, *, token="", given=None, kind="application/json", origin="own"):
    """Status and answer of a decision that is sent."""

    async def run():
        server = ViewServer(source, "127.0.0.1", 0, token)
        try:
            base = (await server.start()).split("?")[0].rstrip("/")
            headers = {"Content-Type": kind}
            if origin is not None:
                headers["Origin"] = base if origin == "own" else origin
            cookies = {"uw_view_token": token if given is None else given}
            async with (
                aiohttp.ClientSession(cookies=cookies) as session,
                session.post(f"{base}/api/decide", data=body, headers=headers) as response,
            ):
                return response.status, (await response.read()).decode()
        finally:
            await server.stop()

    return asyncio.run(run())


def states(source):
    return {s["name"]: s["state"] for s in source.showing().scene()["submaps"]}


def test_what_is_made_of_a_merge_is_made_anew_when_all_is_worked_out(tmp_path):
    save_session(tmp_path, missions.settled_queue())
    made, is_first = [], threading.Event()

    def write(queue):
        made.append((queue.num_decisions, len(queue.next_requests(9))))
        if len(made) == 1:
            # Somebody else decides meanwhile, and need not wait.
            source.decide(Decision(DecisionKind.UNDO, "Bo", undone=1))
            is_first.set()
        else:
            raise DataError("the disk is full")

    source = QueueSource("a harbour", load_session(tmp_path), tmp_path, write)
    source.decide(Decision(DecisionKind.WITHDRAW, "Ann", source=TWO))
    assert is_first.wait(20.0)
    source.close()
    assert made == [(1, 0), (2, 0)]
    assert source.status()["notes"] == ["the disk is full"]
    assert states(source)["auv_2/0"] == "merged"


def test_a_decision_is_saved_and_shown(view_of, tmp_path):
    save_session(tmp_path, missions.settled_queue())
    source = view_of(tmp_path)
    changes = []
    source.listen(lambda: changes.append(1))
    status, body = posted(source, json.dumps(WITHDRAW))
    assert (status, json.loads(body)) == (200, {"number": 1})
    rested(source)
    assert states(source)["auv_2/0"] == "withdrawn"
    (row,) = source.showing().scene()["decisions"]
    assert (row["kind"], row["who"], row["ends"]) == ("withdraw", "Ann", ["auv_2/0"])
    assert abs(row["stamp_s"] - time.time()) < 60.0
    source.close()
    again = view_of(tmp_path)
    assert states(again) == states(source)
    again.decide(Decision(DecisionKind.UNDO, "Bo", undone=1))
    assert states(rested(again))["auv_2/0"] == "merged"


def test_who_only_looks_is_in_nobodys_way_and_sees_others_work_on_deciding(view_of, tmp_path):
    save_session(tmp_path, missions.settled_queue())
    source = view_of(tmp_path)
    with Session(tmp_path) as manager:
        queue = manager.load()
        queue.withdraw(THREE)
        manager.save(queue)
        with pytest.raises(SessionInUseError):
            source.decide(Decision(DecisionKind.WITHDRAW, source=TWO))
        assert states(source)["auv_2/0"] == "merged"
    assert source.decide(Decision(DecisionKind.WITHDRAW, source=TWO)).number == 2
    assert states(rested(source)) == {
        "auv_1/0": "merged",
        "auv_2/0": "withdrawn",
        "auv_3/0": "withdrawn",
    }


def test_what_cannot_be_saved_does_not_hold(view_of, tmp_path, monkeypatch):
    save_session(tmp_path, missions.settled_queue())
    source = view_of(tmp_path)

    def fails(*_):
        raise DataError("no space left")

    with monkeypatch.context() as patch:
        patch.setattr(Session, "save", fails)
        with pytest.raises(DataError, match="no space"):
            source.decide(Decision(DecisionKind.WITHDRAW, source=TWO))
    assert source.decide(Decision(DecisionKind.WITHDRAW, source=THREE)).number == 1
    assert states(rested(source))["auv_2/0"] == "merged"


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("{}", "who is empty"),
        ("[1]", "expected an object"),
        ("no json", "Expecting value"),
        (json.dumps(WITHDRAW | {"who": "  "}), "who is empty"),
        (json.dumps(WITHDRAW | {"kind": "burn"}), "kind is 'burn'"),
        (json.dumps(WITHDRAW | {"source": ["auv_9", 0, 0]}), "auv_9/0, which was never received"),
    ],
)
def test_nonsense_is_told(body, message):
    source = QueueSource("a harbour", missions.settled_queue())
    status, said = posted(source, body)
    assert status == 400
    assert message in json.loads(said)["error"]
    assert source.showing().scene()["decisions"] == []


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"origin": "http://evil.example"}, 403),
        ({"origin": None}, 403),
        ({"kind": "text/plain"}, 403),
        ({"kind": "application/x-www-form-urlencoded"}, 403),
        ({"token": "secret", "given": "guess"}, 401),
        ({"token": "secret", "given": ""}, 401),
        ({"token": "secret"}, 200),
    ],
)
def test_only_the_page_itself_decides(options, expected):
    source = QueueSource("a harbour", missions.settled_queue())
    status, _ = posted(source, json.dumps(WITHDRAW), **options)
    assert status == expected
    rested(source)
    assert len(source.showing().scene()["decisions"]) == (expected == 200)


def test_a_large_body_is_refused():
    source = QueueSource("a harbour", missions.settled_queue())
    status, _ = posted(source, json.dumps(WITHDRAW | {"who": "x" * 20_000}))
    assert status == 413


def test_maps_are_laid_out_as_the_graph_or_a_registration_says():
    queue = missions.settled_queue()
    showing = QueueSource("a harbour", queue).showing()
    T_true = missions.T_WORLD_ODOM["auv_1"].inverse() @ missions.T_WORLD_ODOM["auv_2"]
    laid = lay_out(showing, "auv_2", "auv_1")
    assert SE2(*laid["start"]).distance_to(T_true)[0] < 0.01
    assert laid["source"]["id"] == list(TWO)
    assert (laid["source"]["rows"], laid["source"]["resolution_m"]) == (40, 0.2)  # what is known
    # They are apart; a refused answer says where one would lie in the other.
    rows = showing.scene()["registrations"]
    refused = next(row for row in rows if set(row["runs"]) == {"auv_1", "auv_3"})
    T_refused = missions.T_WORLD_ODOM["auv_1"].inverse() @ missions.T_WORLD_ODOM["auv_3"]
    for names, motion in (
        (("auv_3", "auv_1"), T_refused),
        (("auv_1", "auv_3"), T_refused.inverse()),
    ):
        found = SE2(*lay_out(showing, *names, refused["number"])["start"])
        assert found.distance_to(motion)[0] < 0.01
    assert lay_out(showing, "auv_3", "auv_1")["start"] == [0.0, 0.0, 0.0]  # middle on middle
    for names, message in ((("auv_1", "auv_1"), "another run"), (("auv_9", "auv_1"), "no run")):
        with pytest.raises(InvalidInputError, match=message):
            lay_out(showing, *names)
    picture = cv2.imdecode(
        np.frombuffer(run_map(showing, "auv_1").picture("source"), np.uint8), -1
    )
    assert picture.shape == (40, 44, 4)
    assert picture[-1, 12].tolist() == [0, 159, 230, 255]  # a wall, in orange
    assert 0 < picture[-1 - 10, 12, 3] < 255  # water that lets the other map through


def test_a_large_map_is_laid_in_few_cells_that_lie_where_the_many_did():
    queue, spec = MapQueue(), GridSpec(0.05, 1200, 900, SE2(-3.0, 2.0, 0.3))
    values = np.zeros(spec.shape, np.int8)
    values[700, 100:800] = values[200:900, 333] = 100  # walls of one cell
    submap = dataclasses.replace(missions.submap("auv_1"), grid=OccupancyMap(spec, values))
    queue.add_submap(submap)
    laid = run_map(QueueSource("", queue).showing(), "auv_1").occupancy
    assert max(laid.spec.shape) <= 500
    true = spec.centers_of(np.argwhere(values == 100))
    cells = laid.spec.cells_of(true)
    assert (laid.values[cells[:, 0], cells[:, 1]] > 50).all()
    # Nothing is a wall that is farther from one than the thickness that is drawn.
    found = laid.spec.centers_of(np.argwhere(laid.values > 50))
    assert max(np.hypot(*(true - place).T).min() for place in found) < 2.5 * laid.spec.resolution_m


def test_a_map_with_fixes_is_exported_in_coordinates_of_the_earth(tmp_path):
    queue = missions.settled_queue()
    place = SE2(500_000.0, 5_900_000.0, 0.5 * math.pi)
    fix = Decision(
        DecisionKind.FIX, "Ann", source=ONE, place=place, sigma_m=1.0, sigma_rad=0.1,
        earth_frame="EPSG:32732",
    )  # fmt: skip
    queue.decide(fix)
    with zipfile.ZipFile(io.BytesIO(export_zip(QueueSource("", queue).showing()))) as archive:
        archive.extractall(tmp_path)
    values = [float(v) for v in (tmp_path / "map" / "map.pgw").read_text().split()]
    # Turned by a quarter: a step right in the picture goes north, a step down east.
    resolution_m = 0.2
    assert values[:4] == pytest.approx([0.0, resolution_m, resolution_m, 0.0], abs=1e-6)
    occupancy = QueueSource("", queue).showing().map_of(0)
    corner = occupancy.spec.centers_of(np.array([[occupancy.spec.num_rows - 1, 0]]))[0]
    assert values[4:] == pytest.approx(place.apply(corner).tolist(), abs=1e-3)
    projection = (tmp_path / "map" / "map.prj").read_text()
    assert "UTM zone 32S" in projection
    assert 'PARAMETER["false_northing",10000000]' in projection
    told = json.loads((tmp_path / "map" / "georeference.json").read_text())
    assert told["frame"] == "EPSG:32732"
    assert told["T_earth_map"] == pytest.approx(place.as_array().tolist())
    assert told["fixes"][0]["who"] == "Ann"
    plain = dataclasses.replace(fix, earth_frame="chart of the harbour")
    queue.decide(Decision(DecisionKind.UNDO, undone=1))
    queue.decide(plain)
    with zipfile.ZipFile(io.BytesIO(export_zip(QueueSource("", queue).showing()))) as archive:
        names = archive.namelist()
    assert "map/georeference.json" in names
    assert "map/map.prj" not in names
