"""A vehicle that stays over ground that it knows keeps little of each further hour."""

import math
import tracemalloc

import numpy as np

from uw_dslam_ros2.core.mapping import VehicleMapper, VehicleMapperConfig
from uw_dslam_ros2.core.mapping.config import MatchConfig, SubmapConfig
from uw_dslam_ros2.core.mapping.scans.local_map import LocalMap
from uw_dslam_ros2.core.se2 import SE2

_S = 1_000_000_000
_HALF_SIDE_M, _RADIUS_M, _SPEED_M_S = 12.0, 6.0, 2.0
_LAP_M = 2.0 * math.pi * _RADIUS_M


def _ranges(pose, bearings):
    """Distance to the walls of a square basin along each bearing."""
    angle = pose.yaw + bearings
    cos, sin = np.cos(angle), np.sin(angle)
    with np.errstate(divide="ignore"):
        along_x = (np.copysign(_HALF_SIDE_M, cos) - pose.x) / cos
        along_y = (np.copysign(_HALF_SIDE_M, sin) - pose.y) / sin
    return np.minimum(along_x, along_y)


def _held_at_each_submap(num_submaps):
    """Bytes that a mapper holds whenever a submap of one lap has just closed, and their size."""
    # A submap begins where the one before began: the open one is as large each time.
    lap = SubmapConfig(max_length_m=0.99 * _LAP_M, max_duration_s=1e4, max_sigma_m=100.0)
    config = VehicleMapperConfig(estimator="dead_reckoning", submap=lap)
    bearings, rng = np.linspace(-1.2, 1.2, 64), np.random.default_rng(0)
    rate = _SPEED_M_S / _RADIUS_M
    held, sizes = [], []
    tracemalloc.start()
    try:
        mapper, second = VehicleMapper(config, "auv_1"), 0
        while len(held) < num_submaps:
            stamp_ns, angle = second * _S, rate * second
            x, y = _RADIUS_M * math.cos(angle), _RADIUS_M * math.sin(angle)
            pose = SE2(x, y, angle + 0.5 * math.pi)
            mapper.add_imu(stamp_ns, pose.yaw, rate, 0.002)
            mapper.add_velocity(stamp_ns, [_SPEED_M_S, 0.0], np.eye(2) * 1e-4)
            ranges = _ranges(pose, bearings) + rng.normal(0.0, 0.02, len(bearings))
            for submap in mapper.add_scan(stamp_ns, bearings, ranges, 30.0, SE2()):
                mapper.vehicle_map()
                sizes.append(submap.grid.values.nbytes)
                held.append(tracemalloc.get_traced_memory()[0])
            second += 1
    finally:
        tracemalloc.stop()
    return held, sizes


def test_a_lap_adds_a_small_share_of_its_map():
    held, sizes = _held_at_each_submap(7)
    # The first laps make what all share: kernels, the vehicle's map.
    growth = (held[6] - held[2]) / 4.0
    assert growth < 0.15 * np.mean(sizes), f"{growth:.0f} bytes a lap; its map has {sizes} cells"
    # Four hours of such laps, a submap each, are 25 MB.
    assert growth < 60_000


def test_what_a_vehicle_at_rest_is_matched_with_does_not_grow():
    local_map, echoes = LocalMap(MatchConfig()), np.ones((10, 2))
    held = []
    tracemalloc.start()
    try:
        for num in range(4 * 720):  # four hours, a key ping every five seconds
            local_map.add(echoes + num, np.ones(10), SE2())
            if num in (1500, 2879):
                held.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert held[1] - held[0] < 10_000
