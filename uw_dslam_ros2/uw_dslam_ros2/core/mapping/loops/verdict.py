"""Whether two submaps of one vehicle see the same place: two judges, and the table they serve.

The mapper's matcher looks at echoes, the registration engine at walls and free water, both within
the window that the graph allows. The engine accepts by itself; where it does not, but finds the
same pose as a matcher that is sure, the two together are enough. Where the same walls would fit a
period further, only what lies across the periods is believed.
"""

from __future__ import annotations

import logging
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.mapping.config import VehicleMapperConfig
from uw_dslam_ros2.core.mapping.loops.rivals import conflict, rivals, without_direction
from uw_dslam_ros2.core.mapping.scans.matcher import (
    LikelihoodField,
    Prior,
    ScanMatch,
    match_points,
    thin,
)
from uw_dslam_ros2.core.mapping.section import ClosedSection
from uw_dslam_ros2.core.registration.grids.register import register_grids
from uw_dslam_ros2.core.registration.result import PriorWindow, RegistrationResult, Verdict
from uw_dslam_ros2.core.registration.rules import Rule, at_least, at_most, first_that_applies
from uw_dslam_ros2.core.se2 import SE2

__all__ = [
    "MAX_WINDOW_M",
    "MAX_WINDOW_RAD",
    "MIN_OVERLAP",
    "SEARCH_SIGMA",
    "decide_loop",
    "with_bend",
]

FloatArray = NDArray[np.float64]
_LOGGER = logging.getLogger(__name__)

SEARCH_SIGMA = 3.0
"""Half width of the search window, in standard deviations of the graph ..."""
MAX_WINDOW_M, MAX_WINDOW_RAD = 15.0, 0.35
"""... but at most this: beyond it a wrong place is found more often than a lost one."""
MIN_OVERLAP = 0.3
"""Least share of the points that must meet the other map."""
_SURE_OVERLAP = 0.5
"""That share, where the engine finds the same pose but does not accept it."""
_MAX_POINTS = 600
# A match takes a submap as rigid; on average half of its own drift lies between its points.
_BEND_SHARE = 0.25
_DIGITS = 6
_HOPELESS = 0.15
_SURE_LEAD, _SURE_CONFLICT = 0.05, 0.1
_NEAR_RAD = 0.02
_COARSEST = 8.0
# Whether the walls would fit elsewhere too is asked later, where the prior has its say.
_OPEN = Verdict.NOT_ENOUGH_OVERLAP, Verdict.IMPROBABLE, Verdict.AMBIGUOUS


class LoopCase:
    """Two submaps as the table below asks about them; what is dear to know waits until asked."""

    def __init__(
        self,
        target: ClosedSection,
        source: ClosedSection,
        prior: Prior,
        config: VehicleMapperConfig,
    ) -> None:
        self.target, self.source, self.prior = target, source, prior
        self.config, self.sigma_m = config, config.match.sigma_m
        sigma = np.sqrt(np.diag(prior.covariance)) * SEARCH_SIGMA
        half_width_m = np.clip(sigma[:2], 2.0 * self.sigma_m, MAX_WINDOW_M)
        half_width_rad = float(np.clip(sigma[2], 0.05, MAX_WINDOW_RAD))
        self.half_width = float(half_width_m[0]), float(half_width_m[1]), half_width_rad
        widest_m = max(float(half_width_m.max()), 4.0 * self.sigma_m)
        self.window = PriorWindow(prior.T_target_source, widest_m, half_width_rad)

    @cached_property
    def guess(self) -> ScanMatch:
        """What the matcher finds in the window."""
        return self._matched(self.prior, self.half_width)

    @cached_property
    def judged(self) -> RegistrationResult:
        """What the engine says."""
        log_odds_max = self.config.occupancy.log_odds_max
        return register_grids(
            self.source.grid.decompressed().to_occupancy(log_odds_max),
            self.target.grid.decompressed().to_occupancy(log_odds_max),
            self.config.loop.registration,
            prior=self.window,
        )

    @cached_property
    def found(self) -> SE2:
        """Where the engine says that it is; the prior where it does not."""
        return self.judged.T_target_source or self.prior.T_target_source

    @property
    def is_outside(self) -> bool:
        """Whether that is beyond the window."""
        distance, turn = self.found.distance_to(self.window.T_target_source)
        window = self.window
        return distance > 1.5 * window.half_width_m or turn > 1.5 * window.half_width_rad

    @property
    def offset(self) -> tuple[float, float]:
        """How far the two judges are apart [m, rad]."""
        return self.found.distance_to(self.guess.T_target_source)

    @cached_property
    def conflict(self) -> float:
        """Share of either submap's echoes on free water of the other, where the matcher says."""
        there = conflict(self.target.grid, self.source.points, self.guess.T_target_source)
        back = self.guess.T_target_source.inverse()
        return max(there, conflict(self.source.grid, self.target.points, back))

    @cached_property
    def match(self) -> ScanMatch:
        """The matcher's answer near the pose that is agreed on."""
        if self.judged.is_accepted:
            # The engine's last digits depend on how memory is aligned; the mapper's must not.
            agreed = SE2.from_array(np.round(self.found.as_array(), _DIGITS))
        else:
            agreed = self.guess.T_target_source
        reach_m = self.sigma_m
        near = Prior(agreed, np.diag([reach_m, reach_m, _NEAR_RAD]) ** 2)
        return self._matched(near, (4.0 * reach_m, 4.0 * reach_m, 2.0 * _NEAR_RAD))

    @cached_property
    def information(self) -> FloatArray:
        """Of the match (3, 3), in the target frame, less what bend and other fits leave open."""
        T_target_source = self.match.T_target_source
        rotation = np.eye(3)
        rotation[:2, :2] = T_target_source.rotation()
        bend = self.target.drift + rotation @ self.source.drift @ rotation.T
        others = rivals(
            self.target, self.source, T_target_source, self.prior, self.window.half_width_m,
            self.sigma_m,
        )  # fmt: skip
        return with_bend(without_direction(self.match.information, others), bend)

    def _matched(self, prior: Prior, half_width: tuple[float, float, float]) -> ScanMatch:
        """Match of points with points within a window, from coarse to fine."""
        target, source, fine = self.target, self.source, self.sigma_m
        sigmas = [float(np.clip(max(half_width[:2]) / 8.0, 2.0 * fine, _COARSEST * fine))]
        while sigmas[-1] > 1.5 * fine:
            sigmas.append(max(0.5 * sigmas[-1], fine))
        fields = [LikelihoodField(target.points, target.weight, s) for s in sigmas]
        points, weight = thin(source.points, 1.0 - np.exp(-source.weight), fine)
        stride = max(1, -(-len(points) // _MAX_POINTS))
        # The window already says where to look; inside it the prior only breaks ties, so it is
        # wide.
        spread = prior.covariance * 4.0 + np.diag([fine**2, fine**2, 1e-4])
        return match_points(
            fields, points[::stride], weight[::stride], Prior(prior.T_target_source, spread),
            half_width, self.config.match.information_share,
        )  # fmt: skip


def _is_finite(match: ScanMatch) -> bool:
    numbers = match.overlap, match.score, match.lead, *match.information.ravel()
    return bool(np.isfinite(numbers).all())


def _engine(case: LoopCase) -> str:
    return f"the engine says {case.judged.verdict.name} ({case.judged.reason})"


_RULES: tuple[Rule[LoopCase, bool], ...] = (
    Rule(
        lambda c: not _is_finite(c.guess),
        False,
        lambda c: f"the matcher's numbers are not finite: {c.guess}",
    ),
    Rule(
        lambda c: c.guess.overlap < _HOPELESS,
        False,
        lambda c: f"share of echoes that meet echoes: {at_least(c.guess.overlap, _HOPELESS)}",
    ),
    Rule(lambda c: c.judged.T_target_source is None, False, _engine),
    Rule(
        lambda c: c.judged.is_accepted and c.is_outside,
        False,
        lambda c: f"the engine accepts {c.found}, which lies outside {c.window}",
    ),
    Rule(lambda c: not c.judged.is_accepted and c.judged.verdict not in _OPEN, False, _engine),
    Rule(
        lambda c: not c.judged.is_accepted and c.guess.overlap < _SURE_OVERLAP,
        False,
        lambda c: (
            f"{_engine(c)}, and echoes that meet echoes are "
            + at_least(c.guess.overlap, _SURE_OVERLAP)
        ),
    ),
    Rule(
        lambda c: not c.judged.is_accepted and c.guess.lead < _SURE_LEAD,
        False,
        lambda c: (
            f"{_engine(c)}, and the lead over the matcher's next pose is "
            + at_least(c.guess.lead, _SURE_LEAD)
        ),
    ),
    Rule(
        lambda c: not c.judged.is_accepted and c.conflict > _SURE_CONFLICT,
        False,
        lambda c: (
            f"{_engine(c)}, and echoes on free water are {at_most(c.conflict, _SURE_CONFLICT)}"
        ),
    ),
    Rule(
        lambda c: not c.judged.is_accepted and c.offset[0] > 3.0 * c.sigma_m,
        False,
        lambda c: (
            f"{_engine(c)}, and the matcher's pose is away from it by metres "
            + at_most(c.offset[0], 3.0 * c.sigma_m, ".2f")
        ),
    ),
    Rule(
        lambda c: not c.judged.is_accepted and c.offset[1] > _NEAR_RAD,
        False,
        lambda c: (
            f"{_engine(c)}, and the matcher's pose is turned from it by radians "
            + at_most(c.offset[1], _NEAR_RAD, ".3f")
        ),
    ),
    Rule(
        lambda c: not _is_finite(c.match),
        False,
        lambda c: f"the refined match is not finite: {c.match}",
    ),
    Rule(
        lambda c: c.match.overlap < MIN_OVERLAP,
        False,
        lambda c: (
            "share of echoes that meet echoes, refined: " + at_least(c.match.overlap, MIN_OVERLAP)
        ),
    ),
    Rule(
        lambda c: not np.isfinite(c.information).all(),
        False,
        lambda c: f"its information is not finite: {c.information.tolist()}",
    ),
    Rule(lambda _: True, True, lambda c: f"{_engine(c)}, the matcher {c.match.overlap:.0%}"),
)
"""What makes a loop closed: that only the last line applies."""


def decide_loop(
    target: ClosedSection, source: ClosedSection, prior: Prior, config: VehicleMapperConfig
) -> tuple[SE2, FloatArray] | None:
    """``T_target_source`` and its information (3, 3), in the target frame; None if refused."""
    case = LoopCase(target, source, prior, config)
    rule = first_that_applies(_RULES, case)
    _LOGGER.debug("loop %s: %s", "closed" if rule.outcome else "refused", rule.sentence(case))
    return (case.match.T_target_source, case.information) if rule.outcome else None


def with_bend(information: FloatArray, bend: FloatArray) -> FloatArray:
    """Information (3, 3) of a match, less what the submaps may be bent, by their drift (3, 3)."""
    # (L^-1 + B)^-1 without inverting L, which may be singular.
    return information @ np.linalg.inv(np.eye(3) + _BEND_SHARE * bend @ information)
