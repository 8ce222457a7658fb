"""Pairs of maps for the studies of map registration, and what counts as right."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from uw_dslam_ros2.cli.studies._common import share_interval
from uw_dslam_ros2.core.registration.grids.register import register_grids
from uw_dslam_ros2.core.registration.result import PriorWindow, RegistrationResult
from uw_dslam_ros2.core.se2 import SE2, wrap_angle
from uw_dslam_ros2.sim.maps.pairs import MapPair, is_right, make_pair, pair_errors

__all__ = [
    "SHARES",
    "PairSpec",
    "accepted_of_different",
    "pair_specs",
    "random_prior",
    "registered",
    "shares",
]


@dataclass(frozen=True, slots=True)
class PairSpec:
    """How one pair of maps is made."""

    kind: str
    overlap: float
    noise: str
    seed: int
    is_matching: bool = True
    is_sonar: bool = False
    is_alias: bool = False
    size_cells: int = 260

    def make(self) -> MapPair:
        """The pair."""
        return make_pair(
            self.kind,
            self.overlap,
            self.noise,
            self.seed,
            is_matching=self.is_matching,
            is_sonar=self.is_sonar,
            is_alias=self.is_alias,
            size_cells=self.size_cells,
        )


def pair_specs(
    kinds: tuple[str, ...],
    overlaps: tuple[float, ...],
    noises: tuple[str, ...],
    seeds: range,
    share_of_different: float = 0.5,
) -> Iterator[PairSpec]:
    """All combinations, every third as sonar would see it; some again with maps of two places."""
    for seed in seeds:
        for kind in kinds:
            for number, overlap in enumerate(overlaps):
                for noise in noises:
                    is_sonar = kind != "office" and (seed + number) % 3 == 0
                    yield PairSpec(kind, overlap, noise, seed, True, is_sonar)
                    choice = np.random.default_rng((seed, number, len(kind), len(noise)))
                    if choice.random() < share_of_different:
                        yield PairSpec(kind, overlap, noise, seed, False, is_sonar)


def random_prior(pair: MapPair, rng: np.random.Generator) -> PriorWindow:
    """A window of random size that holds the truth, or any place where there is none."""
    size_m = max(pair.source.spec.shape) * pair.source.spec.resolution_m
    half_m = size_m * float(rng.choice([0.1, 0.2, 0.4]))
    half_rad = float(rng.choice([0.1, 0.3, math.pi]))
    middle = pair.source.spec.corners().mean(axis=0)
    if pair.T_target_source is not None:
        T_true = pair.T_target_source
    else:
        aim = pair.target.spec.corners().mean(axis=0)
        turned = SE2(yaw=float(rng.uniform(-math.pi, math.pi)))
        moved = turned.apply(middle)
        T_true = SE2(float(aim[0] - moved[0]), float(aim[1] - moved[1]), turned.yaw)
    x, y = T_true.apply(middle)
    about = SE2(float(x), float(y), 0.0)
    shift = rng.uniform(-half_m, half_m, 2)
    error = SE2(float(shift[0]), float(shift[1]), float(rng.uniform(-half_rad, half_rad)))
    # Half as much again, for the prior speaks of the source's origin and not of its middle.
    return PriorWindow(about @ error @ about.inverse() @ T_true, 1.5 * half_m, half_rad)


def registered(pair: MapPair) -> dict[str, Any]:
    """What `register_grids` says of a pair, and how right that is; for a CSV file."""
    result = register_grids(pair.source, pair.target, clock=time.monotonic)
    error_m, error_rad = pair_errors(pair, result.T_target_source)
    return {
        "matching": pair.T_target_source is not None,
        "right": is_right(pair, result.T_target_source),
        "accepted": result.is_accepted,
        "verdict": result.verdict.name,
        "certified": result.is_certified,
        "probability": result.probability,
        "error_cells": error_m / pair.source.spec.resolution_m,
        "error_deg": math.degrees(error_rad),
        "nees": _nees(pair, result),
        "gap": result.gap,
        "boxes": result.num_boxes,
        "seconds": result.seconds,
    }


def _nees(pair: MapPair, result: RegistrationResult) -> float:
    """Squared error over the stated covariance; 3 on average where that is true."""
    if pair.T_target_source is None or result.T_target_source is None:
        return math.nan
    error = result.T_target_source.as_array() - pair.T_target_source.as_array()
    error[2] = wrap_angle(error[2])
    return float(error @ np.linalg.solve(result.covariance, error))


SHARES = (
    "right", "accepted, right", "accepted, wrong", "certified", "median cells", "median deg",
    "NEES",
)  # fmt: skip
"""Titles of the columns that `shares` gives."""


def shares(rows: list[dict[str, Any]]) -> tuple[str, ...]:
    """What became of rows of `registered` of matching pairs, as text for a table."""
    right = np.mean([r["right"] for r in rows])
    kept = [r for r in rows if r["right"] and r["accepted"]]
    wrong = np.mean([r["accepted"] and not r["right"] for r in rows])
    answer = [f"{right:.2f}", f"{len(kept) / len(rows):.2f}", f"{wrong:.3f}"]
    answer.append(f"{np.mean([r['certified'] for r in rows if r['accepted']] or [0]):.2f}")
    for name in ("error_cells", "error_deg"):
        answer.append(f"{np.median([r[name] for r in kept]):.2f}" if kept else "-")
    answer.append(f"{np.mean([r['nees'] for r in kept]):.1f}" if kept else "-")
    return tuple(answer)


def accepted_of_different(rows: list[dict[str, Any]]) -> str:
    """How many pairs of different places were accepted, with the interval of the share."""
    different = [r for r in rows if not r["matching"]]
    if not different:
        return "no maps of different places"
    wrong = sum(r["accepted"] for r in different)
    low, high = share_interval(wrong, len(different))
    return (
        f"maps of different places: {wrong} of {len(different)} accepted "
        f"(95 %: {low:.1%} to {high:.1%})"
    )
