"""What the studies share: figures in one style, tables, CSV files, success criteria."""

from __future__ import annotations

import argparse
import csv
import math
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.figure import Figure
from tqdm import tqdm

from uw_dslam_ros2.cli.common import config_file
from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.se2 import SE2

__all__ = [
    "ARACATI",
    "COLOURS",
    "SUCCESS_M",
    "SUCCESS_RAD",
    "add_aracati_arguments",
    "aracati_settings",
    "data_dir",
    "figure",
    "is_success",
    "optional_data_dir",
    "print_table",
    "progress",
    "save_figure",
    "share_interval",
    "summary",
    "write_csv",
]

# The success region of the synthetic protocol: 2 degrees and 0.05 (the square's side is 2).
SUCCESS_RAD = math.radians(2.0)
SUCCESS_M = 0.05

ARACATI = "aracati2017"
"""The real recording, as its folder and its settings file are called."""

# Okabe and Ito's palette: told apart in print and by colour-blind readers.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999")

_STYLE = {
    "figure.dpi": 150,
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.prop_cycle": cycler(color=COLOURS),
    "legend.frameon": False,
    "lines.linewidth": 1.5,
}


def figure(rows: int = 1, columns: int = 1, *, width: float = 6.4, height: float = 4.0) -> Any:
    """A figure in the project's style and its axes, an array (rows, columns); size in inches."""
    matplotlib.rcParams.update(_STYLE)
    # Not pyplot: a study runs without a display.
    made = Figure(figsize=(width, height), layout="constrained")
    return made, made.subplots(rows, columns, squeeze=False)


def save_figure(made: Figure, path: Path) -> None:
    """Write a PNG, without panels that nothing is drawn in, and say where."""
    for axis in made.axes:
        axis.set_visible(axis.has_data())
    made.savefig(path)
    print(f"wrote {path}")


def write_csv(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Write rows that share their keys, and say where."""
    rows = list(rows)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]) if rows else [])
        writer.writeheader()
        writer.writerows(rows)
    print(f"wrote {path}")


def print_table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Print a Markdown table with aligned columns, so that it can be pasted into the docs."""
    table = [[str(value) for value in row] for row in (header, *rows)]
    widths = [max(len(row[i]) for row in table) for i in range(len(header))]
    for number, row in enumerate(table):
        print("| " + " | ".join(v.ljust(w) for v, w in zip(row, widths, strict=True)) + " |")
        if number == 0:
            print("|" + "|".join("-" * (w + 2) for w in widths) + "|")


def progress(items: Iterable[Any] | None, total: int | None = None, text: str = "") -> Any:
    """Wrap `items` in a progress bar, on a terminal only."""
    return tqdm(items, total=total, desc=text, disable=not sys.stderr.isatty(), leave=False)


def is_success(T_found: SE2 | None, T_true: SE2) -> bool:
    """Whether a pose lies in the success region; None, a refusal, does not."""
    if T_found is None:
        return False
    error_m, error_rad = T_found.distance_to(T_true)
    return error_m < SUCCESS_M and error_rad < SUCCESS_RAD


def share_interval(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share."""
    z = 1.96
    share = successes / trials
    centre = (share + z * z / (2 * trials)) / (1 + z * z / trials)
    half = (
        z / (1 + z * z / trials) * math.sqrt(share * (1 - share) / trials + (z / 2 / trials) ** 2)
    )
    return max(0.0, centre - half), min(1.0, centre + half)


def data_dir(given: Path | None, dataset: str) -> Path:
    """Folder of a recording: `given`, else ``$UW_DATA_DIR/<dataset>``; `DataError` if missing."""
    if given is None:
        root = os.environ.get("UW_DATA_DIR")
        if not root:
            raise DataError(
                f"the recording {dataset} is needed: pass --data DIR, or set UW_DATA_DIR to the "
                f"folder that holds {dataset}/"
            )
        given = Path(root)
    nested = given / dataset
    folder = nested if nested.is_dir() else given
    if not folder.is_dir():
        raise DataError(f"the data folder {folder} does not exist")
    return folder


def optional_data_dir(given: Path | None, dataset: str) -> Path | None:
    """Folder of a recording as `data_dir`; None, and a line that says so, if it is not given."""
    try:
        return data_dir(given, dataset)
    except DataError as error:
        if given is not None:
            raise
        print(f"{dataset} is left out: {error}")
        return None


def add_aracati_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of a study that also maps the real recording Aracati 2017."""
    parser.add_argument("--data", type=Path, metavar="DIR", help=f"folder with {ARACATI}")
    parser.add_argument(
        "--aracati-config",
        type=Path,
        metavar="FILE",
        help="settings for the real recording (default: ours)",
    )


def aracati_settings(args: argparse.Namespace) -> Path:
    """Settings file for the real recording, of `add_aracati_arguments`."""
    return args.aracati_config or config_file(f"{ARACATI}.yaml")


def summary(values: Sequence[float]) -> tuple[float, float]:
    """Median and 95th percentile; NaN without values."""
    if len(values) == 0:
        return math.nan, math.nan
    return float(np.median(values)), float(np.percentile(values, 95))
