"""Ours and other methods on the same pairs of maps: right, wrong, refused, time."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from uw_dslam_ros2.cli.studies._common import print_table, progress
from uw_dslam_ros2.core.errors import ConfigError
from uw_dslam_ros2.core.grid import FREE, OCCUPIED, UNKNOWN, GridSpec, OccupancyMap
from uw_dslam_ros2.core.registration import register_grids
from uw_dslam_ros2.core.registration.baselines import (
    akaze_ransac,
    fourier_mellin,
    hough_spectrum,
    orb_ransac,
)
from uw_dslam_ros2.core.registration.baselines.peers import is_installed, kiss_matcher
from uw_dslam_ros2.core.registration.baselines.result import BaselineResult
from uw_dslam_ros2.core.registration.grids.config import GridRegistrationConfig
from uw_dslam_ros2.core.registration.grids.judging.verdict import decide
from uw_dslam_ros2.core.registration.grids.register import match_evidence
from uw_dslam_ros2.core.registration.result import Verdict
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.maps.pairs import MapPair, is_right

__all__ = ["MAP_METHODS", "add_method_arguments", "at_one_resolution", "compare"]

_KISS = "kiss-matcher"
MapMethod = Callable[[OccupancyMap, OccupancyMap], SE2 | None]
"""``T_target_source``, or None where the method refuses."""

_WALL_PERCENT = 65
_VOXEL_CELLS = 2.0


def add_method_arguments(parser: argparse.ArgumentParser) -> None:
    """Option by which a study compares methods."""
    parser.add_argument(
        "--methods", nargs="*", default=[], choices=MAP_METHODS, metavar="METHOD",
        help=f"also compare methods on these pairs: {', '.join(MAP_METHODS)}",
    )  # fmt: skip


def compare(pairs: Sequence[MapPair], names: Sequence[str]) -> list[dict[str, Any]]:
    """Ask every method about every pair, and print what became of them; rows for a CSV file.

    Raises
    ------
    ConfigError
        For a method that is not installed.
    """
    if _KISS in names and not is_installed("kiss_matcher"):
        raise ConfigError(f"method {_KISS} is not installed, expected: pip install kiss-matcher")
    rows: list[dict[str, Any]] = []
    for number, pair in enumerate(progress(pairs, text="methods")):
        for name in names:
            begun_s = time.process_time()
            motion = MAP_METHODS[name](pair.source, pair.target)
            cpu_s = time.process_time() - begun_s
            rows.append(
                {
                    "pair": number,
                    "method": name,
                    "matching": pair.T_target_source is not None,
                    "given": motion is not None,
                    "right": is_right(pair, motion),
                    "cpu_s": round(cpu_s, 3),
                }
            )
    table = []
    for name in names:
        own = [row for row in rows if row["method"] == name]
        same = [row for row in own if row["matching"]]
        other = [row for row in own if not row["matching"]]
        right = sum(row["right"] for row in same)
        given = sum(row["given"] for row in same)
        table.append(
            (
                name,
                f"{right} of {len(same)}",
                given - right,
                len(same) - given,
                f"{sum(row['given'] for row in other)} of {len(other)}",
                f"{np.median([row['cpu_s'] for row in own]):.2f}",
            )
        )
    print_table(
        ("method", "one place: right", "wrong", "refused", "two places: given", "CPU s, median"),
        table,
    )
    return rows


def at_one_resolution(
    source: OccupancyMap, target: OccupancyMap
) -> tuple[OccupancyMap, OccupancyMap]:
    """Both maps, the finer one in the cells of the other: a wall in any of its cells stays one."""
    cell_m = max(source.spec.resolution_m, target.spec.resolution_m)
    return _coarsened(source, cell_m), _coarsened(target, cell_m)


def _coarsened(occupancy: OccupancyMap, cell_m: float) -> OccupancyMap:
    spec = occupancy.spec
    if spec.resolution_m == cell_m:
        return occupancy
    ratio = spec.resolution_m / cell_m
    cells = np.argwhere(occupancy.known)
    values = np.where(occupancy.values[cells[:, 0], cells[:, 1]] >= _WALL_PERCENT, OCCUPIED, FREE)
    places = np.floor((cells + 0.5) * ratio).astype(np.int64)
    num_rows, num_cols = (int(np.ceil(side * ratio)) for side in spec.shape)
    coarse = np.full((num_rows, num_cols), UNKNOWN, np.int8)
    np.maximum.at(coarse, (places[:, 0], places[:, 1]), values.astype(np.int8))
    return OccupancyMap(GridSpec(cell_m, num_rows, num_cols, spec.T_frame_grid), coarse)


def _ours(source: OccupancyMap, target: OccupancyMap) -> SE2 | None:
    result = register_grids(source, target)
    return result.T_target_source if result.is_accepted else None


def _without_proof(source: OccupancyMap, target: OccupancyMap) -> SE2 | None:
    """What would be accepted of the scan's poses: what the certificate changes is the rest."""
    found = match_evidence(source, target)
    if found is None:
        return None
    evidence, poses = found
    verdict, _, _ = decide(evidence, GridRegistrationConfig())
    return poses[0][1] if verdict is Verdict.ACCEPTED else None


def _kiss(source: OccupancyMap, target: OccupancyMap) -> BaselineResult:
    """KISS-Matcher on the walls, in voxels of two cells; its best of 1.5, 2 and 3."""
    walls = (
        one.spec.centers_of(np.argwhere(one.values >= _WALL_PERCENT)) for one in (source, target)
    )
    return kiss_matcher(*walls, voxel_m=_VOXEL_CELLS * source.spec.resolution_m)


def _at_one(method: Callable[..., Any]) -> MapMethod:
    return lambda source, target: method(*at_one_resolution(source, target)).T_target_source


MAP_METHODS: dict[str, MapMethod] = {
    "ours": _ours,
    "without-proof": _without_proof,
    "orb": _at_one(orb_ransac),
    "akaze": _at_one(akaze_ransac),
    "hough": _at_one(hough_spectrum),
    "fourier-mellin": _at_one(fourier_mellin),
    _KISS: _at_one(_kiss),
}
"""The engine, the engine without its certificate, what map-merging packages use, and a matcher of
3-D scans that is no dependency.
"""
