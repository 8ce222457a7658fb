"""How good a result is, against a truth folder: the numbers of report.json."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from uw_dslam_ros2.cli.reporting.outcome import Trajectory
from uw_dslam_ros2.core.errors import DataError, InvalidInputError
from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.metrics import (
    MapError,
    TrajectoryError,
    compare_maps,
    map_sharpness,
    trajectory_error,
)
from uw_dslam_ros2.io.maps.files import read_map
from uw_dslam_ros2.io.trajectories import read_tum

__all__ = ["Scores", "Truth", "read_truth", "score"]

WALL_TOLERANCE_M = 0.25
"""How far a wall may be from its true place and still count as found."""


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Where the vehicles really were, and what is really there (None: nobody knows)."""

    trajectories: dict[str, Trajectory]
    map: OccupancyMap | None


def read_truth(path: str | Path) -> Truth:
    """Read a folder with ``<vehicle>.tum`` files and perhaps ``map.yaml``, or one TUM file.

    Raises
    ------
    DataError
        If there is nothing of that kind, or a file is broken.
    """
    path = Path(path)
    if path.is_dir():
        files = sorted(path.glob("*.tum"))
        if not files:
            raise DataError(f"{path} holds no .tum file; expected one for each vehicle")
        has_map = (path / "map.yaml").exists()
        return Truth(
            {file.stem: read_tum(file) for file in files},
            read_map(path / "map.yaml") if has_map else None,
        )
    if not path.exists():
        raise DataError(f"{path} does not exist; expected a truth folder or a TUM file")
    return Truth({path.stem: read_tum(path)}, None)


@dataclass(frozen=True, slots=True, eq=False)
class Scores:
    """Errors against the truth; ``alone_rmse_m`` is each vehicle's own error before merging."""

    trajectory: TrajectoryError | None
    alone_rmse_m: dict[str, float]
    map: MapError | None
    sharpness: dict[str, float]
    without_truth: list[str]

    def to_dict(self) -> dict[str, Any]:
        """As in report.json: lengths in metres, angles in radians."""
        trajectory = None
        if self.trajectory is not None:
            error = self.trajectory
            trajectory = {
                "rmse_m": error.rmse_m,
                "median_m": error.median_m,
                "max_m": error.max_m,
                "rmse_rad": error.rmse_rad,
                "num_poses": error.num_poses,
                "rmse_m_by_vehicle": error.per_vehicle_rmse_m,
                "T_truth_map": error.T_truth_map.as_array().tolist(),
            }
        return {
            "trajectory": trajectory,
            "rmse_m_of_each_vehicle_alone": self.alone_rmse_m,
            "map": None
            if self.map is None
            else {**asdict(self.map), "wall_tolerance_m": WALL_TOLERANCE_M},
            "sharpness": self.sharpness,
            "vehicles_without_truth": self.without_truth,
        }


def score(
    global_map: OccupancyMap | None,
    trajectories: Mapping[str, Trajectory],
    own_trajectories: Mapping[str, Trajectory],
    truth: Truth | None,
) -> Scores:
    """Compare a result with the truth; without a truth only the map's sharpness is known.

    Parameters
    ----------
    trajectories
        Of the merged vehicles, in the global frame.
    own_trajectories
        Of all vehicles, each in a frame of its own.
    """
    sharpness = {} if global_map is None else asdict(map_sharpness(global_map))
    if truth is None:
        return Scores(None, {}, None, sharpness, sorted(own_trajectories))
    known = {name: t for name, t in trajectories.items() if name in truth.trajectories}
    missing = sorted(set(own_trajectories) - set(truth.trajectories))
    error = None
    if known:
        error = trajectory_error(known, truth.trajectories)
    map_error = None
    if truth.map is not None and global_map is not None and error is not None:
        map_error = compare_maps(
            global_map, truth.map, error.T_truth_map, tolerance_m=WALL_TOLERANCE_M
        )
    alone = {
        name: _alone_rmse_m(name, trajectory, truth)
        for name, trajectory in sorted(own_trajectories.items())
        if name in truth.trajectories
    }
    return Scores(error, alone, map_error, sharpness, missing)


def _alone_rmse_m(name: str, trajectory: Trajectory, truth: Truth) -> float:
    try:
        return trajectory_error({name: trajectory}, truth.trajectories).rmse_m
    except InvalidInputError:  # no pose within the truth's time span
        return math.nan
