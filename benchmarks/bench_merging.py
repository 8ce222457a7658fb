"""Merging of many submaps: searches, time and memory over their number.

``python benchmarks/bench_merging.py [CASE ...] [--quick]`` prints one JSON line per measurement.
The matcher knows the truth, so that only the merging is timed; every case checks the poses first.
"""

from __future__ import annotations

import math
import resource
import sys
import tempfile
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from harness import Timing, emit, require, run_cases, timed

from uw_dslam_ros2.core.grid import FREE, OCCUPIED, UNKNOWN, GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging import MapQueue
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap, SubmapId
from uw_dslam_ros2.io.maps.files import write_map
from uw_dslam_ros2.io.maps.provenance import write_provenance
from uw_dslam_ros2.sim.maps.fleets import Fleet, KnowingMatcher, answer_all, lawnmower_fleet

_MAX_RMSE_M = 0.5  # one cell, for a hundred submaps
_NUM_LATE = 10


def batch(quick: bool) -> None:
    """All submaps at once. Searches and time over their number, up to 10 vehicles x 10."""
    sizes = (2, 4) if quick else (2, 4, 6, 8, 10)
    numbers, searches, seconds = [], [], []
    for size in sizes:
        fleet = lawnmower_fleet(size, size, 0)
        timing = Timing()
        queue, num_searches = timed(lambda f=fleet: _settled(f), timing)
        total = len(fleet.submaps)
        numbers.append(total)
        searches.append(num_searches)
        seconds.append(timing.cpu_s[0])
        emit(
            "batch",
            {
                "num_submaps": total,
                "num_searches": num_searches,
                "num_pairs": total * (total - 1) // 2,
                "searches_per_pair": num_searches / (total * (total - 1) / 2),
                "rmse_m": fleet.position_rmse_m(queue),
                **timing.row(),
            },
        )
    slopes = _slope(numbers, searches), _slope(numbers, seconds)
    emit("batch exponents", {"searches_exponent": slopes[0], "cpu_exponent": slopes[1]})


def incremental(quick: bool) -> None:
    """Submaps one by one, vehicles in turn, while more are expected; then what is left."""
    size = 3 if quick else 10
    fleet = lawnmower_fleet(size, size, 0)
    matcher, queue = KnowingMatcher(fleet), MapQueue()
    drawing, settling, searches, ending = Timing(), Timing(), [], Timing()
    for submap_id in sorted(fleet.submaps, key=lambda i: (i.sequence, i.vehicle_id)):
        queue.is_growing = True
        timed(lambda i=submap_id: _add_and_draw(queue, fleet, i), drawing)
        searches.append(timed(lambda: answer_all(queue, matcher), settling))
    queue.is_growing = False
    num_left = timed(lambda: answer_all(queue, matcher), ending)
    _check(fleet, queue)
    emit(
        "incremental",
        {
            "num_submaps": len(fleet.submaps),
            "num_searches": sum(searches) + num_left,
            "searches_per_submap_mean": float(np.mean(searches)),
            "searches_per_submap_p95": float(np.percentile(searches, 95)),
            "searches_in_the_end": num_left,
            "rmse_m": fleet.position_rmse_m(queue),
            **drawing.row("add_and_draw_"),
            **settling.row("settle_"),
            "end_cpu_s": ending.cpu_s[0],
        },
    )


def fleets(quick: bool) -> None:
    """20 vehicles x 20 submaps and 50 x 50: all at once, then the last few one by one."""
    numbers, seconds, late = [], [], []
    for size in (4, 8) if quick else (20, 50):
        fleet, queue = lawnmower_fleet(size, size, 0), MapQueue()
        last = [i for i in sorted(fleet.submaps) if i.sequence == size - 1][:_NUM_LATE]
        settling, adding, drawing, asking = Timing(), Timing(), Timing(), Timing()
        for submap_id in sorted(fleet.submaps.keys() - set(last)):
            queue.add_submap(fleet.submaps[submap_id])
        matcher = KnowingMatcher(fleet)
        num_searches = timed(lambda q=queue, m=matcher: answer_all(q, m), settling)
        queue.global_map()
        queue.is_growing = True
        queue.submaps()
        for submap_id in last:
            timed(lambda f=fleet, q=queue, i=submap_id: _add_and_plan(q, f, i), adding)
            timed(lambda q=queue: q.changed_window(), drawing)
            num_searches += timed(lambda q=queue, m=matcher: answer_all(q, m), asking)
        queue.is_growing = False
        num_searches += timed(lambda q=queue, m=matcher: answer_all(q, m), settling)
        num_components = len({r.component for r in queue.submaps()})
        require(num_components == 1, f"{num_components} components instead of one")
        numbers.append(len(fleet.submaps))
        seconds.append(sum(settling.cpu_s))
        late.append(float(np.median(adding.cpu_s)))
        emit(
            "fleets",
            {
                "num_submaps": numbers[-1],
                "num_searches": num_searches,
                "rmse_m": fleet.position_rmse_m(queue),
                "settle_cpu_s": seconds[-1],
                **adding.row("add_plan_"),
                **drawing.row("draw_"),
                **asking.row("ask_"),
                "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
            },
        )
    slopes = _slope(numbers, seconds), _slope(numbers, late)
    emit("fleets exponents", {"settle_exponent": slopes[0], "add_exponent": slopes[1]})


def memory(quick: bool) -> None:
    """Bytes that a settled queue holds, beside those of the submaps' grids."""
    size = 3 if quick else 10
    fleet = lawnmower_fleet(size, size, 0)
    tracemalloc.start()
    queue, _ = _settled(fleet)
    held, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    grids = sum(submap.grid.values.nbytes for submap in fleet.submaps.values())
    require(queue.global_map() is not None, "no map")
    emit("memory", {"num_submaps": size**2, "grids": grids, "held": held, "peak": peak})


def large(quick: bool) -> None:
    """An L of two arms at 0.05 m: memory by what was seen; what is too far away is left out."""
    for arm_m in (200.0,) if quick else (950.0, 2000.0):
        tracemalloc.start()
        queue = MapQueue()
        for submap in _along_an_l(arm_m):
            queue.add_submap(submap)
        changed = queue.changed_window()
        held, _ = tracemalloc.get_traced_memory()
        require(changed is not None, "nothing was drawn")
        seen_peak, map_peak = _written(queue)
        tracemalloc.stop()
        records = queue.submaps()
        left_out = [record for record in records if "not drawn" in record.reason]
        emit(
            "large",
            {
                "arm_m": arm_m,
                "num_submaps": len(records),
                "num_left_out": len(left_out),
                "num_kept": len(queue.to_state().submaps),
                "map_cells": math.prod(changed[0].shape) if changed else 0,
                "grids_mb": sum(r.submap.grid.values.nbytes for r in records) * 1e-6,
                "held_mb": held * 1e-6,
                "provenance_peak_mb": seen_peak * 1e-6,
                "map_peak_mb": map_peak * 1e-6,
            },
        )
        require(bool(left_out) == (arm_m > 1000.0), f"{len(left_out)} left out")


def _written(queue: MapQueue) -> list[int]:
    """Most bytes there were while who saw what, and then the map, was made and written."""
    peaks = []
    with tempfile.TemporaryDirectory() as folder:
        for ask, write in (
            (queue.provenance, write_provenance),
            (queue.global_map, write_map),
        ):
            tracemalloc.reset_peak()
            found = ask()
            require(found is not None, "there is no map")
            write(Path(folder) / "map", found)
            peaks.append(tracemalloc.get_traced_memory()[1])
            del found
    return peaks


def _along_an_l(arm_m: float) -> Iterator[Submap]:
    """Round views of 30 m, every 20 m, along two arms."""
    num_cells, step_m = 600, 20.0
    center = np.hypot(*np.mgrid[-299.5:300, -299.5:300]) < 300.0
    values = np.where(center, FREE, UNKNOWN).astype(np.int8)
    values[280, 100:500] = OCCUPIED
    grid = OccupancyMap(GridSpec(0.05, num_cells, num_cells, SE2(-15.0, -15.0)), values)
    steps = np.arange(0.0, arm_m, step_m)
    way = [SE2(x, 0.0, 0.0) for x in steps] + [SE2(arm_m, y, 0.5 * math.pi) for y in steps]
    for number, pose in enumerate(way):
        yield Submap(
            vehicle_id="auv_1",
            sequence=number,
            revision=0,
            is_final=True,
            stamp_ns=number + 1,
            T_odom_submap=pose,
            covariance=np.diag([1e-4, 1e-4, 1e-6]),
            grid=OccupancyMap(grid.spec, values.copy()),
        )


def _settled(fleet: Fleet) -> tuple[MapQueue, int]:
    queue = MapQueue()
    for submap_id in sorted(fleet.submaps):
        queue.add_submap(fleet.submaps[submap_id])
    num_searches = answer_all(queue, KnowingMatcher(fleet))
    _check(fleet, queue)
    return queue, num_searches


def _check(fleet: Fleet, queue: MapQueue) -> None:
    require({r.component for r in queue.submaps()} == {0}, "not all submaps are merged")
    error_m = fleet.position_rmse_m(queue)
    require(error_m <= _MAX_RMSE_M, f"{error_m} m off")
    require(queue.global_map() is not None, "no map")


def _add_and_draw(queue: MapQueue, fleet: Fleet, submap_id: SubmapId) -> None:
    queue.add_submap(fleet.submaps[submap_id])
    queue.changed_window()


def _add_and_plan(queue: MapQueue, fleet: Fleet, submap_id: SubmapId) -> None:
    queue.add_submap(fleet.submaps[submap_id])
    queue.next_requests(0)


def _slope(numbers: list[int], values: list[float]) -> float:
    if len(numbers) < 2:
        return math.nan
    return float(np.polyfit(np.log(numbers), np.log(values), 1)[0])


if __name__ == "__main__":
    cases = {
        "batch": batch,
        "incremental": incremental,
        "fleets": fleets,
        "memory": memory,
        "large": large,
    }
    sys.exit(run_cases(__doc__ or "", cases))
