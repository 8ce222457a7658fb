"""Where vehicles began, where somebody knows it: priors for the matches of their maps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from uw_dslam_ros2.core.errors import ConfigError
from uw_dslam_ros2.core.registration.result import PriorWindow
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["StartPoses"]


@dataclass(frozen=True, slots=True)
class StartPoses:
    """Poses of the vehicles' own map frames in one frame that they share.

    Parameters
    ----------
    T_shared_vehicle
        By the vehicle's name; of the others nothing is known.
    half_width_m, half_width_rad
        How far each of them may be wrong, > 0.
    """

    T_shared_vehicle: dict[str, SE2]
    half_width_m: float
    half_width_rad: float

    @classmethod
    def of_texts(
        cls, texts: Sequence[str], half_width_m: float, half_width_rad: float
    ) -> StartPoses:
        """From settings: ``"robot1 2.5 -1.0 1.57"`` is name, x [m], y [m], yaw [rad].

        Raises
        ------
        ConfigError
            Naming the text that is not of this form, or the vehicle that is named twice.
        """
        poses: dict[str, SE2] = {}
        for text in texts:
            name, *numbers = text.split() or [""]
            try:
                x, y, yaw = (float(number) for number in numbers)
            except ValueError:
                x = y = yaw = math.nan
            if not name or not all(map(math.isfinite, (x, y, yaw))):
                raise ConfigError(
                    f"start_poses holds {text!r}, expected a vehicle, x [m], y [m], yaw [rad]"
                )
            if name in poses:
                raise ConfigError(f"start_poses names {name!r} twice, expected it once")
            poses[name] = SE2(x, y, yaw)
        return cls(poses, half_width_m, half_width_rad)

    def window(
        self, source: str, T_source_point: SE2, target: str, T_target_point: SE2
    ) -> PriorWindow | None:
        """Where a point of the source's map lies, seen from one of the target's; None: anywhere.

        Parameters
        ----------
        source, target
            Names of the vehicles.
        T_source_point, T_target_point
            The two points, each in its vehicle's own map frame.
        """
        poses = self.T_shared_vehicle
        if source not in poses or target not in poses or source == target:
            return None
        T_target_source = poses[target].inverse() @ poses[source]
        seen = T_target_source @ T_source_point
        # A wrong heading of either moves what is far from where the vehicle began.
        arms_m = math.hypot(T_source_point.x, T_source_point.y) + math.hypot(seen.x, seen.y)
        return PriorWindow(
            T_target_point.inverse() @ seen,
            2.0 * self.half_width_m + self.half_width_rad * arms_m,
            min(2.0 * self.half_width_rad, math.pi),
        )
