"""Whether answers that check each other are to be believed."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uw_dslam_ros2.core.merging.graph.answers import Answer
from uw_dslam_ros2.core.merging.graph.components import Constraint
from uw_dslam_ros2.core.merging.graph.consistency import Side, consistent_set, cycles_of
from uw_dslam_ros2.core.merging.types import Edge
from uw_dslam_ros2.core.pose_graph import chi2_threshold
from uw_dslam_ros2.core.registration.result import PriorWindow

__all__ = ["ENOUGH_ODDS", "Vote", "vote_of", "weigh"]

ENOUGH_ODDS, _ODDS_BEYOND_DOUBT = 10.0, 1000.0
"""A match is believed if its checks make it ten times as likely as not, or a thousand times where
none of the answers was accepted by itself.
"""
_PASS = 0.6
"""How often a check of a true match agrees with it."""
_LEAST_CHANCE = 0.05
"""How often a check of a false match agrees with it at least: mistakes have common causes."""


@dataclass(frozen=True, slots=True, eq=False)
class Vote:
    """An answer as evidence; without a prior it is the claim that the others check."""

    constraint: Constraint
    prior: PriorWindow | None
    is_accepted: bool


def vote_of(constraint: Constraint, answer: Answer) -> Vote:
    """An answer, with the edge that it would make, as a vote."""
    return Vote(constraint, answer.query.prior, answer.is_accepted)


def weigh(
    votes: Sequence[Vote],
    num_checks: int,
    source: Side,
    target: Side,
    inlier_probability: float,
) -> tuple[list[Constraint], float]:
    """The constraints to be believed, and the odds that what they say is true.

    Every check that agrees with another vote speaks for it as much as such an agreement is
    unlikely by chance: the smaller the region of agreement is within the window that was searched,
    the more. A check that was refused for want of evidence votes too, and is believed itself where
    agreement makes up for what it lacks.

    Parameters
    ----------
    votes
        Answers with a transform.
    num_checks
        How many were asked, those without a transform included.
    source, target
        What the votes join.
    inlier_probability
        Share of true pairs that the chi-square test lets pass.
    """
    edges = [_turned(vote.constraint.edge, source, target) for vote in votes]
    weights = [vote.constraint.probability for vote in votes]
    clique = consistent_set(edges, weights, source, target, inlier_probability)
    has_accepted = any(votes[index].is_accepted for index in clique)
    believed: list[Constraint] = []
    odds = (1.0 - _PASS) ** (num_checks - sum(votes[i].prior is not None for i in clique))
    chances = _coincidences(votes, edges, clique, source, target, inlier_probability)
    for place, index in enumerate(clique):
        vote = votes[index]
        coincidences = {other: chances[index, other] for other in clique if other != index}
        lacking = 1.0 / max(vote.constraint.probability, 1e-9) - 1.0
        if (
            vote.is_accepted
            or lacking * min(coincidences.values(), default=1.0) <= 1.0 / ENOUGH_ODDS
        ):
            believed.append(vote.constraint)
        if place > 0 and vote.prior is not None:
            odds *= _PASS / min(coincidences[earlier] for earlier in clique[:place])
    # Without an accepted answer among them, agreement has to be beyond doubt.
    if not has_accepted and odds < _ODDS_BEYOND_DOUBT:
        return [], 0.0
    return believed, odds


def _coincidences(
    votes: Sequence[Vote],
    edges: Sequence[Edge],
    clique: Sequence[int],
    source: Side,
    target: Side,
    inlier_probability: float,
) -> dict[tuple[int, int], float]:
    """Share of the window that the first vote searched in which it would agree with the second."""
    pairs = list(itertools.permutations(clique, 2))
    _, covariances = cycles_of(edges, pairs, source, target)
    radius = math.sqrt(chi2_threshold(inlier_probability))
    sigmas = np.sqrt(np.maximum(np.linalg.eigvalsh(covariances[:, :2, :2]), 0.0))
    turns = radius * np.sqrt(covariances[:, 2, 2])
    found: dict[tuple[int, int], float] = {}
    for pair, sigma, turn_rad in zip(pairs, sigmas, turns.tolist(), strict=True):
        prior = votes[pair[0]].prior
        if prior is None:
            found[pair] = 1.0
            continue
        sides_m = np.minimum(2.0 * radius * sigma, 2.0 * prior.half_width_m)
        turn = min(turn_rad, prior.half_width_rad)
        window = 4.0 * prior.half_width_m**2 * prior.half_width_rad
        found[pair] = float(max(sides_m.prod() * turn / window, _LEAST_CHANCE))
    return found


def _turned(edge: Edge, source: Side, target: Side) -> Edge:
    """The same edge, from `source` to `target`."""
    if edge.source in source.T_frame_submap and edge.target in target.T_frame_submap:
        return edge
    return edge.reversed()
