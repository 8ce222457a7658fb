"""Poses worth a closer look: the best of the searched lattice, and how they stand out."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.registration.grids.finding.landscape import (
    Landscape,
    distinct,
    scan_landscape,
)
from uw_dslam_ros2.core.registration.grids.problem import GridProblem, PoseWindow
from uw_dslam_ros2.core.registration.grids.pyramid import Pyramid, carried
from uw_dslam_ros2.core.registration.search.outcome import SearchOutcome
from uw_dslam_ros2.core.se2 import wrap_angle

__all__ = ["Background", "Candidate", "climb", "log_volume", "merge_best", "scan_candidates"]

FloatArray = NDArray[np.float64]
_NUM_PEAKS = 300  # of the scan: at 65 cells that is most of them
_NUM_CANDIDATES = 40
_OWN_PEAK_CELLS = 6.0
_LEAST_OTHERS = 3


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A pose (3,) of a `GridProblem` and its objective."""

    pose: FloatArray
    score: float


@dataclass(frozen=True, slots=True)
class Background:
    """Mean and standard deviation of the best scores that other rotations reach by chance."""

    mean: float
    spread: float

    def surprise(self, score: float) -> float:
        """How far a score lies above chance, in standard deviations of chance."""
        return (score - self.mean) / self.spread


def scan_candidates(
    pyramid: Pyramid, window: PoseWindow, num_peaks: int = _NUM_PEAKS
) -> tuple[list[Candidate], Background]:
    """Local maxima of the searched problem, best first, and what chance reaches.

    ``window`` is in cells of the scanned problem. There, a thin wall is hardly more than the free
    space beside it, and the true pose may score below many others; so many of its peaks are
    carried to the searched problem, whose scores say which of them go on.
    """
    scanned, searched = pyramid.scanned, pyramid.searched
    landscape = scan_landscape(scanned, num_peaks, window)
    peaks = [c for c in climb(scanned, landscape.poses) if _is_inside(window, c.pose)]
    if not peaks:
        peaks = [Candidate(window.middle, scanned.value(window.middle))]
    background = _background(peaks[0], landscape, scanned.radius)
    poses = np.array([peak.pose for peak in peaks])
    if searched is scanned:
        return peaks[:_NUM_CANDIDATES], background
    climbed = climb(searched, carried(scanned, searched, poses))
    back = carried(searched, scanned, np.array([c.pose for c in climbed]))
    inside = [c for c, pose in zip(climbed, back, strict=True) if _is_inside(window, pose)]
    return (inside or climbed)[:_NUM_CANDIDATES], background


def climb(problem: GridProblem, poses: FloatArray) -> list[Candidate]:
    """Local maxima from poses (K, 3), best first, apart from each other."""
    if len(poses) == 0:
        return []
    found, values = problem.ascend_all(poses)
    order = np.argsort(-values, kind="stable")
    found, values = found[order], values[order]
    kept = distinct(found, problem.radius, 4.0, len(found))
    return [Candidate(found[k], float(values[k])) for k in kept]


def merge_best(
    problem: GridProblem, candidates: list[Candidate], outcome: SearchOutcome
) -> list[Candidate]:
    """Candidates with the best pose of a search, and what is in the boxes that it left open."""
    found = [Candidate(outcome.pose, outcome.lower_bound), *climb(problem, outcome.open_poses)]
    merged = sorted([*found, *candidates], key=lambda c: -c.score)
    stacked = np.array([c.pose for c in merged])
    return [merged[k] for k in distinct(stacked, problem.radius, 1.0, _NUM_CANDIDATES)]


def log_volume(pyramid: Pyramid, window: PoseWindow) -> float:
    """Logarithm of the number of poses in a window that differ by a unit, at the rim for turns."""
    sizes = 2.0 * window.half * (pyramid.scanned.radius, 1.0, 1.0) / pyramid.unit_cells
    return float(np.log(np.maximum(sizes, 1.0)).sum())


def _is_inside(window: PoseWindow, pose: FloatArray) -> bool:
    offset = pose - window.middle
    offset[0] = wrap_angle(float(offset[0]))
    return bool((np.abs(offset) <= window.half + 1e-9).all())


def _background(best: Candidate, landscape: Landscape, radius: float) -> Background:
    offset = landscape.background_poses - best.pose
    turn = np.abs((offset[:, 0] + math.pi) % (2.0 * math.pi) - math.pi)
    is_own = (turn * radius < _OWN_PEAK_CELLS) & (
        np.hypot(offset[:, 1], offset[:, 2]) < _OWN_PEAK_CELLS
    )
    others = landscape.background_scores[~is_own]
    if len(others) < _LEAST_OTHERS:  # nothing is known of chance, so nothing stands out
        return Background(best.score, 1.0)
    return Background(float(np.mean(others)), max(float(np.std(others)), 0.02 * best.score, 1e-9))
