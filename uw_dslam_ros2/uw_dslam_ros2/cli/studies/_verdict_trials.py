"""Evidence of pairs of maps, with the answers: what the verdict's models are fitted on."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from uw_dslam_ros2.cli.studies._apart_maps import different_pairs, matching_pairs, twin_pairs
from uw_dslam_ros2.cli.studies._common import progress
from uw_dslam_ros2.cli.studies._map_pairs import PairSpec, random_prior
from uw_dslam_ros2.core.registration.grids.judging.probability import (
    POSE_FEATURES,
    MatchEvidence,
    PoseEvidence,
    pose_features,
)
from uw_dslam_ros2.core.registration.grids.register import match_evidence
from uw_dslam_ros2.sim.apart import ApartMap
from uw_dslam_ros2.sim.map_pairs import MapPair, is_right

__all__ = ["Trial", "apart_tasks", "gathered", "window_tasks"]

Task = tuple[PairSpec, MapPair | None]  # made by its description where it is None

_WATERS = ("harbour", "lake", "cave")
_NOISES = ("clean", "noisy", "hard")
SIZES = (260, 260, 260, 160, 400)
# How rare a basin is whose other end looks the same, against the other places: nothing in the maps
# of its ends can tell them apart where piers and corners are the same. So it is with twins.
_BASIN_WEIGHT = 0.3
_LIKE_PLACES = ("basin", "twin")
_LEAST_APART = 0.05  # share in common of two maps that there is an answer for


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """A pair of maps, and what is known of it without the proof.

    ``poses`` are the best one first, each with whether it is right.
    """

    spec: PairSpec
    is_apart: bool
    has_prior: bool
    evidence: MatchEvidence
    poses: tuple[tuple[PoseEvidence, bool], ...]

    @property
    def is_right(self) -> bool:
        """Whether the best pose is."""
        return self.poses[0][1]

    @property
    def weight(self) -> float:
        """In a fit."""
        return _BASIN_WEIGHT if self.spec.kind in _LIKE_PLACES else 1.0


def window_tasks(kinds: Iterable[str], overlaps: Iterable[float], seeds: range) -> Iterator[Task]:
    """Windows of all kinds, overlaps and noises; some again of two places, or of aliases."""
    for seed in seeds:
        for kind in kinds:
            rng = np.random.default_rng((seed, sum(kind.encode())))
            for overlap in overlaps:
                for noise in _NOISES:
                    is_sonar = kind in _WATERS and rng.random() < 0.35
                    size = int(rng.choice(SIZES))
                    other = rng.random() < 0.6
                    spec = PairSpec(kind, overlap, noise, seed, True, is_sonar, False, size)
                    yield spec, None
                    if other:
                        is_alias = kind == "basin"
                        spec = PairSpec(
                            kind, overlap, noise, seed, False, is_sonar, is_alias, size
                        )
                        yield spec, None


def apart_tasks(maps: Sequence[ApartMap], num_different: int, seed: int) -> Iterator[Task]:
    """All pairs of maps of one place and of twins, and so many of different places."""
    own = [pair for pair in matching_pairs(maps) if pair.overlap >= _LEAST_APART]
    for pair in (*own, *twin_pairs(maps), *different_pairs(maps, num_different, seed)):
        is_matching = pair.T_target_source is not None
        overlap = round(pair.overlap, 4)
        spec = PairSpec(pair.kind, overlap, pair.noise, seed, is_matching, is_sonar=True)
        yield spec, pair


def gathered(path: Path, tasks: Iterable[Task], is_apart: bool = False) -> list[Trial]:
    """Evidence of all pairs; what the models see of it is kept in a CSV file."""
    trials: list[Trial] = []
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        names = (*PairSpec.__annotations__, "has_prior", "is_right", *POSE_FEATURES, "rival_share")
        writer.writerow(names)
        for number, (spec, given) in enumerate(progress(list(tasks), text=path.stem)):
            pair = given or spec.make()
            rng = np.random.default_rng((number, spec.seed))
            for has_prior in (False, True)[: 1 + int(rng.random() < 0.5)]:
                prior = random_prior(pair, rng) if has_prior else None
                found = match_evidence(pair.source, pair.target, prior=prior)
                if found is None:
                    continue
                evidence, weighed = found
                poses = tuple((pose, is_right(pair, motion)) for pose, motion in weighed)
                trials.append(Trial(spec, is_apart, has_prior, evidence, poses))
                features = pose_features(evidence.best, evidence.log_volume)
                writer.writerow(
                    (*asdict(spec).values(), has_prior, trials[-1].is_right, *features,
                     evidence.rival_share)
                )  # fmt: skip
    return trials
