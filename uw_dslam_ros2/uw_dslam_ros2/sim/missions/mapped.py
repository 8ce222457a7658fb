"""Simulated vehicles through the real mapper at once, without a recording: maps in number."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.mapping import VehicleMapper, VehicleMapperConfig
from uw_dslam_ros2.sim.missions.mission import T_BASE_DVL, T_BASE_SONAR, Mission, PingMaker

__all__ = ["MappedRun", "map_run"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class MappedRun:
    """One vehicle's map in its odom frame, and its motion at its pings.

    ``poses`` (K, 3) [x, y, yaw] of base_link in odom as the mapper found them, ``true_poses`` (K,
    3) in the world.
    """

    map: OccupancyMap
    poses: FloatArray
    true_poses: FloatArray


def map_run(mission: Mission, vehicle: int, config: VehicleMapperConfig) -> MappedRun:
    """Map one vehicle of a mission; `InvalidInputError` where it makes no map."""
    run = mission.runs[vehicle]
    log, instruments = run.navigation, mission.config.instruments
    mapper = VehicleMapper(config, run.vehicle_id)
    maker = PingMaker(mission)
    velocity_covariance = instruments.dvl_noise_m_s**2 * np.eye(2)
    stamps = (log.imu_stamp_ns, log.dvl_stamp_ns, run.ping_motion.stamp_ns)
    kinds = np.repeat(np.arange(len(stamps)), [len(s) for s in stamps])
    indices = np.concatenate([np.arange(len(s)) for s in stamps])
    all_ns = np.concatenate(stamps)
    for place in np.lexsort((kinds, all_ns)):
        kind, index, stamp_ns = kinds[place], int(indices[place]), int(all_ns[place])
        if kind == 0:
            mapper.add_imu(
                stamp_ns,
                float(log.yaw_rad[index]),
                float(log.yaw_rate_rad_s[index]),
                math.sqrt(instruments.yaw_variance),
            )
        elif kind == 1:
            if np.isfinite(velocity := log.dvl_velocity_m_s[index]).all():
                mapper.add_velocity(stamp_ns, velocity, velocity_covariance, T_BASE_DVL)
        else:
            mapper.add_image(maker.ping(vehicle, index), T_BASE_SONAR)
    mapper.finish()
    stamps_ns, poses = mapper.trajectory()
    return MappedRun(mapper.vehicle_map(), poses, run.motion.at(stamps_ns).poses)
