"""The paper's Figures 8 and 9: two maps merged by ours, the paper's, ICP, NDT, ORB + RANSAC.

All methods see the same pairs. MSE and SSIM compare the merged map with the one merged by the true
motion; success stands beside them, because a method that refuses leaves one map alone and gets a
flattering MSE. ICP and NDT also get 36 starting headings. The pictures show submap boundaries in
red dots, passable space white, unknown grey, walls black. Where UW_DATA_DIR is set, submaps of a
real marina that share at least 30 % are matched as well.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.cli.studies._common import (
    figure,
    print_table,
    progress,
    save_figure,
    write_csv,
)
from uw_dslam_ros2.cli.studies._map_pairs import PairSpec
from uw_dslam_ros2.cli.studies._real_pairs import has_recording, real_pairs
from uw_dslam_ros2.core.features.grid_points import grid_points
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.metrics import compare_maps, resample
from uw_dslam_ros2.core.registration.baselines.icp import icp, many_start_icp
from uw_dslam_ros2.core.registration.baselines.ndt import ndt
from uw_dslam_ros2.core.registration.baselines.orb_ransac import orb_ransac
from uw_dslam_ros2.core.registration.grids.register import GridRegistrationConfig, register_grids
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.maps.pairs import MapPair, is_right, pair_errors

Row = dict[str, Any]
Method = Callable[[MapPair], SE2 | None]
_NUM_POINTS = 800
_NUM_MANY_START_POINTS = 300
_NUM_PAPER_POINTS = 60
_NUM_PAPER_BOXES = 20_000
_FIRST_SEED = 3000  # others than those of `study verdict`
_LEAST_REAL_OVERLAP = 0.3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this study."""
    parser.add_argument("--seeds", type=int, default=1, help="places of each kind (%(default)s)")
    parser.add_argument("--kinds", nargs="+", default=["harbour", "lake", "office"])
    parser.add_argument("--overlaps", nargs="+", type=float, default=[0.7, 0.5, 0.3])
    parser.add_argument("--noises", nargs="+", default=["clean", "noisy", "hard"])
    parser.add_argument("--real", type=int, default=8, help="most real pairs (%(default)s)")
    parser.add_argument("--data", type=Path, metavar="DIR", help="recordings ($UW_DATA_DIR)")


def run(args: argparse.Namespace) -> int:
    """Register every pair with every method; table, CSV file, pictures of the first pairs."""
    rows: list[Row] = []
    for spec, pair in progress(_pairs(args), text="pairs"):
        motions = {name: method(pair) for name, method in _methods().items()}
        rows.extend(_scored(spec, pair, name, motion) for name, motion in motions.items())
        if spec.seed in (_FIRST_SEED, 0) and spec.noise in ("noisy", "real"):
            _draw(args.out / f"{spec.kind}_{round(100 * spec.overlap)}.png", pair, motions)
    write_csv(args.out / "field.csv", rows)
    print_table(
        (
            "places", "method", "right", "wrong", "MSE", "SSIM", "median error [m]",
            "median error [deg]",
        ),
        _table(rows),
    )  # fmt: skip
    return 0


def _pairs(args: argparse.Namespace) -> list[tuple[PairSpec, MapPair]]:
    specs = [
        PairSpec(kind, overlap, noise, seed)
        for seed in range(_FIRST_SEED, _FIRST_SEED + args.seeds)
        for kind in args.kinds
        for overlap in args.overlaps
        for noise in args.noises
    ]
    pairs = [(spec, spec.make()) for spec in specs]
    if args.data is not None or has_recording():
        real = [p for p in real_pairs(args.data) if p.overlap >= _LEAST_REAL_OVERLAP]
        step = max(1, len(real) // max(args.real, 1))
        for number, pair in enumerate(real[::step][: args.real]):
            pairs.append((PairSpec("aracati", pair.overlap, "real", number), pair))
    return pairs


def _table(rows: list[Row]) -> Iterator[tuple[str, ...]]:
    for kind in dict.fromkeys(r["kind"] for r in rows):
        for name in _methods():
            own = [r for r in rows if (r["kind"], r["method"]) == (kind, name)]
            answered = [r for r in own if r["answered"]]
            yield (
                kind,
                name,
                f"{np.mean([r['right'] for r in own]):.2f}",
                f"{np.mean([r['answered'] and not r['right'] for r in own]):.2f}",
                f"{np.mean([r['mse'] for r in own]):.4f}",
                f"{np.mean([r['ssim'] for r in own]):.3f}",
                f"{np.median([r['error_m'] for r in answered]):.2f}" if answered else "-",
                f"{np.median([r['error_deg'] for r in answered]):.2f}" if answered else "-",
            )


def _points(
    pair: MapPair, num_points: int = _NUM_POINTS
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return (
        grid_points(pair.source, "walls", num_points)[0],
        grid_points(pair.target, "walls", num_points)[0],
    )


def _centred(pair: MapPair) -> SE2:
    """The windows laid on each other: what a caller without any idea starts from."""
    source, target = (m.spec.corners().mean(axis=0) for m in (pair.source, pair.target))
    return SE2(float(target[0] - source[0]), float(target[1] - source[1]), 0.0)


def _accepted(pair: MapPair, config: GridRegistrationConfig) -> SE2 | None:
    result = register_grids(pair.source, pair.target, config)
    return result.T_target_source if result.is_accepted else None


def _paper(pair: MapPair, features: str) -> SE2 | None:
    config = GridRegistrationConfig(
        method="paper",
        features=features,
        max_points=_NUM_PAPER_POINTS,
        max_boxes=_NUM_PAPER_BOXES,
    )
    return _accepted(pair, config)


def _ndt_cell_m(pair: MapPair) -> float:
    """NDT's cells hold some wall points each, whatever the maps' resolution."""
    return 10.0 * pair.target.spec.resolution_m


def _ndt(pair: MapPair) -> SE2 | None:
    found = ndt(*_points(pair), T_initial=_centred(pair), cell_m=_ndt_cell_m(pair))
    return found.T_target_source


def _many_start_ndt(pair: MapPair) -> SE2 | None:
    source, target = _points(pair, _NUM_MANY_START_POINTS)
    best, best_score = None, -math.inf
    middle, aim = source.mean(axis=0), target.mean(axis=0)
    for k in range(36):
        turned = SE2(yaw=2.0 * math.pi * k / 36)
        moved = turned.apply(middle)
        start = SE2(float(aim[0] - moved[0]), float(aim[1] - moved[1]), turned.yaw)
        result = ndt(source, target, T_initial=start, cell_m=_ndt_cell_m(pair))
        if result.T_target_source is not None and result.score > best_score:
            best, best_score = result.T_target_source, result.score
    return best


def _methods() -> dict[str, Method]:
    return {
        "ours": lambda pair: _accepted(pair, GridRegistrationConfig()),
        "paper (ORB, GMRBnB, NNDE)": lambda pair: _paper(pair, "orb"),
        "paper, on wall points": lambda pair: _paper(pair, "walls"),
        "paper, on both": lambda pair: _paper(pair, "both"),
        "ICP": lambda pair: icp(*_points(pair), T_initial=_centred(pair)).T_target_source,
        "ICP, 36 starts": lambda pair: many_start_icp(*_points(pair)).T_target_source,
        "NDT": _ndt,
        "NDT, 36 starts": _many_start_ndt,
        "ORB + RANSAC": lambda pair: orb_ransac(pair.source, pair.target).T_target_source,
    }


def _lattice(pair: MapPair) -> GridSpec:
    """A lattice around the target that holds the source wherever it touches the target."""
    spec = pair.target.spec
    margin = max(pair.source.spec.shape)
    return spec.part(-margin, -margin, *(side + 2 * margin for side in spec.shape))


def _merged(pair: MapPair, T_target_source: SE2 | None) -> OccupancyMap:
    """Walls of either map win over free space, free space over unknown."""
    spec = _lattice(pair)
    values = resample(pair.target, spec)
    if T_target_source is not None:
        values = np.maximum(values, resample(pair.source, spec, T_target_source))
    return OccupancyMap(spec, values)


def _scored(spec: PairSpec, pair: MapPair, name: str, motion: SE2 | None) -> Row:
    error = compare_maps(_merged(pair, motion), _merged(pair, pair.T_target_source))
    error_m, error_rad = pair_errors(pair, motion) if motion is not None else (math.nan, math.nan)
    return {
        "kind": spec.kind,
        "overlap": spec.overlap,
        "noise": spec.noise,
        "seed": spec.seed,
        "method": name,
        "answered": motion is not None,
        "right": motion is not None and is_right(pair, motion),
        "mse": error.mse,
        "ssim": error.ssim,
        "error_m": error_m,
        "error_deg": math.degrees(error_rad),
    }


def _draw(path: Path, pair: MapPair, motions: dict[str, SE2 | None]) -> None:
    """Each method's merged map, as the paper's Figure 8."""
    shown = {"truth": pair.T_target_source, **motions}
    picture, grid = figure(2, 5, width=13.0, height=6.0)
    lattice = _lattice(pair)
    corners = []  # of all outlines, so that all pictures show the same part of the lattice
    for axes, (name, motion) in zip(grid.ravel(), shown.items(), strict=False):
        values = _merged(pair, motion).values
        grey = np.where(values < 0, 0.7, np.where(values > 50, 0.0, 1.0))
        axes.imshow(grey, cmap="gray", vmin=0.0, vmax=1.0, origin="lower")
        outlines = [(pair.target, SE2())] + ([(pair.source, motion)] if motion else [])
        for occupancy, T_target_map in outlines:
            metres = T_target_map.apply(occupancy.spec.corners())
            corners.append(lattice.T_frame_grid.inverse().apply(metres) / lattice.resolution_m)
            closed = np.vstack([corners[-1], corners[-1][:1]])
            axes.plot(closed[:, 0], closed[:, 1], "r:", linewidth=1.0)
        axes.set_title(name if motion is not None else f"{name}: refused", fontsize=8)
        axes.set_axis_off()
    low, high = np.concatenate(corners).min(axis=0), np.concatenate(corners).max(axis=0)
    low, high = np.maximum(low - 5.0, 0.0), np.minimum(high + 5.0, lattice.shape[::-1])
    for axes in grid.ravel():
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
    save_figure(picture, path)
