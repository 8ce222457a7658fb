"""Evidence of pairs of maps, with the answers: what the verdict's models are fitted on."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from uw_dslam_ros2.cli.studies._apart_maps import different_pairs, matching_pairs, twin_pairs
from uw_dslam_ros2.cli.studies._common import progress
from uw_dslam_ros2.cli.studies._map_pairs import PairSpec, random_prior
from uw_dslam_ros2.cli.studies._pair_list import read_pairs
from uw_dslam_ros2.core.registration.grids.judging.probability import (
    POSE_FEATURES,
    MatchEvidence,
    PoseEvidence,
    pose_features,
)
from uw_dslam_ros2.core.registration.grids.register import match_evidence
from uw_dslam_ros2.sim.maps.apart import ApartMap
from uw_dslam_ros2.sim.maps.pairs import MapPair, is_right
from uw_dslam_ros2.sim.maps.variants import mirrored

__all__ = [
    "Task",
    "Trial",
    "apart_tasks",
    "gathered",
    "listed_tasks",
    "weights_of",
    "window_tasks",
]

_WATERS = ("harbour", "lake", "cave")
_NOISES = ("clean", "noisy", "hard")
SIZES = (260, 260, 260, 160, 400)
_LIKE_PLACES = ("basin", "twin")
_LIKE_THEIR_MIRRORS = ("symmetric", "basin", "canal")
_LEAST_APART = 0.05  # share in common of two maps that there is an answer for
# How rare a basin is whose other end looks the same, against the other places: nothing in the maps
# of its ends can tell them apart where piers and corners are the same. So it is with twins.
_LIKE_WEIGHT = 0.3
_OTHER_PLACES_WEIGHT = 0.6  # there are many more pairs of different places than of one
_MANY_PAIRS = 6.0  # of one kind and place: more of them count less and less


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """A pair to gather evidence of; it is made by its description where it is None."""

    spec: PairSpec
    place: str
    pair: MapPair | None = None
    is_apart: bool = False
    has_mirror: bool = True  # seen in a mirror, it is a pair of different places


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """A pair of maps, and what is known of it without the proof.

    ``poses`` are the best one first, each with whether it is right. ``is_mirrored``: the source is
    seen in a mirror, so that no pose is right.
    """

    spec: PairSpec
    place: str
    is_apart: bool
    is_mirrored: bool
    has_prior: bool
    evidence: MatchEvidence
    poses: tuple[tuple[PoseEvidence, bool], ...]

    @property
    def is_right(self) -> bool:
        """Whether the best pose is."""
        return self.poses[0][1]


def weights_of(trials: Sequence[Trial]) -> list[float]:
    """How much each counts in a fit: a place with a hundred pairs is not a hundred places."""
    keys = [(t.is_apart, t.is_mirrored, t.spec.is_matching, t.place) for t in trials]
    counts = Counter(keys)
    weights = []
    for trial, key in zip(trials, keys, strict=True):
        weight = 1.0 / (1.0 + counts[key] / _MANY_PAIRS) ** 0.5
        if trial.spec.kind in _LIKE_PLACES:
            weight *= _LIKE_WEIGHT
        elif not (trial.spec.is_matching or trial.is_mirrored):
            weight *= _OTHER_PLACES_WEIGHT
        weights.append(weight)
    return weights


def window_tasks(kinds: Iterable[str], overlaps: Iterable[float], seeds: range) -> Iterator[Task]:
    """Windows of all kinds, overlaps and noises; some again of two places, or of aliases."""
    for seed in seeds:
        for kind in kinds:
            rng = np.random.default_rng((seed, sum(kind.encode())))
            has_mirror = kind not in _LIKE_THEIR_MIRRORS
            for overlap in overlaps:
                for noise in _NOISES:
                    is_sonar = kind in _WATERS and rng.random() < 0.35
                    size = int(rng.choice(SIZES))
                    other = rng.random() < 0.6
                    spec = PairSpec(kind, overlap, noise, seed, True, is_sonar, False, size)
                    yield Task(spec, kind, has_mirror=has_mirror)
                    if other:
                        is_alias = kind == "basin"
                        spec = replace(spec, is_matching=False, is_alias=is_alias)
                        yield Task(spec, kind)


def apart_tasks(maps: Sequence[ApartMap], num_different: int, seed: int) -> Iterator[Task]:
    """All pairs of maps of one place and of twins, and so many of different places."""
    own = [pair for pair in matching_pairs(maps) if pair.overlap >= _LEAST_APART]
    for pair in (*own, *twin_pairs(maps), *different_pairs(maps, num_different, seed)):
        is_matching = pair.T_target_source is not None
        overlap = round(pair.overlap, 4)
        spec = PairSpec(pair.kind, overlap, pair.noise, seed, is_matching, is_sonar=True)
        yield Task(spec, pair.kind, pair, True, pair.kind not in _LIKE_THEIR_MIRRORS)


def listed_tasks(path: Path) -> Iterator[Task]:
    """Pairs of real maps that were built apart, of a list as `_pair_list.read_pairs` reads it."""
    for listed in read_pairs(path):
        is_matching = listed.pair.T_target_source is not None
        spec = PairSpec("real", 0.0, "real", 0, is_matching)
        yield Task(spec, listed.place, listed.pair, True, not listed.is_like_its_mirror)


def gathered(path: Path, tasks: Iterable[Task]) -> list[Trial]:
    """Evidence of all pairs, and of their mirror images; the features are kept in a CSV file."""
    trials: list[Trial] = []
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(
            (*PairSpec.__annotations__, "place", "is_mirrored", "has_prior", "is_right",
             *POSE_FEATURES, "rival_share")
        )  # fmt: skip
        for number, task in enumerate(progress(list(tasks), text=path.stem)):
            for trial in _trials(task, np.random.default_rng((number, task.spec.seed))):
                trials.append(trial)
                features = pose_features(trial.evidence.best, trial.evidence.log_volume)
                writer.writerow(
                    (*asdict(trial.spec).values(), trial.place, trial.is_mirrored,
                     trial.has_prior, trial.is_right, *features, trial.evidence.rival_share)
                )  # fmt: skip
    return trials


def _trials(task: Task, rng: np.random.Generator) -> Iterator[Trial]:
    """A pair, half of them once more with a prior, and what it is in a mirror."""
    pair = task.pair or task.spec.make()
    tried = [(task.spec, pair, False)]
    if task.spec.is_matching and task.has_mirror:
        image = replace(pair, source=mirrored(pair.source), T_target_source=None)
        tried.append((replace(task.spec, is_matching=False), image, True))
    for spec, one, is_mirrored in tried:
        for has_prior in (False, True)[: 1 + int(not is_mirrored and rng.random() < 0.5)]:
            prior = random_prior(one, rng) if has_prior else None
            found = match_evidence(one.source, one.target, prior=prior)
            if found is None:
                continue
            evidence, weighed = found
            poses = tuple((pose, is_right(one, motion)) for pose, motion in weighed)
            yield Trial(spec, task.place, task.is_apart, is_mirrored, has_prior, evidence, poses)
