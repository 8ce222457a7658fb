"""Pairs of maps out of files, with the motions that their owner has checked."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.maps.files import read_map
from uw_dslam_ros2.sim.maps.pairs import MapPair

__all__ = ["PAIR_COLUMNS", "ListedPair", "read_pairs"]

PAIR_COLUMNS = ("source", "target", "place", "x_m", "y_m", "yaw_deg", "is_like_its_mirror")
"""Maps by their YAML files, beside the list; a name of the place, two of them with a space between
where the maps show two places; the motion of the source on the target, empty where they show
nothing in common; and "1" where the place looks alike in a mirror.
"""
_TOLERANCE_M = 0.75  # maps that were built apart are bent
_TOLERANCE_RAD = math.radians(6.0)


@dataclass(frozen=True, slots=True, eq=False)
class ListedPair:
    """A pair of a list, the place it shows, and whether the place looks alike in a mirror."""

    pair: MapPair
    place: str
    is_like_its_mirror: bool


def read_pairs(path: Path) -> Iterator[ListedPair]:
    """Pairs of a CSV file with `PAIR_COLUMNS`.

    Raises
    ------
    DataError
        For a list without these columns, or with a motion that is no number.
    """
    maps: dict[Path, OccupancyMap] = {}
    with path.open(newline="", encoding="utf-8") as file:
        rows = csv.DictReader(file)
        missing = [name for name in PAIR_COLUMNS if name not in (rows.fieldnames or ())]
        if missing:
            raise DataError(
                f"{path} has no column {missing[0]}, expected {', '.join(PAIR_COLUMNS)}"
            )
        for row in rows:
            files = [path.parent / row[name] for name in ("source", "target")]
            for one in files:
                if one not in maps:
                    maps[one] = read_map(one)
            source, target = (maps[one] for one in files)
            T_target_source = _motion(f"{path}, line {rows.line_num}", row)
            pair = MapPair(
                "listed", "real", 0.0, source, target, T_target_source,
                tolerance_m=_TOLERANCE_M, tolerance_rad=_TOLERANCE_RAD,
            )  # fmt: skip
            yield ListedPair(pair, row["place"], row["is_like_its_mirror"] == "1")


def _motion(where: str, row: dict[str, str]) -> SE2 | None:
    texts = [row[name] for name in ("x_m", "y_m", "yaw_deg")]
    if not any(texts):
        return None
    try:
        x, y, yaw_deg = map(float, texts)
    except ValueError as error:
        raise DataError(
            f"{where}: the motion is {' '.join(texts)!r}, expected three numbers or none"
        ) from error
    return SE2(x, y, math.radians(yaw_deg))
