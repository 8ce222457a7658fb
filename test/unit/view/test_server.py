"""The server of the view, asked as a browser asks it, and as others should not."""

import asyncio
import itertools
import json

import aiohttp
import pytest
from unit.cli import missions

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.view.queue_source import QueueSource
from uw_dslam_ros2.view.server import ViewServer, is_loopback

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


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("/api/pairs/0", "registration is 0"),
        ("/api/pairs/999", "registration is 999"),
        ("/api/pairs/1/walls.png", "layer is 'walls'"),
        ("/api/tiles/x/all/40/0/0.png", "zoom is 40"),
        ("/api/pairs/1?rival=7", "rival is 7"),
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
