"""Fit the probability of a map match, and show its calibration on places of other kinds.

The evidence of simulated pairs (of one place, of different places) is gathered without the proof,
a small ridge-regularised logistic model is fitted to whether the best pose is right, and checked
on other seeds and on a kind of place that the fit never saw.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression

from uw_dslam_ros2.cli.studies._common import figure, print_table, progress, save_figure
from uw_dslam_ros2.cli.studies._map_pairs import PairSpec, is_right, pair_specs
from uw_dslam_ros2.core.registration.grids import match_evidence
from uw_dslam_ros2.core.registration.verdict import FEATURE_NAMES, evidence_features

FloatArray = NDArray[np.float64]

_FIT_KINDS = ("harbour", "lake", "office")
_CHECK_KINDS = ("harbour", "lake", "office", "cave")
_OVERLAPS = (0.1, 0.3, 0.5, 0.7, 1.0)
_NOISES = ("clean", "noisy", "hard")
_RIDGE = 0.1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this study."""
    parser.add_argument("--seeds", type=int, default=2, help="seeds of the fit (%(default)s)")
    parser.add_argument("--checks", type=int, default=1, help="seeds held out (%(default)s)")


def run(args: argparse.Namespace) -> int:
    """Gather, fit, check, draw."""
    fit = _gathered(
        args.out / "fit.csv", pair_specs(_FIT_KINDS, _OVERLAPS, _NOISES, range(args.seeds))
    )
    first = 1000
    check = _gathered(
        args.out / "check.csv",
        pair_specs(_CHECK_KINDS, _OVERLAPS, _NOISES, range(first, first + args.checks)),
    )
    model = LogisticRegression(C=1.0 / _RIDGE, max_iter=2000).fit(fit[:, 1:], fit[:, 0])
    coefficients = [float(model.intercept_[0]), *map(float, model.coef_[0])]
    print_table(
        ("feature", "coefficient"),
        [
            (name, f"{value:.4f}")
            for name, value in zip(("intercept", *FEATURE_NAMES), coefficients, strict=True)
        ],
    )
    probability = model.predict_proba(check[:, 1:])[:, 1]
    print_table(
        ("threshold", "right kept", "wrong kept"),
        [
            (
                f"{threshold}",
                f"{(probability[check[:, 0] > 0] >= threshold).mean():.3f}",
                f"{(probability[check[:, 0] == 0] >= threshold).mean():.4f}",
            )
            for threshold in (0.5, 0.7, 0.8, 0.9, 0.95, 0.98)
        ],
    )
    _draw(args.out / "reliability.png", probability, check[:, 0])
    return 0


def _gathered(path: Path, specs: Iterable[PairSpec]) -> FloatArray:
    """Rows [is right, features ...] of all pairs; kept in a CSV file."""
    rows = []
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(
            ("kind", "overlap", "noise", "seed", "matching", "sonar", "right", *FEATURE_NAMES)
        )
        for spec in progress(list(specs), text=path.stem):
            pair = spec.make()
            found = match_evidence(pair.source, pair.target)
            if found is None:
                continue
            evidence, motion = found
            row = (float(is_right(pair, motion)), *evidence_features(evidence))
            writer.writerow(
                (
                    spec.kind,
                    spec.overlap,
                    spec.noise,
                    spec.seed,
                    spec.is_matching,
                    spec.is_sonar,
                    *row,
                )
            )
            rows.append(row)
    return np.array(rows)


def _draw(path: Path, probability: FloatArray, right: FloatArray) -> None:
    """Reliability diagram: share of right matches over the stated probability."""
    edges = np.linspace(0.0, 1.0, 11)
    which = np.clip(np.digitize(probability, edges) - 1, 0, 9)
    used = [k for k in range(10) if (which == k).any()]
    stated = [probability[which == k].mean() for k in used]
    share = [right[which == k].mean() for k in used]
    picture, (row,) = figure()
    axes = row[0]
    axes.plot([0, 1], [0, 1], "k:", linewidth=0.8)
    axes.plot(stated, share, "o-")
    for k, x, y in zip(used, stated, share, strict=True):
        axes.annotate(
            str(int((which == k).sum())), (x, y), textcoords="offset points", xytext=(4, -8)
        )
    axes.set_xlabel("stated probability")
    axes.set_ylabel("share of right matches")
    save_figure(picture, path)
