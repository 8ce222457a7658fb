"""How well windows of your own maps are registered: overlap, noise, and windows that do not match.

Windows are cut at random places and angles out of maps that map_server reads, so that the answer
is known, damaged as in the other studies, and registered with the proof. Places with too little in
them are passed over. Every map also gives windows that share nothing, with each other and with
those of the next map.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.cli.studies._common import print_table, progress, write_csv
from uw_dslam_ros2.cli.studies._map_methods import add_method_arguments, compare
from uw_dslam_ros2.cli.studies._map_pairs import (
    SHARES,
    accepted_of_different,
    registered,
    shares,
)
from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.maps.files import read_map
from uw_dslam_ros2.sim.maps.pairs import NOISES, MapPair, cut_pair, cut_window, windows_about

Row = dict[str, Any]
Values = NDArray[np.int8]
_LEAST_KNOWN = 0.25  # of a window's cells
_LEAST_COMMON_KNOWN = 0.15  # of the common area
_WALLS_PER_SIDE = 1.0  # wall cells of a window, per cell of its side, and a quarter in common
_WALL_PERCENT = 65
_NUM_TRIES = 3000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this study."""
    parser.add_argument(
        "--maps", type=Path, nargs="+", required=True, metavar="YAML", help="map_server maps"
    )
    parser.add_argument("--size", type=float, default=13.0, help="window's side [m] (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of places and noise (%(default)s)")
    parser.add_argument("--places", type=int, default=1, help="per map, overlap (%(default)s)")
    parser.add_argument("--overlaps", nargs="+", type=float, default=[0.7, 0.5, 0.3])
    parser.add_argument("--noises", nargs="+", default=list(NOISES), choices=list(NOISES))
    add_method_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Cut, register, print tables."""
    maps = _read(args.maps)
    pairs = [pair for number in range(args.places) for pair in _pairs(maps, args, number)]
    rows = [
        {"map": p.kind, "overlap": p.overlap, "noise": p.noise, **registered(p)}
        for p in progress(pairs, text="pairs")
    ]
    write_csv(args.out / "windows.csv", rows)
    matching = [r for r in rows if r["matching"]]
    for name, keys in (("map", maps), ("noise", args.noises), ("overlap", args.overlaps)):
        groups = [(key, [r for r in matching if r[name] == key]) for key in keys]
        table = [(key, len(members), *shares(members)) for key, members in groups if members]
        print_table((name, "pairs", *SHARES), [*table, ("all", len(matching), *shares(matching))])
    print(accepted_of_different(rows))
    seconds = [r["seconds"] for r in rows]
    print(f"time: median {np.median(seconds):.2f} s, p90 {np.quantile(seconds, 0.9):.2f} s")
    if args.methods:
        write_csv(args.out / "methods.csv", compare(pairs, args.methods))
    return 0


def _read(paths: list[Path]) -> dict[str, OccupancyMap]:
    """Maps by the names of their files, which the tables go by."""
    maps: dict[str, OccupancyMap] = {}
    for path in paths:
        if path.stem in maps:
            raise InvalidInputError(
                f"--maps names two files {path.name}, expected files of different names"
            )
        maps[path.stem] = read_map(path)
    return maps


def _pairs(
    maps: dict[str, OccupancyMap], args: argparse.Namespace, number: int
) -> Iterator[MapPair]:
    names = list(maps)
    for index, name in enumerate(names):
        size_cells = round(args.size / maps[name].spec.resolution_m)
        for overlap in args.overlaps:
            rng = np.random.default_rng((args.seed, number, index, round(1000 * overlap)))
            windows = _places(name, maps[name].values, size_cells, overlap, rng)
            for noise in args.noises:
                yield _pair(maps, (name, name), windows, overlap, noise, size_cells, rng)
        other = names[(index + 1) % len(names)]
        for noise in args.noises:
            rng = np.random.default_rng((args.seed, number, index, sum(noise.encode())))
            windows = _places(name, maps[name].values, size_cells, 0.0, rng)
            yield _pair(maps, (name, name), windows, 0.0, noise, size_cells, rng)
            same_size = round(args.size / maps[other].spec.resolution_m) == size_cells
            if other != name and same_size:
                elsewhere = _places(other, maps[other].values, size_cells, 0.0, rng)
                both = (windows[0], elsewhere[0])
                yield _pair(maps, (name, other), both, 0.0, noise, size_cells, rng)


def _pair(
    maps: dict[str, OccupancyMap],
    names: tuple[str, str],
    windows: tuple[SE2, SE2],
    overlap: float,
    noise: str,
    size_cells: int,
    rng: np.random.Generator,
) -> MapPair:
    return cut_pair(
        maps[names[0]].values, maps[names[1]].values, names[0], overlap, noise, rng,
        size_cells=size_cells, resolution_m=maps[names[0]].spec.resolution_m,
        is_matching=overlap > 0.0, T_world_windows=windows,
    )  # fmt: skip


def _places(
    name: str, values: Values, size_cells: int, overlap: float, rng: np.random.Generator
) -> tuple[SE2, SE2]:
    """Poses of two windows with enough in them, in cells; without overlap where that is 0."""
    known = np.argwhere(values >= 0)
    is_hopeless = len(known) == 0 or size_cells > max(values.shape)
    for _ in range(0 if is_hopeless else _NUM_TRIES):
        yaw_a, yaw_b, heading = rng.uniform(-math.pi, math.pi, 3)
        row, col = known[rng.integers(len(known))]
        center = np.array([col, row]) + rng.normal(0.0, size_cells / 6.0, 2)
        T_a, T_b = windows_about(center, (yaw_a, yaw_b), heading, size_cells, max(overlap, 1e-9))
        if overlap == 0.0:  # anywhere else, not only next to it
            distance = float(rng.uniform(0.0, max(values.shape)))
            T_b = SE2(distance * math.cos(heading), distance * math.sin(heading), 0.0) @ T_b
        first = cut_window(values, T_a, size_cells)
        if not (_has_enough(first) and _share_enough(first, T_a, T_b, overlap)):
            continue
        if _has_enough(cut_window(values, T_b, size_cells)):
            return T_a, T_b
    raise InvalidInputError(
        f"map {name}: no two windows of {size_cells} cells with {overlap:.0%} in common have "
        f"enough in them, expected a larger map, or ask for smaller ones (--size)"
    )


def _has_enough(window: Values) -> bool:
    num_walls = int((window >= _WALL_PERCENT).sum())
    is_seen = float((window >= 0).mean()) >= _LEAST_KNOWN
    return is_seen and num_walls >= _WALLS_PER_SIDE * len(window)


def _share_enough(window: Values, T_a: SE2, T_b: SE2, overlap: float) -> bool:
    """Whether the common area is seen and has walls; that windows apart are apart."""
    rows, cols = np.indices(window.shape)
    centers = np.column_stack([cols.ravel() + 0.5, rows.ravel() + 0.5])
    inside = (T_b.inverse() @ T_a).apply(centers)
    common = ((inside >= 0.0) & (inside < len(window))).all(axis=1).reshape(window.shape)
    if overlap == 0.0:
        return not common.any()
    num_walls = int((window[common] >= _WALL_PERCENT).sum())
    is_seen = float((window[common] >= 0).mean()) >= _LEAST_COMMON_KNOWN
    return is_seen and num_walls >= 0.25 * _WALLS_PER_SIDE * len(window)
