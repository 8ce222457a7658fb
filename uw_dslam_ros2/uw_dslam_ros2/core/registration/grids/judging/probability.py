"""Probability that a match of two maps is right, from measured quantities.

The coefficients are fitted by `study verdict`, on simulated pairs and on real ones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from uw_dslam_ros2.core.registration.grids.judging.agreement import Agreement

__all__ = [
    "ENOUGH_DETAIL",
    "MATCH_FEATURES",
    "MODELS",
    "ODDS_FEATURES",
    "POSE_FEATURES",
    "MatchEvidence",
    "PoseEvidence",
    "VerdictModels",
    "lead_over_decoy",
    "match_features",
    "odds_features",
    "pose_features",
    "pose_logit",
    "probability_of",
    "rival_probability",
    "share_left_by_doubts",
]


@dataclass(frozen=True, slots=True)
class PoseEvidence:
    """What is known about one pose of two maps.

    ``score`` is the objective on the finest level, ``surprise`` how far that on the searched level
    lies above what chance alignments of these two maps reach, in standard deviations of such.
    """

    agreement: Agreement
    score: float
    surprise: float


@dataclass(frozen=True, slots=True)
class MatchEvidence:
    """What is known about the best pose of two maps, the most convincing one, and its rivals.

    ``deviation_m`` is the best pose's standard deviation in the direction that is fixed the least,
    at the rim for turns; ``extent_m`` the root mean square distance of the walls of the smaller
    map from their mean. ``log_volume`` is the logarithm of the number of poses that were searched:
    the more there are, the better the best of them is by chance. ``cell_m`` is the side of the
    cells on which the maps agree best, and which all of this is counted in. ``decoy`` is the best
    pose of the source seen in a mirror, on the same cells, where that was looked for, of as many
    as ``decoy_log_volume`` says.
    """

    best: PoseEvidence
    rivals: tuple[PoseEvidence, ...]
    deviation_m: float
    extent_m: float
    log_volume: float
    cell_m: float
    decoy: PoseEvidence | None = None
    decoy_log_volume: float = math.nan

    @property
    def rival_share(self) -> float:
        """Greatest score of a rival over the best pose's."""
        most = max((rival.score for rival in self.rivals), default=0.0)
        return max(most, 0.0) / max(self.best.score, 1e-9)


ENOUGH_DETAIL = 600.0
"""More cells of detail are no more proof: chance matches of large maps have them too."""
# Wall cells next to each other agree or not together: so many count as one (design effect, the
# scatter of sums over squares against that of independent cells: 2.5 to 6 in noisy maps).
_CELLS_PER_SAMPLE = 5.0
_MOST_HOPELESS = 700.0
_LEAST_VARIANCE = 0.005  # of one sample, as if one in two hundred disagreed
_LIKE_DETAIL = 0.02  # how much of the best pose's detail it shows at least, sharing less area

POSE_FEATURES = (
    "agreement",
    "conflict",
    "log_detail",
    "wall_share",
    "log_surprise",
    "log_volume",
)
MATCH_FEATURES = ("pose", "lead", "margin")
ODDS_FEATURES = ("match", "rather_right")
_RIVAL_SHARES = (0.2, 2.0)  # beyond, a rival's score says no more
_MOST_MARGIN = 3.0  # logits; beyond, a rival's evidence says no more
_RATHER_RIGHT = 2.0  # logits above even odds; beyond, the match model is sure
_OWN_BOUND = (2.1, 2.0)  # on the logit of a match: at even odds of its pose, and its slope
_MOST_LOGIT = 12.0
_ONE_OF_TWO = 0.5
# How often one of two maps has left and right exchanged [logit]: one time in fourteen.
_MIRRORED = -2.6
# Where straight walls are all that agrees, accident does as much in a mirror: before anything is
# seen, its odds are three to two. Each sample of detail speaks against that.
_BARE = 3.0


@dataclass(frozen=True, slots=True)
class VerdictModels:
    """Logistic models, intercept first: of a pose for itself, and of the best of two maps.

    ``odds`` makes the logit of the second that of the probability which is observed: intercept,
    slope, and what the slope has more just above even odds.
    """

    pose: tuple[float, ...]
    match: tuple[float, ...] = ()
    odds: tuple[float, float, float] = (0.0, 1.0, 0.0)


MODELS = VerdictModels(
    pose=(-1.3292, 1.9783, -20.1197, 0.7012, -4.7006, 2.4299, -0.2288),
    match=(-1.9433, 0.9233, 2.4792, 0.7057),
    odds=(-0.466, 0.8627, 1.886),
)
"""Fitted by the model fit of `study verdict`, each place weighed as one.

The model of a pose is of 1,891 answers: 364 of windows of simulated places, 276 of maps of
simulated places that were built apart, 1,251 of real maps; the slope of ``log_volume`` is held at
what windows with and without priors gave before. The model of a match and its odds are of 4,011
answers: 1,468 of simulated places, 360 of them in a mirror, 123 with a prior, 517 pairs of
different places; 2,543 of real maps, 528 of them in a mirror, 288 windows of lidar maps, 1,463
pairs of different places. The real maps are public ones and no part of this repository; a list of
one's own goes to `--pairs`.
docs/experiments.md has what other fits would change.
"""


def pose_features(pose: PoseEvidence, log_volume: float) -> tuple[float, ...]:
    """Quantities that speak for or against a pose by itself, as `POSE_FEATURES`."""
    agreement = pose.agreement
    return (
        agreement.agreement,
        agreement.conflict,
        math.log1p(min(agreement.num_detail, ENOUGH_DETAIL) / _CELLS_PER_SAMPLE),
        agreement.wall_share,
        math.log(min(max(pose.surprise, 0.5), 30.0)),
        log_volume,
    )


def match_features(evidence: MatchEvidence, pose_model: Sequence[float]) -> tuple[float, ...]:
    """Quantities that speak for or against the best pose in view of the others.

    Its logit for itself, the logarithm of how many times it scores any other pose, and by how much
    its logit exceeds that of the most alike of them. Where two maps do not belong together, their
    best poses score and convince alike; where they share little, the right one scores less than
    many, but convinces.
    """
    best = _logit(pose_model, pose_features(evidence.best, evidence.log_volume))
    least, most = _RIVAL_SHARES
    lead = -math.log(min(max(evidence.rival_share, least), most))
    margin = best - _most_alike(evidence, pose_model)
    return best, lead, min(max(margin, 0.0), _MOST_MARGIN)


def odds_features(features: Sequence[float], match_model: Sequence[float]) -> tuple[float, float]:
    """Logit of the match model, and what of it lies just above even odds, as `ODDS_FEATURES`.

    ``features`` are those of `match_features`.

    A logistic model is held back by the few matches that are right though nothing speaks for them:
    those that it thinks rather right than wrong are right far oftener than it says. Where it is
    sure there are too few wrong ones to say more.
    """
    logit = _logit(match_model, features)
    return logit, min(max(logit, 0.0), _RATHER_RIGHT)


def _most_alike(evidence: MatchEvidence, pose_model: Sequence[float]) -> float:
    """Logit of the rival that is the most convincing alias of the best pose."""
    logits = [
        _logit(pose_model, pose_features(rival, evidence.log_volume)) - _doubt(evidence, rival)
        for rival in evidence.rivals
    ]
    return max(logits, default=-_MOST_LOGIT)


def _doubt(evidence: MatchEvidence, rival: PoseEvidence) -> float:
    """What speaks against a rival as the true pose of a place that looks like itself.

    The true pose agrees as well as its alias, for the maps are the same, and in the same kind of
    detail. What agrees significantly less is repeated walls: the best pose would have to agree
    better by chance than the true one, with a likelihood of exp(-z^2 / 2) at z standard errors.
    """
    best, other = evidence.best.agreement, rival.agreement
    if other.num_detail < _LIKE_DETAIL * best.num_detail:
        return 2.0 * _MOST_LOGIT
    return 0.5 * max(_lead(best, other), 0.0) ** 2


def probability_of(
    evidence: MatchEvidence, models: VerdictModels = MODELS, *, is_alone: bool = False
) -> float:
    """Probability in [0, 1] that the best pose is right.

    Where no other pose explains two maps, the best one stands out, also if it explains little: so
    what speaks for it by itself bounds what its rivals' weakness can say.

    ``is_alone`` asks only how convincing it is, and for nothing that explains it otherwise.
    """
    features = match_features(evidence, models.pose)
    odds = _logit(models.odds, odds_features(features, models.match))
    bound, slope = _OWN_BOUND
    alone = _share(min(odds, bound + slope * features[0]))
    if is_alone:
        return alone
    return alone * share_left_by_doubts(evidence, models)


def share_left_by_doubts(evidence: MatchEvidence, models: VerdictModels = MODELS) -> float:
    """What an alias of the best pose and a mirror leave of its probability, in [0, 1].

    Where a place looks like itself, as the strongest rival's own probability says, the best pose
    is one of two that nothing tells apart.
    """
    alias = (1.0 - _ONE_OF_TWO) * rival_probability(evidence, models)
    return (1.0 - alias) * (1.0 - _mirror_probability(evidence, models))


def pose_logit(pose: PoseEvidence, log_volume: float, models: VerdictModels = MODELS) -> float:
    """Logit that a pose is right, from what speaks for it by itself."""
    return _logit(models.pose, pose_features(pose, log_volume))


def rival_probability(evidence: MatchEvidence, models: VerdictModels = MODELS) -> float:
    """How probable the most convincing rival is for itself, as if the best pose were not there."""
    return _share(_most_alike(evidence, models.pose))


def lead_over_decoy(evidence: MatchEvidence, models: VerdictModels = MODELS) -> float:
    """By how much the logit of the best pose exceeds that of the decoy; infinite without one."""
    if evidence.decoy is None:
        return math.inf
    best = pose_logit(evidence.best, evidence.log_volume, models)
    return best - pose_logit(evidence.decoy, evidence.decoy_log_volume, models)


def _mirror_probability(evidence: MatchEvidence, models: VerdictModels) -> float:
    """How probable it is that the source is in a mirror, or agrees there by as much accident.

    0 where no decoy was looked for.
    """
    bareness = math.exp(-evidence.best.agreement.num_detail / _CELLS_PER_SAMPLE)
    return _share(_MIRRORED + _BARE * bareness - lead_over_decoy(evidence, models))


def _share(logit: float) -> float:
    """Probability of a logit; what is hopeless has one beyond the reach of an exponential."""
    return 1.0 / (1.0 + math.exp(min(-logit, _MOST_HOPELESS)))


def _lead(best: Agreement, rival: Agreement) -> float:
    """By how many standard errors one pose agrees better than another."""
    variance = 0.0
    for pose in (best, rival):
        one = max(pose.agreement * (1.0 - pose.agreement), _LEAST_VARIANCE)
        variance += one / max(pose.num_walls / _CELLS_PER_SAMPLE, 1.0)
    return (best.agreement - rival.agreement) / math.sqrt(variance)


def _logit(model: Sequence[float], features: Sequence[float]) -> float:
    logit = model[0] + sum(c * x for c, x in zip(model[1:], features, strict=True))
    if math.isnan(logit):
        return -_MOST_LOGIT  # what is not a number speaks for nothing
    return max(-_MOST_LOGIT, min(_MOST_LOGIT, logit))
