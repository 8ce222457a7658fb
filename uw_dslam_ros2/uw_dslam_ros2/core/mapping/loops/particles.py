"""Rao-Blackwellised particle filter over one vehicle's submaps."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.mapping.config import VehicleMapperConfig
from uw_dslam_ros2.core.mapping.drawing.log_odds_grid import LogOddsGrid
from uw_dslam_ros2.core.mapping.loops.closures import MIN_POINTS, nearby
from uw_dslam_ros2.core.mapping.loops.rivals import conflict
from uw_dslam_ros2.core.mapping.loops.verdict import (
    MAX_WINDOW_M,
    MAX_WINDOW_RAD,
    MIN_OVERLAP,
    SEARCH_SIGMA,
    with_bend,
)
from uw_dslam_ros2.core.mapping.scans.matcher import LikelihoodField, Prior, match_points, thin
from uw_dslam_ros2.core.mapping.section import ClosedSection
from uw_dslam_ros2.core.pose_graph import compose_covariance
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["ParticleFilter"]

FloatArray = NDArray[np.float64]
_MIN_EFFECTIVE_SHARE = 0.5
"""Resampling where the effective number of particles falls below this share of all."""
_MAX_POINTS = 250
"""Points of a submap that are matched, for each particle."""
_MAX_CONFLICT = 0.2
"""Share of the points on free water above which a particle's place is not matched."""
_FLOOR = np.diag([1e-6, 1e-6, 1e-8])


class ParticleFilter:
    """Every particle is a history of submap poses, and by it a map of its own.

    After Grisetti, Stachniss and Burgard 2007 (improved proposal, resampling by the effective
    number of particles) on sections of way instead of single scans, as Haehnel et al. 2003; the
    paper's reference (Cheng et al. 2022) maps with such a filter. What is in a submap is common
    to all particles and kept once; a particle owns 24 bytes for each submap, however large the
    map grows, and copies nothing else when it is resampled.
    """

    def __init__(self, config: VehicleMapperConfig) -> None:
        self._config = config
        self._rng = np.random.default_rng(config.particles.seed)
        count = config.particles.num_particles
        self._histories = np.empty((count, 0, 3))
        self._log_weight = np.zeros(count)
        self._step: tuple[SE2, FloatArray] | None = None
        self.num_loops = 0
        self.num_resampled = 0

    @property
    def num_loops_believed(self) -> int:
        """Submaps that were matched with earlier ones by at least half of the particles."""
        return self.num_loops

    @property
    def weights(self) -> FloatArray:
        """Weights (N,) of the particles; they add up to 1."""
        weights = np.exp(self._log_weight - self._log_weight.max())
        return np.asarray(weights / weights.sum())

    @property
    def poses(self) -> list[SE2]:
        """``T_odom_submap`` of every submap: the mean of the particles."""
        weights = self.weights
        x, y = np.einsum("n,nkc->ck", weights, self._histories[:, :, :2])
        sin = weights @ np.sin(self._histories[:, :, 2])
        cos = weights @ np.cos(self._histories[:, :, 2])
        yaw = np.arctan2(sin, cos)
        return [SE2(float(a), float(b), float(c)) for a, b, c in zip(x, y, yaw, strict=True)]

    def covariance(self) -> FloatArray:
        """Covariance (3, 3) of the newest submap's pose in odom, order x, y, yaw."""
        newest = self.poses[-1].as_array()
        delta = self._histories[:, -1] - newest
        delta[:, 2] = np.mod(delta[:, 2] + math.pi, 2.0 * math.pi) - math.pi
        spread = np.einsum("n,ni,nj->ij", self.weights, delta, delta)
        if self._step is None:
            return np.asarray(spread)
        # The step to the newest submap has not been drawn yet.
        return spread + compose_covariance(self._step[1], self.poses[-2], self._step[0], SE2())

    def add_first(self, T_odom_submap: SE2, covariance: FloatArray) -> None:  # noqa: ARG002
        """Begin with the first submap, where the odom frame begins."""
        start = T_odom_submap.as_array()
        self._histories = np.broadcast_to(start, (len(self._histories), 1, 3)).copy()

    def add_next(self, T_previous_new: SE2, covariance: FloatArray) -> None:
        """Append a submap by odometry; covariance (3, 3) in the previous submap's frame.

        Until it closes it is where odometry says, in every particle.
        """
        moved = _composed(self._histories[:, -1], T_previous_new.as_array())
        self._histories = np.concatenate([self._histories, moved[:, None]], axis=1)
        self._step = T_previous_new, covariance + _FLOOR

    def close_loops(self, sections: list[ClosedSection]) -> None:
        """Draw the newest submap's pose: by odometry, and by its echoes where others saw them."""
        if self._step is None:
            return
        step, covariance = self._step
        self._step = None
        count = len(self._histories)
        means = np.broadcast_to(step.as_array(), (count, 3)).copy()
        covariances = np.broadcast_to(covariance, (count, 3, 3)).copy()
        targets = self._candidates(sections)
        num_matched = 0
        if targets:
            grids = {i: sections[i].grid.decompressed() for i in [*targets, len(sections) - 1]}
            known: dict[bytes, tuple[FloatArray, FloatArray, float] | None] = {}
            for i in range(count):
                seen = self._relative(i, targets)
                # Particles of one ancestor have the same map here.
                key = seen.tobytes()
                if key not in known:
                    known[key] = self._improved(sections, grids, targets, seen, step, covariance)
                found = known[key]
                if found is not None:
                    means[i], covariances[i] = found[0], found[1]
                    self._log_weight[i] += found[2]
                    num_matched += 1
        draws = self._rng.standard_normal((count, 3))
        # The sample has the proposal's mean and not one of its own: less noise for few particles.
        draws -= draws.mean(axis=0)
        roots = np.linalg.cholesky(covariances)
        steps = means + np.einsum("nij,nj->ni", roots, draws)
        self._histories[:, -1] = _composed(self._histories[:, -2], steps)
        if 2 * num_matched >= count:
            self.num_loops += 1
        self._resample()

    def _candidates(self, sections: list[ClosedSection]) -> list[int]:
        """Earlier submaps, not the neighbour, that the newest may overlap; the nearest first."""
        config, newest = self._config.loop, len(sections) - 1
        if not config.is_enabled or len(sections[newest].points) < MIN_POINTS:
            return []
        slack_m = 2.0 * math.sqrt(float(np.linalg.eigvalsh(self.covariance()[:2, :2])[-1]))
        return nearby(sections, self.poses, newest, config, slack_m)

    def _relative(self, particle: int, targets: list[int]) -> FloatArray:
        """Poses (T, 3) of the targets in the frame of the submap before the newest."""
        history = self._histories[particle]
        inverse = SE2.from_array(history[-2]).inverse().as_array()
        return _composed(np.broadcast_to(inverse, (len(targets), 3)), history[targets])

    def _improved(
        self,
        sections: list[ClosedSection],
        grids: dict[int, LogOddsGrid],
        targets: list[int],
        seen: FloatArray,
        step: SE2,
        covariance: FloatArray,
    ) -> tuple[FloatArray, FloatArray, float] | None:
        """Mean and covariance of the proposal, and the log weight that comes with it.

        None where the newest submap fits nothing in this particle's map.
        """
        config, newest = self._config, sections[-1]
        poses = [SE2.from_array(row) for row in seen]
        pairs = list(zip(poses, targets, strict=True))
        points = np.vstack([pose.apply(sections[t].points) for pose, t in pairs])
        weight = np.concatenate([sections[t].weight for t in targets])
        fine = config.match.sigma_m
        sigma = np.sqrt(np.diag(covariance)) * SEARCH_SIGMA
        half_width = (
            float(np.clip(sigma[0], 2.0 * fine, MAX_WINDOW_M)),
            float(np.clip(sigma[1], 2.0 * fine, MAX_WINDOW_M)),
            float(np.clip(sigma[2], 0.02, MAX_WINDOW_RAD)),
        )
        fields = [LikelihoodField(points, weight, s) for s in (2.0 * fine, fine)]
        source, support = thin(newest.points, 1.0 - np.exp(-newest.weight), fine)
        stride = max(1, -(-len(source) // _MAX_POINTS))
        match = match_points(
            fields, source[::stride], support[::stride], Prior(step, covariance), half_width,
            config.match.information_share,
        )  # fmt: skip
        if match.overlap < MIN_OVERLAP:
            return None
        against = 0.0
        for pose, index in pairs:
            T_target_source = pose.inverse() @ match.T_target_source
            there = conflict(grids[index], newest.points, T_target_source)
            mine, theirs = grids[len(sections) - 1], sections[index].points
            back = conflict(mine, theirs, T_target_source.inverse())
            against = max(against, there, back)
        if against > _MAX_CONFLICT:
            return None
        information = with_bend(
            match.information, compose_covariance(newest.drift, step, SE2(), SE2())
        )
        fit = match.score - against
        num_independent = config.match.information_share * len(source[::stride])
        return _proposal(
            step, covariance, match.T_target_source, information, num_independent * fit
        )

    def _resample(self) -> None:
        """Low-variance resampling where the effective number of particles has fallen too far."""
        weights = self.weights
        count = len(weights)
        if 1.0 / float((weights**2).sum()) >= _MIN_EFFECTIVE_SHARE * count:
            return
        places = (np.arange(count) + self._rng.random()) / count
        chosen = np.minimum(np.searchsorted(np.cumsum(weights), places), count - 1)
        self._histories = self._histories[chosen]
        self._log_weight = np.zeros(count)
        self.num_resampled += 1


def _proposal(
    step: SE2, covariance: FloatArray, found: SE2, information: FloatArray, log_fit: float
) -> tuple[FloatArray, FloatArray, float]:
    """Product of the odometry's and the match's Gaussian: mean, covariance, log of its integral.

    The information may be singular.
    """
    delta = found.as_array() - step.as_array()
    delta[2] = math.remainder(delta[2], 2.0 * math.pi)
    shrink = np.linalg.inv(np.eye(3) + covariance @ information)
    posterior = shrink @ covariance
    posterior = 0.5 * (posterior + posterior.T)
    mean = step.as_array() + posterior @ information @ delta
    misfit = float(delta @ information @ shrink @ delta)
    log_width = -0.5 * float(np.linalg.slogdet(np.eye(3) + covariance @ information)[1])
    return mean, posterior, log_fit - 0.5 * misfit + log_width


def _composed(left: FloatArray, right: FloatArray) -> FloatArray:
    """``left @ right`` of motions in rows (N, 3) [x, y, yaw]; one of them may be (3,)."""
    cos, sin = np.cos(left[..., 2]), np.sin(left[..., 2])
    x = left[..., 0] + cos * right[..., 0] - sin * right[..., 1]
    y = left[..., 1] + sin * right[..., 0] + cos * right[..., 1]
    yaw = np.mod(left[..., 2] + right[..., 2] + math.pi, 2.0 * math.pi) - math.pi
    return np.stack([x, y, yaw], axis=-1)
