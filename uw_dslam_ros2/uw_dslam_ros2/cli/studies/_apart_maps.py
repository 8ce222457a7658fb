"""Maps that were built apart, made once, and pairs of them."""

from __future__ import annotations

import io
import itertools
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from uw_dslam_ros2.cli.studies._common import progress
from uw_dslam_ros2.cli.studies._fleet_missions import code_digest
from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.atomic import write_files
from uw_dslam_ros2.sim.maps.apart import (
    ApartMap,
    apart_pair,
    different_pair,
    make_apart_map,
)
from uw_dslam_ros2.sim.maps.pairs import MapPair
from uw_dslam_ros2.sim.missions.mapped import MappedRun

__all__ = ["apart_maps", "different_pairs", "kind_of", "matching_pairs", "twin_pairs"]

# A map depends on the registration, too, by the loops; a verdict that is fitted on the maps must
# not call for new ones.
_PARTS = ("sim", "core/sonar", "core/navigation", "core/mapping")
_KINDS = (
    "harbour", "lake", "twin", "harbour", "canal",
    "harbour", "lake", "symmetric", "harbour", "twin",
)  # fmt: skip


def kind_of(seed: int) -> str:
    """Kind of the place of a seed."""
    return _KINDS[seed % len(_KINDS)]


def apart_maps(seeds: Iterable[int], num_vehicles: int, cache: Path) -> list[ApartMap]:
    """Maps of the places of some seeds, out of the cache where the code is the same."""
    digest = code_digest("", *_PARTS)
    wanted = [(seed, vehicle) for seed in seeds for vehicle in range(num_vehicles)]
    found = (_cached(cache / digest, *one) for one in progress(wanted, text="maps"))
    return [one for one in found if one is not None]


def _cached(cache: Path, seed: int, vehicle: int) -> ApartMap | None:
    """A map; None where the vehicle finds no way through its place."""
    kind = kind_of(seed)
    path = cache / f"{kind}_{seed}_{vehicle}.npz"
    if path.exists():
        return _load(path)
    try:
        made = make_apart_map(kind, seed, vehicle)
    except InvalidInputError:
        return None
    spec = made.run.map.spec
    content = io.BytesIO()
    np.savez_compressed(
        content, kind=made.kind, site=np.array(made.site[1:]), season=made.season,
        values=made.run.map.values, resolution_m=spec.resolution_m,
        T_frame_grid=spec.T_frame_grid.as_array(),
        poses=made.run.poses, true_poses=made.run.true_poses,
    )  # fmt: skip
    write_files({path: content.getvalue()})
    return made


def _load(path: Path) -> ApartMap:
    with np.load(path) as held:
        values = held["values"]
        num_rows, num_cols = values.shape
        T_frame_grid = SE2.from_array(held["T_frame_grid"])
        spec = GridSpec(float(held["resolution_m"]), num_rows, num_cols, T_frame_grid)
        run = MappedRun(OccupancyMap(spec, values), held["poses"], held["true_poses"])
        kind, (seed, twin) = str(held["kind"]), held["site"].tolist()
        return ApartMap(kind, (kind, seed, twin), int(held["season"]), run)


def matching_pairs(maps: Sequence[ApartMap]) -> Iterator[MapPair]:
    """All pairs of maps of one place, in any order."""
    for one, other in itertools.combinations(maps, 2):
        if one.site == other.site:
            yield apart_pair(*_shuffled(one, other))


def twin_pairs(maps: Sequence[ApartMap]) -> Iterator[MapPair]:
    """All pairs of maps of two basins of one plan."""
    for one, other in itertools.combinations(maps, 2):
        if one.site[:2] == other.site[:2] and one.site != other.site:
            yield different_pair(*_shuffled(one, other))


def different_pairs(maps: Sequence[ApartMap], count: int, seed: int) -> Iterator[MapPair]:
    """Pairs of maps of places that have nothing to do with each other, so many if there are."""
    everything = [
        pair for pair in itertools.combinations(maps, 2) if pair[0].site[:2] != pair[1].site[:2]
    ]
    order = np.random.default_rng(seed).permutation(len(everything))[:count]
    for number in order:
        yield different_pair(*_shuffled(*everything[number]))


def _shuffled(one: ApartMap, other: ApartMap) -> tuple[ApartMap, ApartMap]:
    """In an order that says nothing of who came first, but the same each time."""
    is_turned = (len(one.run.poses) + 3 * len(other.run.poses)) % 2
    return (other, one) if is_turned else (one, other)
