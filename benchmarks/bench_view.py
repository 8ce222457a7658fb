"""What a view costs that follows ten vehicles with fifty submaps each, five times a second."""

from __future__ import annotations

import asyncio
import dataclasses
import gzip
import sys
import time

import aiohttp
import numpy as np
from harness import emit, require, run_cases

from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging import Constraint, ConstraintKind, SubmapRecord, SubmapState
from uw_dslam_ros2.core.merging.graph.answers import Answer, Query
from uw_dslam_ros2.core.merging.graph.submap_groups import StoredSubmap, SubmapGroup
from uw_dslam_ros2.core.registration.result import Verdict
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap
from uw_dslam_ros2.view.server import ViewServer
from uw_dslam_ros2.view.showing import Showing

VEHICLES, SUBMAPS, UPDATES, RATE_HZ = 10, 50, 16, 5.0
SIDE, RESOLUTION_M = 400, 0.1
TILES = [(1, col, row) for col in range(-1, 4) for row in range(-3, 1)]


def make_submap(vehicle: int, sequence: int, revision: int = 0) -> Submap:
    """A square basin with a wall, seen from its middle on a way of twenty seconds."""
    rng = np.random.default_rng([vehicle, sequence, revision])
    values = np.full((SIDE, SIDE), -1, np.int8)
    rows, cols = np.mgrid[:SIDE, :SIDE] - SIDE // 2
    values[rows**2 + cols**2 < (0.45 * SIDE) ** 2] = 0
    values[rng.integers(50, 350) :][:3, 60:340] = 100
    way = np.column_stack([np.linspace(-6.0, 6.0, 200), np.zeros((200, 2))])
    half_m = 0.5 * SIDE * RESOLUTION_M
    spec = GridSpec(RESOLUTION_M, SIDE, SIDE, SE2(-half_m, -half_m))
    stamp_ns = (1000 + 20 * sequence) * 10**9
    return Submap(
        f"auv_{vehicle}", sequence, revision, True, stamp_ns, SE2(12.0 * sequence),
        np.eye(3) * 1e-3, OccupancyMap(spec, values),
        trajectory=way, trajectory_stamp_ns=stamp_ns + np.arange(200) * 10**8, run_id=1,
    )  # fmt: skip


def make_state() -> tuple[list[SubmapRecord], list[Constraint], list[tuple[Answer, bool]]]:
    """Everything joined: rows of submaps, odometry, and a match between neighbours."""
    records, constraints, answers = [], [], []
    for vehicle in range(VEHICLES):
        for sequence in range(SUBMAPS):
            pose = SE2(12.0 * sequence, 20.0 * vehicle, 0.01 * sequence)
            submap = make_submap(vehicle, sequence)
            records.append(SubmapRecord(submap, SubmapState.MERGED, 0, pose, 3, "registered"))
    by_id = {r.submap.submap_id: r for r in records}
    covariance = np.eye(3) * 1e-3
    for record in records:
        own = record.submap.submap_id
        for kind, other in (
            (ConstraintKind.ODOMETRY, own._replace(sequence=own.sequence - 1)),
            (ConstraintKind.REGISTRATION, own._replace(vehicle_id=f"auv_{int(own[0][4:]) + 1}")),
        ):
            if other not in by_id:
                continue
            motion = by_id[other].T_component_submap.inverse() @ record.T_component_submap
            constraints.append(Constraint(kind, own, other, motion, covariance, 0.05, 0.001, True))
            if kind is ConstraintKind.REGISTRATION:
                groups = [
                    SubmapGroup.of([StoredSubmap.of(by_id[i].submap, 10**6)], [SE2()], 0)
                    for i in (own, other)
                ]
                answer = Answer(
                    Query(*groups), Verdict.ACCEPTED, "agrees", motion, covariance, 0.99,
                    {"score": 0.5, "overlap": 0.4},
                )  # fmt: skip
                answers.append((answer, True))
    return records, constraints, answers


class Moving:
    """A merge in which a submap grows and the graph gives a little with every update."""

    title = "ten vehicles"

    def __init__(self) -> None:
        self.records, self.constraints, self.answers = make_state()
        self.number = 0
        self.shown = Showing(self.records, self.constraints, self.answers)

    def update(self) -> None:
        """The next state."""
        self.number += 1
        index = (self.number % VEHICLES) * SUBMAPS + SUBMAPS - 1
        old = self.records[index]
        own = make_submap(self.number % VEHICLES, SUBMAPS - 1, self.number)
        self.records[index] = dataclasses.replace(old, submap=own)
        # A solution moves the newest by a millimetre or two, which shows in no cell.
        for k in range(index - 5, index + 1):
            record = self.records[k]
            nudged = record.T_component_submap @ SE2(0.001)
            self.records[k] = dataclasses.replace(record, T_component_submap=nudged)
        self.shown = Showing(self.records, self.constraints, self.answers, self.shown)

    def showing(self) -> Showing:
        """The newest state."""
        return self.shown

    def status(self) -> dict[str, object]:
        """Nothing else."""
        return {"is_live": True, "notes": []}

    def listen(self, on_change) -> None:  # type: ignore[no-untyped-def]
        """Pages are told by the benchmark."""

    def decide(self, decision):  # type: ignore[no-untyped-def]
        """Not asked here."""
        return decision


async def one_by_one(moving: Moving, num_updates: int) -> dict[str, float]:
    """Have a page fetch the scene and the tiles of its window after each update."""
    server = ViewServer(moving, "127.0.0.1", 0)
    base = (await server.start()).rstrip("/")
    cpu_s = {"update": 0.0, "scene": 0.0, "tiles": 0.0}
    num_bytes = 0
    try:
        async with aiohttp.ClientSession(auto_decompress=False) as session:
            for number in range(num_updates):
                marks = [time.process_time()]
                if number:
                    moving.update()
                marks.append(time.process_time())
                body = await fetch(session, f"{base}/api/scene")
                num_bytes = len(body)
                marks.append(time.process_time())
                await fetch_tiles(session, base, moving)
                marks.append(time.process_time())
                if number:  # the first draws all
                    for name, begin, end in zip(cpu_s, marks, marks[1:], strict=False):
                        cpu_s[name] += end - begin
        require(gzip.decompress(body).count(b'"outline"') == VEHICLES * SUBMAPS, "all submaps")
    finally:
        await server.stop()
    per = {f"{name}_cpu_ms": 1e3 * value / (num_updates - 1) for name, value in cpu_s.items()}
    return per | {"scene_bytes": float(num_bytes)}


async def fetch(session: aiohttp.ClientSession, url: str) -> bytes:
    """What is there."""
    async with session.get(url) as response:
        require(response.status in (200, 204), url)
        return await response.read()


async def fetch_tiles(session: aiohttp.ClientSession, base: str, moving: Moving) -> None:
    """Those of a page's window, as of the newest state."""
    for zoom, col, row in TILES:
        await fetch(session, f"{base}/api/tiles/{moving.shown.version}/all/{zoom}/{col}/{row}.png")


async def in_time(moving: Moving, seconds: float) -> dict[str, float]:
    """Update as often as a graph does, and have a page follow what it is told."""
    server = ViewServer(moving, "127.0.0.1", 0)
    base = (await server.start()).rstrip("/")
    told = 0

    async def page() -> None:
        nonlocal told
        no_limit = aiohttp.ClientTimeout(total=None)
        async with (
            aiohttp.ClientSession(auto_decompress=False, timeout=no_limit) as session,
            session.get(f"{base}/api/events") as events,
        ):
            async for line in events.content:
                if line.startswith(b"data"):
                    await fetch(session, f"{base}/api/scene")
                    await fetch_tiles(session, base, moving)
                    told += 1

    task = asyncio.create_task(page())
    while told == 0:  # the first draws all
        await asyncio.sleep(0.05)
    begun, cpu_s = time.monotonic(), time.process_time()
    update_s, first = 0.0, told
    while (now := time.monotonic() - begun) < seconds:
        before = time.process_time()
        moving.update()
        update_s += time.process_time() - before
        await server.notify()
        await asyncio.sleep(max(0.0, 1.0 / RATE_HZ - (time.monotonic() - begun - now)))
    wall_s, cpu_s = time.monotonic() - begun, time.process_time() - cpu_s
    task.cancel()
    await server.stop()
    return {
        "share_of_a_core": cpu_s / wall_s,
        "of_it_updates": update_s / wall_s,
        "updates_hz": moving.number / wall_s,
        "shown_hz": (told - first) / wall_s,
    }


def update(quick: bool) -> None:
    """CPU of one update with a page open. Server and page's requests count together."""
    emit("update", asyncio.run(one_by_one(Moving(), 6 if quick else UPDATES)))


def live(quick: bool) -> None:
    """Share of a core with a page open while all is updated. The page's requests count, too."""
    found = asyncio.run(in_time(Moving(), 4.0 if quick else 20.0))
    emit("live", {"vehicles": VEHICLES, "submaps": VEHICLES * SUBMAPS, **found})
    require(found["share_of_a_core"] < 0.5, "at most half a core")


if __name__ == "__main__":
    sys.exit(run_cases(__doc__ or "", {"update": update, "live": live}))
