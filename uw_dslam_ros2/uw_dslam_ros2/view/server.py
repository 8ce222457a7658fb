"""The web server of the view: one page, its data, tiles of maps; nothing from elsewhere."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import gzip
import json
import time
from collections.abc import Awaitable, Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from importlib import resources
from typing import Any

from aiohttp import web

from uw_dslam_ros2.core.errors import InvalidInputError, UwDslamError
from uw_dslam_ros2.io.sessions.decisions import decision_from_plain
from uw_dslam_ros2.view.export import export_zip
from uw_dslam_ros2.view.guard import HEADERS, Guard
from uw_dslam_ros2.view.laying import lay_out, run_map
from uw_dslam_ros2.view.overview import look_of
from uw_dslam_ros2.view.pace import Pace
from uw_dslam_ros2.view.pairs import PAIR_LAYERS, Pair
from uw_dslam_ros2.view.source import Source

__all__ = ["ViewServer"]

_MAX_ZOOM, _MIN_ZOOM = 10, -8
_MAX_PAIRS = 8
_MAX_SIDE, _SMALL_SIDE = 4000, 300  # pixels of a pair's picture
_KEPT = {"Cache-Control": "private, max-age=3600, immutable"}
_MAX_BODY_BYTES = 10_000
_SHARE = 0.2
"""Of a core, that pages which follow changes may cost: they are told of them less often."""

_TURNS = 4
"""Of the loop: one makes the connection's transport, the next tells its handler; twice as many."""

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class ViewServer:
    """Serves one source.

    Parameters
    ----------
    address, port
        Where to listen; port 0 takes a free one.
    token
        See `Guard`.
    """

    def __init__(
        self, source: Source, address: str = "127.0.0.1", port: int = 0, token: str = ""
    ) -> None:
        self._source, self._address, self._port = source, address, port
        self._guard = Guard(address, token)
        # What draws the map is one thread's; a look into a pair must not keep it, nor small
        # pictures a large one.
        self._map, self._looks, self._small = (
            ThreadPoolExecutor(1, thread_name_prefix=f"view {name}")
            for name in ("map", "looks", "small")
        )
        self._changed = asyncio.Condition()
        self._runner: web.AppRunner | None = None
        self._listening: asyncio.Server | None = None
        self._pairs: dict[tuple[str, int, int | None], Pair] = {}
        self._is_closing = False
        self._telling: asyncio.Task[None] | None = None
        self._pace, self._loop_s = Pace(_SHARE), 0.0

    async def start(self) -> str:
        """Listen; returns the page's address for a browser."""
        app = web.Application(middlewares=[self._answer], client_max_size=_MAX_BODY_BYTES)
        app.add_routes(
            [
                web.get("/", self._page),
                web.get("/static/{name:[a-z_/]+\\.(?:js|css)}", self._static),
                web.get("/api/scene", self._scene),
                web.get("/api/status", self._status),
                web.get("/api/events", self._events),
                web.get("/api/cell", self._cell),
                web.get("/api/lay", self._lay),
                web.get("/api/lay.png", self._lay_picture),
                web.post("/api/decide", self._decide),
                web.get("/api/export.zip", self._export),
                web.get("/api/tiles/{version}/{moment}/{zoom}/{col}/{row}.png", self._tile),
                web.get("/api/pairs/{number}", self._pair),
                web.get("/api/pairs/{number}/rivals", self._rivals),
                web.get("/api/pairs/{number}/{layer}.png", self._pair_picture),
            ]
        )
        loop = asyncio.get_running_loop()
        self._source.listen(lambda: _call_in(loop, self.notify))
        self._runner = web.AppRunner(app, access_log=None, shutdown_timeout=1.0)
        await self._runner.setup()
        assert self._runner.server is not None
        try:
            self._listening = await loop.create_server(
                self._runner.server, self._address, self._port
            )
        except OSError as error:
            raise InvalidInputError(
                f"cannot listen on {self._address} port {self._port}: {error.strerror}"
            ) from error
        # Drawn while the first page comes.
        self._map.submit(lambda: self._source.showing().tile(None, 0, 0, 0))
        port = self._listening.sockets[0].getsockname()[1]
        host = f"[{self._address}]" if ":" in self._address else self._address
        query = f"/?token={self._guard.token}" if self._guard.token else "/"
        return f"http://{host}:{port}{query}"

    async def notify(self) -> None:
        """Tell all pages that something has changed, as often as what they then ask allows."""
        if self._telling is None and not self._is_closing:
            self._telling = asyncio.create_task(self._tell())

    async def _tell(self) -> None:
        # This thread serves nothing but pages.
        self._pace.spend(time.thread_time() - self._loop_s)
        await asyncio.sleep(self._pace.wait_s(time.monotonic()))
        self._pace.begin(time.monotonic())
        self._loop_s = time.thread_time()
        self._telling = None
        async with self._changed:
            self._changed.notify_all()

    async def stop(self) -> None:
        """Close."""
        self._is_closing = True
        if self._telling is not None:
            self._telling.cancel()
        async with self._changed:
            self._changed.notify_all()
        if self._listening is not None:
            await _stop_listening(self._listening)
        if self._runner is not None and self._runner.server is not None:
            transports = [page.transport for page in self._runner.server.connections]
            await self._runner.cleanup()
            for transport in transports:
                if transport is not None:
                    # What a page did not read would keep it open.
                    transport.abort()
            await asyncio.sleep(0)
        for pool in (self._map, self._looks, self._small):
            pool.shutdown(wait=False, cancel_futures=True)

    @web.middleware
    async def _answer(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse other sites' pages and strangers; tell mistakes in a sentence."""
        refused = self._guard.refusal(request)
        if refused is not None:
            return refused
        try:
            response = await handler(request)
        except (UwDslamError, ValueError, TimeoutError) as error:
            response = web.json_response({"error": str(error)}, status=400)
        if not response.prepared:
            response.headers.update(HEADERS)
            response.headers.setdefault("Cache-Control", "no-store")
        return response

    async def _page(self, _request: web.Request) -> web.StreamResponse:
        response = web.Response(body=_static_bytes("index.html"), content_type="text/html")
        self._guard.remember(response)
        return response

    async def _static(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info["name"]
        kind = "text/javascript" if name.endswith(".js") else "text/css"
        try:
            return web.Response(body=_static_bytes(name), content_type=kind)
        except FileNotFoundError:
            return web.Response(status=404, text=f"there is no {name}")

    async def _scene(self, request: web.Request) -> web.StreamResponse:
        is_small = "gzip" in request.headers.get("Accept-Encoding", "")

        def work() -> tuple[str, bytes]:
            showing = self._source.showing()
            scene = {"title": self._source.title, **showing.scene()}
            body = json.dumps(scene, allow_nan=False).encode()
            # A quick compression: the page is near, and all of this changes often.
            return showing.version, gzip.compress(body, 1) if is_small else body

        version, body = await self._in_thread(work)
        headers = {"ETag": f'"{version}"', "Cache-Control": "no-cache", "Vary": "Accept-Encoding"}
        if request.headers.get("If-None-Match") == headers["ETag"]:
            return web.Response(status=304, headers=headers)
        if is_small:
            headers["Content-Encoding"] = "gzip"
        return web.Response(body=body, content_type="application/json", headers=headers)

    async def _status(self, _request: web.Request) -> web.StreamResponse:
        return web.json_response(await self._in_thread(self._source.status))

    async def _events(self, request: web.Request) -> web.StreamResponse:
        """A line for each change, so that pages need not ask."""
        response = web.StreamResponse(headers={**HEADERS, "Cache-Control": "no-store"})
        response.content_type = "text/event-stream"
        await response.prepare(request)
        try:
            while not self._is_closing:
                await response.write(b"data: changed\n\n")
                async with self._changed:
                    await self._changed.wait()
        except (ConnectionResetError, asyncio.CancelledError):
            pass
        return response

    async def _cell(self, request: web.Request) -> web.StreamResponse:
        x_m, y_m = float(request.query["x"]), float(request.query["y"])
        found = await self._in_thread(lambda: self._source.showing().cell(x_m, y_m))
        return web.json_response(found)

    async def _lay(self, request: web.Request) -> web.StreamResponse:
        query = request.query
        number = int(query["match"]) if "match" in query else None

        def work() -> dict[str, Any]:
            return lay_out(self._source.showing(), query["source"], query["target"], number)

        return web.json_response(await self._in_thread(work, self._looks))

    async def _lay_picture(self, request: web.Request) -> web.StreamResponse:
        name, layer = request.query["run"], request.query["layer"]

        def work() -> bytes:
            return run_map(self._source.showing(), name).picture(layer)

        body = await self._in_thread(work, self._looks)
        return web.Response(body=body, content_type="image/png")

    async def _decide(self, request: web.Request) -> web.StreamResponse:
        plain = await request.json()
        if not isinstance(plain, dict):
            raise InvalidInputError(f"the decision is {plain!r}, expected an object")
        if not str(plain.get("who", "")).strip():
            raise InvalidInputError("decision.who is empty, expected who decides")
        decision = decision_from_plain(plain)
        taken = await self._in_thread(lambda: self._source.decide(decision))
        return web.json_response({"number": taken.number})

    async def _export(self, _request: web.Request) -> web.StreamResponse:
        body = await self._in_thread(lambda: export_zip(self._source.showing()))
        return web.Response(
            body=body,
            content_type="application/zip",
            headers={"Content-Disposition": 'attachment; filename="map.zip"'},
        )

    async def _tile(self, request: web.Request) -> web.StreamResponse:
        info = request.match_info
        zoom, col, row = (int(info[name]) for name in ("zoom", "col", "row"))
        if not _MIN_ZOOM <= zoom <= _MAX_ZOOM:
            raise InvalidInputError(f"zoom is {zoom}, expected {_MIN_ZOOM} to {_MAX_ZOOM}")
        moment = None if info["moment"] == "all" else int(info["moment"])

        def work() -> bytes | None:
            return self._source.showing().tile(moment, zoom, col, row)

        body = await self._in_thread(work)
        # The address names the version, so what it holds never changes.
        if body is None:
            return web.Response(status=204, headers=_KEPT)
        return web.Response(body=body, content_type="image/png", headers=_KEPT)

    async def _pair(self, request: web.Request) -> web.StreamResponse:
        number, rival = _pair_of(request)
        pair = await self._in_thread(lambda: self._pair_at(number, rival), self._looks)
        spec = pair.spec
        return web.json_response(
            {
                "rows": spec.num_rows,
                "cols": spec.num_cols,
                "resolution_m": spec.resolution_m,
                "layers": PAIR_LAYERS,
            }
        )

    async def _pair_picture(self, request: web.Request) -> web.StreamResponse:
        number, rival = _pair_of(request)
        layer = request.match_info["layer"]
        if layer not in PAIR_LAYERS:
            raise InvalidInputError(f"layer is {layer!r}, expected one of {PAIR_LAYERS}")
        side = int(request.query.get("side", _MAX_SIDE))
        if not 1 <= side <= _MAX_SIDE:
            raise InvalidInputError(f"side is {side}, expected 1 to {_MAX_SIDE} pixels")

        is_small = side < _SMALL_SIDE

        def work() -> tuple[bytes, str | None]:
            showing = self._source.showing()
            # A list asks for many, once each.
            pair = showing.pair(number, rival) if is_small else self._pair_at(number, rival)
            return pair.picture(layer, side), look_of(showing.answer(number))

        body, look = await self._in_thread(work, self._small if is_small else self._looks)
        # Numbers of registrations may change; what is asked for by its look does not.
        is_kept = look is not None and request.query.get("look") == look
        return web.Response(body=body, content_type="image/png", headers=_KEPT if is_kept else {})

    async def _rivals(self, request: web.Request) -> web.StreamResponse:
        number, _ = _pair_of(request)

        def work() -> list[dict[str, Any]]:
            result = self._source.showing().result(number)
            return [
                {
                    "pose": rival.T_target_source.as_array().round(4).tolist(),
                    "score_share": round(float(rival.score), 4),
                }
                for rival in result.rivals
            ]

        return web.json_response(await self._in_thread(work, self._looks))

    def _pair_at(self, number: int, rival: int | None) -> Pair:
        showing = self._source.showing()
        key = showing.version, number, rival
        if key not in self._pairs:
            while len(self._pairs) >= _MAX_PAIRS:
                del self._pairs[next(iter(self._pairs))]
            self._pairs[key] = showing.pair(number, rival)
        return self._pairs[key]

    async def _in_thread(
        self, work: Callable[[], Any], pool: ThreadPoolExecutor | None = None
    ) -> Any:
        """One at a time, beside the loop, which goes on answering; by default that of the map."""

        def timed() -> Any:
            begun_s = time.thread_time()
            try:
                return work()
            finally:
                self._pace.spend(time.thread_time() - begun_s)

        return await asyncio.get_running_loop().run_in_executor(pool or self._map, timed)


async def _stop_listening(server: asyncio.Server) -> None:
    """Close, and leave no connection half made.

    What Python 3.12 accepts it makes a connection of some turns of the loop later, and fails to,
    leaving it open, if the server is closed by then (cpython issue 109564). So first nothing more
    is accepted, then what was is made a connection, which the runner knows and closes.
    """
    loop = asyncio.get_running_loop()
    for listening in server.sockets:
        loop.remove_reader(listening.fileno())
    for _ in range(_TURNS):
        await asyncio.sleep(0)
    server.close()


def _call_in(
    loop: asyncio.AbstractEventLoop, work: Callable[[], Coroutine[Any, Any, None]]
) -> None:
    """Have something done in a loop, which may have ended."""
    with contextlib.suppress(RuntimeError):
        loop.call_soon_threadsafe(lambda: loop.create_task(work()))


def _pair_of(request: web.Request) -> tuple[int, int | None]:
    rival = request.query.get("rival")
    return int(request.match_info["number"]), None if rival is None else int(rival)


@functools.cache
def _static_bytes(name: str) -> bytes:
    """A file of the page; `name` holds no dots but the last, so it stays in the folder."""
    file = resources.files("uw_dslam_ros2.view") / "static" / name
    return file.read_bytes()
