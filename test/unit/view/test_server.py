"""The server of the view, asked as a browser asks it, and as others should not."""

import asyncio
import contextlib
import dataclasses
import gc
import io
import itertools
import json
import socket
import time
import warnings
import zipfile

import aiohttp
import numpy as np
import pytest
from unit.cli import missions

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.merging import MapQueue
from uw_dslam_ros2.io.maps.files import read_map
from uw_dslam_ros2.io.trajectories import read_g2o, read_tum
from uw_dslam_ros2.view.guard import is_loopback
from uw_dslam_ros2.view.queue_source import QueueSource
from uw_dslam_ros2.view.server import ViewServer

VEHICLES = ("auv_1", "auv_2", "auv_3")


@pytest.fixture(scope="module")
def source():
    return QueueSource("a harbour", missions.settled_queue(VEHICLES))


def answers(source, paths, *, address="127.0.0.1", token="", headers=None):
    """Status, headers and body of each path, asked of a server of its own."""

    async def run():
        server = ViewServer(source, address, 0, token)
        try:
            base = (await server.start()).split("?")[0].rstrip("/")
            found = []
            async with aiohttp.ClientSession() as session:
                for path in paths:
                    async with session.get(base + path, headers=headers) as response:
                        found.append((response.status, response.headers, await response.read()))
            return found
        finally:
            await server.stop()

    return asyncio.run(run())


def test_the_scene_holds_vehicles_submaps_and_matches(source):
    ((status, headers, body),) = answers(source, ["/api/scene"])
    scene = json.loads(body)
    assert status == 200
    assert scene["title"] == "a harbour"
    assert [vehicle["name"] for vehicle in scene["vehicles"]] == list(VEHICLES)
    assert len(scene["submaps"]) == len(scene["moments"]) == 3
    assert {group["group"] for group in scene["groups"]} == {
        submap["group"] for submap in scene["submaps"]
    }
    assert all(row["verdict"] and row["reason"] for row in scene["registrations"])
    ((status, _, _),) = answers(source, ["/api/scene"], headers={"If-None-Match": headers["ETag"]})
    assert status == 304


@pytest.mark.parametrize("accepted", ["identity", "gzip, deflate, br"])
def test_the_scene_is_packed_for_whom_unpacks_it(source, accepted):
    ((_, headers, body),) = answers(source, ["/api/scene"], headers={"Accept-Encoding": accepted})
    assert headers.get("Content-Encoding", "identity") == accepted.split(",")[0]
    assert json.loads(body)["title"] == "a harbour"


def test_runs_are_counted_and_not_told_by_their_random_numbers():
    queue = MapQueue()
    for run_id, stamp_ns in ((3_000_000_000, 5), (7, 9)):
        submap = missions.submap("auv_1")
        queue.add_submap(dataclasses.replace(submap, run_id=run_id, stamp_ns=stamp_ns))
    scene = QueueSource("two runs", queue).showing().scene()
    assert [vehicle["name"] for vehicle in scene["vehicles"]] == ["auv_1", "auv_1#2"]
    assert [moment["submap"] for moment in scene["moments"]] == ["auv_1/0", "auv_1#2/0"]


def test_groups_stand_side_by_side(source):
    scene = source.showing().scene()
    boxes = sorted(group["bounds"] for group in scene["groups"])
    assert len(boxes) > 1
    assert all(left[2] < right[0] for left, right in itertools.pairwise(boxes))


def test_tiles_and_pairs_are_pictures(source):
    showing = source.showing()
    x, y = showing.scene()["groups"][0]["bounds"][:2]
    tile = f"/api/tiles/{showing.version}/all/3/{int(x * 8 // 256)}/{int(-y * 8 // 256)}.png"
    paths = [tile, tile.replace("/all/", "/0/"), "/api/pairs/1", "/api/pairs/1/agreement.png"]
    found = answers(source, paths)
    assert [status for status, _, _ in found] == [200, 204, 200, 200]
    assert found[0][2].startswith(b"\x89PNG")
    assert found[3][2].startswith(b"\x89PNG")


def test_the_archive_holds_what_is_shown(source, tmp_path):
    one, other = answers(source, ["/api/export.zip"] * 2)
    assert one[2] == other[2]  # the same state, the same bytes
    with zipfile.ZipFile(io.BytesIO(one[2])) as archive:
        archive.extractall(tmp_path)
    groups = source.showing().scene()["groups"]
    folders = sorted(path.name for path in tmp_path.iterdir() if path.is_dir())
    assert len(folders) == len(groups)
    occupancy = read_map(tmp_path / "map" / "map.yaml")
    np.testing.assert_array_equal(occupancy.values > 50, source.showing().map_of(0).values > 50)
    # A pixel of the picture, by the world file, lies where the map has the cell.
    step_x, turn, _, step_y, x, y = map(float, (tmp_path / "map" / "map.pgw").read_text().split())
    place = [[x + 3 * step_x, y + 5 * step_y]]
    assert turn == 0.0
    assert occupancy.spec.cells_of(place).tolist() == [[occupancy.spec.num_rows - 6, 3]]
    tracks = json.loads((tmp_path / "map" / "tracks.geojson").read_text())["features"]
    assert [track["properties"]["vehicle"] for track in tracks] == groups[0]["vehicles"]
    for track in tracks:
        _, poses = read_tum(tmp_path / "map" / f"{track['properties']['vehicle']}.tum")
        np.testing.assert_allclose(poses[:, :2], track["geometry"]["coordinates"], atol=1e-3)
    walls = json.loads((tmp_path / "map" / "walls.geojson").read_text())["features"]
    assert {wall["properties"]["last_seen_s"] for wall in walls} == {missions.STAMPS[-1] / 1e9}
    vertices, edges = read_g2o(tmp_path / "map" / "graph.g2o")
    assert len(vertices) == groups[0]["num_submaps"]
    assert len(edges) == len(groups[0]["vehicles"]) - 1


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("/api/pairs/0", "registration is 0"),
        ("/api/pairs/999", "registration is 999"),
        ("/api/pairs/1/walls.png", "layer is 'walls'"),
        ("/api/tiles/x/all/40/0/0.png", "zoom is 40"),
        ("/api/pairs/1?rival=999", "rival is 999"),
    ],
)
def test_wrong_questions_are_told(source, path, said):
    ((status, _, body),) = answers(source, [path])
    assert status == 400
    assert said in json.loads(body)["error"]


def test_no_file_but_the_pages_own_is_given(source):
    climbing = [
        "/static/%2e%2e/server.py",
        "/static/../server.py",
        "/static/..%2f..%2fserver.py",
        "/static/vendor/leaflet/LICENSE",
        "/static//etc/passwd",
    ]
    assert all(status == 404 for status, _, _ in answers(source, climbing))
    ((status, headers, body),) = answers(source, ["/"])
    assert status == 200
    assert b"http" not in body  # everything comes from this server
    assert "default-src 'self'" in headers["Content-Security-Policy"]


@pytest.mark.parametrize(
    "headers", [{"Origin": "http://example.org"}, {"Host": "example.org"}, {"Origin": "null"}]
)
def test_pages_of_others_are_refused(source, headers):
    assert answers(source, ["/api/scene", "/"], headers=headers)[0][0] == 403


def test_strangers_need_the_token(source):
    paths = ["/api/scene", "/", "/?token=wrong", "/static/main.js", "/api/scene?token=secret"]
    found = [status for status, _, _ in answers(source, paths, address="0.0.0.0", token="secret")]
    assert found == [401, 401, 401, 401, 200]
    ((status, headers, _),) = answers(
        source, ["/?token=secret"], address="0.0.0.0", token="secret"
    )
    assert status == 200
    assert "HttpOnly" in headers["Set-Cookie"]


def test_another_address_draws_a_token_by_itself(source):
    assert answers(source, ["/api/scene"], address="0.0.0.0")[0][0] == 401
    assert is_loopback("127.0.0.1")
    assert is_loopback("::1")
    assert not is_loopback("192.168.1.4")
    with pytest.raises(InvalidInputError, match="address is 'sea'"):
        is_loopback("sea")


def test_a_port_that_is_taken_is_told(source):
    async def run():
        first = ViewServer(source)
        url = await first.start()
        second = ViewServer(source, port=int(url.rsplit(":", 1)[1].strip("/")))
        try:
            await second.start()
        finally:
            await first.stop()
            await second.stop()

    with pytest.raises(InvalidInputError, match=r"cannot listen on .* port"):
        asyncio.run(run())


def left_open(run):
    """What Python says of connections that nobody closed, once this has run."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", ResourceWarning)
        asyncio.run(run())
        gc.collect()
    return [str(warning.message) for warning in told]


async def connect(server):
    """A connection to a view that has just started, which says nothing yet."""
    address = (await server.start()).rsplit(":", 1)[1].strip("/")
    return socket.create_connection(("127.0.0.1", int(address)))


@pytest.mark.parametrize("num_turns", range(6))
def test_a_page_that_comes_while_the_view_closes_is_not_left_open(source, num_turns):
    async def run():
        server = ViewServer(source)
        with await connect(server):
            for _ in range(num_turns):
                await asyncio.sleep(0)
            await server.stop()

    assert left_open(run) == []


def test_a_page_that_reads_nothing_is_not_left_open(source):
    pages = []

    async def run():
        server = ViewServer(source)
        pages.append(await connect(server))
        pages[0].setblocking(False)
        end_s = time.monotonic() + 20.0
        while not any(
            connection.transport.get_write_buffer_size()
            for connection in server._runner.server.connections
        ):
            assert time.monotonic() < end_s
            with contextlib.suppress(BlockingIOError):
                pages[0].send(b"GET /static/map.js HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            await asyncio.sleep(0)
        await server.stop()

    assert left_open(run) == []
    pages[0].close()
