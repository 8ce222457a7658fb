"""Fit the probability of a map match on some places, and judge it on others.

Evidence of pairs is gathered without the proof: windows of one map, of different places, of
symmetric ones, of the two like ends of one basin; maps that were built apart, as in `study apart`;
and real maps of a list (`--pairs`), with motions that somebody has checked. Half of the pairs come
once more with a prior window of random size, and those of one place once more in a mirror, where
nothing is right. Two small logistic models are fitted: whether a pose is right, from what speaks
for it by itself, on all refined poses; and whether the best pose is right, in view of the others.
A line, steeper just above even odds, then makes the second's logit that of what is observed. The
first model also says which pose is the best, so after it has changed much the evidence has to
be gathered once more for the second to be that of its choices. The models are judged on other
seeds, on kinds of places and on lists that the fit never saw. The coefficients that this command
prints are those to put into `MODELS` of
`uw_dslam_ros2.core.registration.grids.judging.probability`, which says what they were fitted on.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit, log_expit

from uw_dslam_ros2.cli.studies._apart_maps import apart_maps
from uw_dslam_ros2.cli.studies._common import (
    figure,
    print_table,
    save_figure,
    share_interval,
)
from uw_dslam_ros2.cli.studies._pair_list import PAIR_COLUMNS
from uw_dslam_ros2.cli.studies._verdict_trials import (
    Trial,
    apart_tasks,
    gathered,
    listed_tasks,
    weights_of,
    window_tasks,
)
from uw_dslam_ros2.core.registration.grids.judging.probability import (
    MATCH_FEATURES,
    ODDS_FEATURES,
    POSE_FEATURES,
    VerdictModels,
    match_features,
    odds_features,
    pose_features,
    probability_of,
    share_left_by_doubts,
)
from uw_dslam_ros2.core.registration.grids.judging.verdict import decide
from uw_dslam_ros2.core.registration.grids.register import GridRegistrationConfig
from uw_dslam_ros2.core.registration.result import Verdict

FloatArray = NDArray[np.float64]

_FIT_KINDS = ("corridors", "office", "hall", "harbour", "lake", "basin", "symmetric")
_CHECK_KINDS = ("oblique", "cellular", "cave", "corridors", "harbour", "symmetric")
_OVERLAPS = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0)
_FIRST_CHECK = 1000
_RIDGE = 1.0
_ODDS_RIDGE = 0.1  # two slopes of one strong feature need hardly be held
# Which way a feature may speak, if at all; where few pairs tell, chance must not turn it round.
_SIGNS = {
    "agreement": 1, "conflict": -1, "log_detail": 1, "wall_share": -1, "log_surprise": 1,
    "log_volume": -1, "pose": 1, "lead": 1, "margin": 1, "match": 1, "rather_right": 1,
}  # fmt: skip
_OTHER_WEIGHT = 0.3  # of poses beside that of the highest score: there are several in each pair
_APART_BINS = (0.05, 0.2, 0.4, 0.5, 1.01)
_NUM_VEHICLES = 4  # maps of each place
_DIFFERENT_OF_PLACE = 10  # pairs of different places, for each place that was mapped apart


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this study."""
    parser.add_argument("--seeds", type=int, default=4, help="seeds of the fit (%(default)s)")
    parser.add_argument("--checks", type=int, default=2, help="seeds held out (%(default)s)")
    parser.add_argument("--fit-kinds", nargs="+", default=list(_FIT_KINDS), help="places fitted")
    parser.add_argument(
        "--check-kinds", nargs="+", default=list(_CHECK_KINDS), help="places judged on"
    )
    parser.add_argument("--overlaps", nargs="+", type=float, default=list(_OVERLAPS))
    parser.add_argument(
        "--places", type=int, default=80, help="places mapped apart, of the fit (%(default)s)"
    )
    parser.add_argument(
        "--check-places", type=int, default=40, help="places mapped apart, held out (%(default)s)"
    )
    parser.add_argument(
        "--cache", type=Path, metavar="DIR", help="folder of maps built apart (default: in --out)"
    )
    parser.add_argument(
        "--pairs", type=Path, metavar="CSV",
        help=f"real pairs to fit on, too; columns {', '.join(PAIR_COLUMNS)}",
    )  # fmt: skip
    parser.add_argument(
        "--check-pairs", type=Path, metavar="CSV", help="real pairs of other places, to judge on"
    )


def run(args: argparse.Namespace) -> int:
    """Gather, fit, check, draw."""
    fit = _gathered(args, "fit", args.fit_kinds, range(args.seeds), args.places, args.pairs)
    models = _fitted(fit)
    seeds = range(_FIRST_CHECK, _FIRST_CHECK + args.checks)
    check = _gathered(args, "check", args.check_kinds, seeds, args.check_places, args.check_pairs)
    _print_models(models)
    for name, trials in (("fitted", fit), ("held out", check)):
        print(f"\n{name}: {len(trials)} answers")
        _print_thresholds(trials, models)
    for name, trials in (("fitted", fit), ("held-out", check)):
        print(f"\nverdicts on the {name} pairs, by the default settings")
        _print_verdicts(trials, models)
    _draw(args.out / "reliability.png", {"fitted": fit, "held out": check}, models)
    return 0


def _gathered(
    args: argparse.Namespace,
    name: str,
    kinds: list[str],
    seeds: range,
    num_places: int,
    listed: Path | None,
) -> list[Trial]:
    """Evidence of windows, of maps that were built apart, and of real ones."""
    trials = gathered(args.out / f"{name}.csv", window_tasks(kinds, args.overlaps, seeds))
    places = range(seeds.start, seeds.start + num_places)
    maps = apart_maps(places, _NUM_VEHICLES, args.cache or args.out / "maps")
    tasks = apart_tasks(maps, _DIFFERENT_OF_PLACE * num_places, seeds.start)
    trials += gathered(args.out / f"{name}_apart.csv", tasks)
    if listed is not None:
        trials += gathered(args.out / f"{name}_listed.csv", listed_tasks(listed))
    return trials


def _fitted(trials: list[Trial]) -> VerdictModels:
    """The models, one after the other.

    A pose in a symmetric place is convincing for itself wherever it is: there, rivals decide. The
    second model is of matches that nothing explains otherwise, and which those are nobody knows:
    so it is fitted to what its probability comes to beside aliases and mirror.
    """
    features, is_right, weights = [], [], []
    trial_weights = weights_of(trials)
    for trial, weight in zip(trials, trial_weights, strict=True):
        if trial.spec.kind == "symmetric":
            continue
        # Not the best by the model that is being replaced: that would fit it to its own errors.
        highest = max(one.score for one, _ in trial.poses)
        for one, is_pose_right in trial.poses:
            features.append(pose_features(one, trial.evidence.log_volume))
            is_right.append(is_pose_right)
            weights.append(weight * (1.0 if one.score == highest else _OTHER_WEIGHT))
    pose = _logistic(POSE_FEATURES, features, is_right, weights, [1.0] * len(features))
    answers = [trial.is_right for trial in trials]
    most = [share_left_by_doubts(trial.evidence, VerdictModels(pose)) for trial in trials]
    rows = [match_features(trial.evidence, pose) for trial in trials]
    match = _logistic(MATCH_FEATURES, rows, answers, trial_weights, most)
    pairs = [odds_features(row, match) for row in rows]
    odds = _logistic(ODDS_FEATURES, pairs, answers, trial_weights, most, _ODDS_RIDGE)
    return VerdictModels(pose, match, (odds[0], odds[1], odds[2]))


def _logistic(
    names: Sequence[str],
    rows: Sequence[tuple[float, ...]],
    is_right: list[bool],
    weights: list[float],
    most: list[float],
    ridge: float = _RIDGE,
) -> tuple[float, ...]:
    """Coefficients, intercept first, of a ridge-regularised logistic model with `_SIGNS`.

    The probability that a row is right is that of the model times its ``most``.
    """
    features, answers, weight = np.array(rows), np.array(is_right, float), np.array(weights)
    share = np.array(most)
    mean, spread = features.mean(axis=0), features.std(axis=0) + 1e-9
    scaled = (features - mean) / spread

    def loss(model: FloatArray) -> tuple[float, FloatArray]:
        logit = model[0] + scaled @ model[1:]
        given = expit(logit)
        wrong = 1.0 - share * given
        likelihood = answers * log_expit(logit) + (1.0 - answers) * np.log(wrong)
        slope = weight * ((1.0 - answers) * share * given / wrong - answers) * (1.0 - given)
        pull = np.concatenate([[0.0], ridge * model[1:]])
        gradient = np.concatenate([[slope.sum()], scaled.T @ slope]) + pull
        return float(-weight @ likelihood + 0.5 * model @ pull), gradient

    bounds = [(0.0, None) if _SIGNS[name] > 0 else (None, 0.0) for name in names]
    start = np.zeros(1 + len(names))
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=[(None, None), *bounds]).x
    slopes = found[1:] / spread
    intercept = float(found[0] - slopes @ mean)
    return tuple(round(value, 4) for value in (intercept, *map(float, slopes)))


def _print_models(models: VerdictModels) -> None:
    for name, features, model in (
        ("pose", POSE_FEATURES, models.pose),
        ("match", MATCH_FEATURES, models.match),
        ("odds", ODDS_FEATURES, models.odds),
    ):
        print_table(
            (f"feature of model {name}", "coefficient"),
            zip(("intercept", *features), model, strict=True),
        )
        print(f"{name}={model}")


def _groups(trials: list[Trial]) -> dict[str, list[Trial]]:
    """Trials by what is asked of them; those with a prior by themselves."""

    def group(trial: Trial) -> str:
        spec = trial.spec
        if trial.is_mirrored:
            return "in a mirror"
        if spec.is_alias:
            return "like ends of one basin"
        if not spec.is_matching:
            if spec.kind == "twin":
                return "twins"
            return "different places, apart" if trial.is_apart else "different places"
        if spec.kind in ("symmetric", "basin"):
            return "symmetric place"
        if trial.has_prior:
            return "prior window"
        if spec.kind == "real":
            return "real maps"
        if trial.is_apart:
            low, high = next(b for b in itertools.pairwise(_APART_BINS) if spec.overlap < b[1])
            return f"apart, {low:.0%} to {high:.0%}".replace("%", " %")
        if spec.overlap >= 0.5:
            return "overlap 50 % and more"
        return f"overlap {spec.overlap:.0%}".replace("%", " %")

    groups: dict[str, list[Trial]] = {}
    for trial in trials:
        groups.setdefault(group(trial), []).append(trial)
    return dict(sorted(groups.items()))


def _print_thresholds(trials: list[Trial], models: VerdictModels) -> None:
    probability = np.array([probability_of(t.evidence, models) for t in trials])
    right = np.array([t.is_right for t in trials])
    groups = _groups(trials)
    much = np.isin(
        [id(t) for t in trials], [id(t) for t in groups.get("overlap 50 % and more", [])]
    )
    some = np.isin([id(t) for t in trials], [id(t) for t in groups.get("overlap 30 %", [])])
    other = np.array([not t.spec.is_matching for t in trials])
    rows = []
    for threshold in (0.5, 0.7, 0.8, 0.9, 0.95, 0.98):
        is_kept = probability >= threshold
        rows.append(
            (
                threshold,
                *(f"{(is_kept & right)[mask].mean():.3f}" if mask.any() else "-"
                  for mask in (much, some)),
                f"{int((is_kept & ~right).sum())} of {int((~right).sum())}",
                f"{int((is_kept & other).sum())} of {int(other.sum())}",
            )
        )  # fmt: skip
    print_table(("threshold", "right, 50 % and more", "right, 30 %", "wrong", "of no match"), rows)


def _print_verdicts(trials: list[Trial], models: VerdictModels) -> None:
    config = GridRegistrationConfig()
    rows = []
    for name, members in _groups(trials).items():
        verdicts = [decide(t.evidence, config, models)[0] for t in members]
        accepted = [v is Verdict.ACCEPTED for v in verdicts]
        kept = sum(a and t.is_right for a, t in zip(accepted, members, strict=True))
        wrong = sum(a and not t.is_right for a, t in zip(accepted, members, strict=True))
        low, high = share_interval(wrong, len(members))
        rows.append(
            (
                name,
                len(members),
                f"{np.mean([t.is_right for t in members]):.2f}",
                f"{kept / len(members):.2f}",
                f"{wrong}, {low:.1%} to {high:.1%}",
                sum(v is Verdict.AMBIGUOUS for v in verdicts),
            )
        )
    print_table(
        ("pairs", "answers", "right", "accepted, right", "accepted, wrong (95 %)", "ambiguous"),
        rows,
    )


def _draw(path: Path, sets: dict[str, list[Trial]], models: VerdictModels) -> None:
    """Reliability diagram: share of right matches over the stated probability."""
    picture, (row,) = figure()
    axes = row[0]
    axes.plot([0, 1], [0, 1], "k:", linewidth=0.8)
    edges = np.array([0.0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.95, 1.0])
    for name, trials in sets.items():
        probability = np.array([probability_of(t.evidence, models) for t in trials])
        right = np.array([t.is_right for t in trials])
        which = np.clip(np.digitize(probability, edges) - 1, 0, len(edges) - 2)
        used = [k for k in range(len(edges) - 1) if (which == k).any()]
        stated = [probability[which == k].mean() for k in used]
        share = [right[which == k].mean() for k in used]
        counts = [int((which == k).sum()) for k in used]
        errors = []
        for k, value in zip(used, share, strict=True):
            low, high = share_interval(int(right[which == k].sum()), int((which == k).sum()))
            errors.append((max(value - low, 0.0), max(high - value, 0.0)))
        axes.errorbar(stated, share, np.array(errors).T, fmt="o-", label=name, capsize=2)
        for x, y, count in zip(stated, share, counts, strict=True):
            axes.annotate(str(count), (x, y), textcoords="offset points", xytext=(4, -9))
    axes.set_xlabel("stated probability")
    axes.set_ylabel("share of right matches")
    axes.legend(loc="upper left")
    save_figure(picture, path)
