"""Write a result folder anew after people have decided something about it."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

from uw_dslam_ros2.cli.reporting.outcome import outcome_of
from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.merging import MapQueue

__all__ = ["has_report", "write_anew"]

_REPORT = "report.json"
_NOTE = (
    "written anew from the submaps after people decided something; offline with --decisions draws "
    "the chart of it from the recordings, and scores it"
)
_BEGINNING = ".anew-"
_OF_TRUTH = "map_against_truth.png", "trajectory_error.png"


def has_report(folder: Path) -> bool:
    """Whether a folder is a result of ``offline`` or ``demo``, and not a session alone."""
    return (folder / _REPORT).is_file()


def write_anew(folder: Path, queue: MapQueue) -> None:
    """Replace a result's maps, trajectories, pose graph, report and pictures.

    All is made first, and then put in place file by file, the report last; whoever holds the
    session is the only one who does so. What the recordings
    and the truth alone tell is kept (settings, findings) or left out (scores, errors).

    Raises
    ------
    DataError
        Naming the file that cannot be read or written.
    """
    # Drawing takes long to import, and most who look decide nothing.
    from uw_dslam_ros2.cli.reporting.report import RunFacts, write_report

    told = _told(folder / _REPORT)
    names = {field.name for field in dataclasses.fields(RunFacts)}
    facts = RunFacts(**{name: value for name, value in told.items() if name in names})
    facts = dataclasses.replace(facts, notes=[n for n in facts.notes if n != _NOTE] + [_NOTE])
    unmapped = tuple(told.get("vehicles_not_mapped", ()))
    outcome = dataclasses.replace(outcome_of(queue), unmapped=unmapped)
    try:
        for left in folder.glob(f"{_BEGINNING}*"):  # by one that was killed
            shutil.rmtree(left)
        with tempfile.TemporaryDirectory(prefix=_BEGINNING, dir=folder) as made:
            has_pictures = (folder / "report.html").is_file()
            write_report(Path(made), outcome, facts, None, has_pictures=has_pictures)
            _put_in_place(Path(made), folder)
    except OSError as error:
        raise DataError(f"cannot write {folder} anew: {error.strerror or error}") from error


def _put_in_place(made: Path, folder: Path) -> None:
    files = sorted(path.relative_to(made) for path in made.rglob("*") if path.is_file())
    files.sort(key=lambda path: path.name.startswith("report."))
    stale = {path.relative_to(folder) for path in (folder / "trajectories").glob("*.tum")}
    stale |= {path.relative_to(folder) for path in folder.glob("match_*.png")}
    stale |= {Path(name) for name in _OF_TRUTH}
    for path in files:
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        os.replace(made / path, folder / path)
    for path in stale - set(files):
        with contextlib.suppress(FileNotFoundError):
            (folder / path).unlink()


def _told(path: Path) -> dict[str, Any]:
    try:
        told = json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise DataError(f"{path} is no report: {error}") from error
    if not isinstance(told, dict):
        raise DataError(f"{path} is no report: expected an object")
    return told
