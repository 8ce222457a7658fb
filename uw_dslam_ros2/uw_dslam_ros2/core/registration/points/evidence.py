"""Evidence for a pose: the logarithm of its posterior odds against chance."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from uw_dslam_ros2.core.registration.points.refinement import Refinement
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["EvidenceModel", "Outline"]

FloatArray = NDArray[np.float64]

_RESOLVED = 0.2  # spacings of posterior width, along each axis, that count as one pose


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """Convex region that points spread over, for points that are a sample of it."""

    corners: FloatArray  # (k, 2), counter-clockwise
    area_m2: float
    normals: FloatArray  # (k, 2), inward, of the side that begins at each corner
    offsets: FloatArray  # (k,): a point is inside where it lies as far along all normals

    @classmethod
    def of(cls, points: FloatArray) -> Outline:
        """Hull, enlarged about its middle by what a hull of a sample is too small (Efron 1965).

        Points on a line get a box around it, as wide as their distance.
        """
        try:
            hull = scipy.spatial.ConvexHull(points)
        except (scipy.spatial.QhullError, ValueError):  # fewer than three points, or all on a line
            return cls._box(points)
        count, corners = len(points), points[hull.vertices]
        middle = corners.mean(axis=0)
        # The share of the region that the hull leaves out is, on average, that of the corners.
        growth = math.sqrt(1.0 / (1.0 - min(len(corners) / (count + 1.0), 0.75)))
        outline = cls._around(middle + growth * (corners - middle), hull.volume * growth**2)
        low, high = cls._extent(points)[1:]
        return outline if outline.area_m2 > (high - low).prod() / count else cls._box(points)

    @classmethod
    def _box(cls, points: FloatArray) -> Outline:
        axes, low, high = cls._extent(points)
        corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]]]) @ axes.T
        if np.linalg.det(axes) < 0.0:
            corners = corners[::-1]
        return cls._around(points.mean(axis=0) + corners, float((high - low).prod()))

    @staticmethod
    def _extent(points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Main axes (2, 2), and ends (2,) along them from the mean, never without width."""
        middle = points.mean(axis=0)
        spread = points - middle
        axes = np.linalg.eigh(spread.T @ spread)[1]
        along = spread @ axes
        low, high = along.min(axis=0), along.max(axis=0)
        sides = np.maximum(high - low, 1e-9)
        width = np.maximum(sides, sides.max() / max(len(points), 4))
        return axes, 0.5 * (low + high - width), 0.5 * (low + high + width)

    @classmethod
    def _around(cls, corners: FloatArray, area_m2: float) -> Outline:
        along = np.roll(corners, -1, axis=0) - corners
        normals = np.column_stack([-along[:, 1], along[:, 0]])
        offsets = (normals * corners).sum(axis=1)
        # What lies on a side is inside, rounding or not.
        slack = 1e-9 * np.abs(normals).sum(axis=1) * np.ptp(corners, axis=0).max()
        return cls(corners, area_m2, normals, offsets - slack)

    def holds(self, points: FloatArray) -> NDArray[np.bool_]:
        """Mask (N,) of the points (N, 2) inside."""
        return np.asarray((self.normals @ points.T >= self.offsets[:, None]).all(axis=0))


@dataclass(frozen=True, slots=True, eq=False)
class EvidenceModel:
    """What is believed of poses, noise and number of pairs before anything is seen.

    The number of pairs is uniform up to that of the smaller set; the noise's variance is uniform
    up to the square of ``max_sigma_m``; the share of overlap of the two regions is uniform, which
    makes poses of much overlap likelier than of little, for there are fewer of them.
    """

    source: FloatArray  # (m, 2) [m], centred
    target: FloatArray  # (n, 2)
    source_outline: Outline
    target_outline: Outline
    volume: float  # [rad m^2] of the poses that are searched
    arm_m: float  # root mean square distance of the source from its centre
    spacing_m: float
    max_sigma_m: float
    has_prior: bool  # a window was given: where in it says nothing about overlap
    repetition: float = 1.0  # points that say the same thing together: 1 where all are independent

    def of(self, refinement: Refinement, repetition: float | None = None) -> float:
        """Log of the Bayes factor of "the sets have this pose" against chance [nats].

        Likelihood ratio, times the prior's share of the peak in pose (Laplace's method), noise and
        number of pairs. A peak wider than a fifth of the spacing is counted as that wide: it is
        not one pose. `repetition` other than the model's own is for comparing poses only.
        """
        scale = np.array([self.arm_m, 1.0, 1.0])
        curvature = np.linalg.eigvalsh(refinement.information / np.outer(scale, scale))
        repetition = self.repetition if repetition is None else repetition
        curvature = curvature / repetition
        if curvature[0] <= 1e-12 * curvature[-1]:
            return -math.inf
        widths = np.minimum(1.0 / np.sqrt(curvature), _RESOLVED * self.spacing_m)
        log_peak = float(np.log(widths).sum()) + 1.5 * math.log(2.0 * math.pi)
        log_pose = min(log_peak - math.log(self.volume * self.arm_m), 0.0)
        value = refinement.log_likelihood / repetition + log_pose + self._log_fit(refinement)
        return value if self.has_prior else value + self.log_overlap(refinement.pose())

    def _log_fit(self, refinement: Refinement) -> float:
        """Prior share of the peak in noise and number of pairs."""
        most, pairs = min(len(self.source), len(self.target)), refinement.num_pairs
        width = math.sqrt(2.0 * math.pi * max(pairs * (1.0 - pairs / most), 0.2))
        log_pairs = math.log(min(width / (most + 1.0), 1.0))
        width = math.sqrt(0.5 * math.pi / max(pairs, 1.0))  # of the noise's logarithm
        share = width * refinement.sigma_m / self.max_sigma_m
        return log_pairs + math.log(min(share, 1.0))

    def log_overlap(self, pose: SE2) -> float:
        """Log of the prior density at a pose over that of uniform translations.

        Two squares whose offset is uniform overlap by v with density -log v; to make v uniform,
        the density is divided by that.
        """
        there = self.target_outline.holds(pose.apply(self.source)).mean()
        back = self.source_outline.holds(pose.inverse().apply(self.target)).mean()
        overlap = float(0.5 * (there + back))
        edge = 0.5 / math.sqrt(min(len(self.source), len(self.target)))
        overlap = min(max(overlap, edge), 1.0 - edge)
        return -math.log(-math.log(overlap))
