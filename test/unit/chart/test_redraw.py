"""A run that has ended is drawn once more where its pings agree."""

import numpy as np
import pytest

from uw_dslam_ros2.core.chart.pings import KeptPings
from uw_dslam_ros2.core.chart.redraw import redrawn
from uw_dslam_ros2.core.mapping import VehicleMapper, VehicleMapperConfig
from uw_dslam_ros2.core.mapping.config import LoopConfig, SubmapConfig
from uw_dslam_ros2.core.metrics import align_points
from uw_dslam_ros2.core.mosaic import fuse_maps
from uw_dslam_ros2.core.se2 import SE2

_BEARINGS = np.linspace(-1.13, 1.13, 128)
_LOW, _HIGH = (0.0, 0.0), (30.0, 20.0)
_CONFIG = VehicleMapperConfig(
    estimator="dead_reckoning",
    submap=SubmapConfig(max_length_m=12.0, max_sigma_m=100.0),
    loop=LoopConfig(is_enabled=False),
)


def ranges_in_room(pose, rng):
    cos, sin = np.cos(pose[2] + _BEARINGS), np.sin(pose[2] + _BEARINGS)
    with np.errstate(divide="ignore"):
        ways = [(low - at) / d for low, at, d in zip(_LOW, pose, (cos, sin), strict=False)]
        ways += [(high - at) / d for high, at, d in zip(_HIGH, pose, (cos, sin), strict=False)]
    ways = np.where(np.array(ways) > 0.0, ways, np.inf)
    return ways.min(axis=0) + rng.normal(0.0, 0.03, len(_BEARINGS))


def there_and_back():
    x = np.concatenate([np.linspace(5.0, 25.0, 80), np.linspace(25.0, 5.0, 80)])
    return np.column_stack([x, np.full(160, 8.0), np.full(160, 0.3)])


def mapped(max_bytes=np.inf):
    """A finished mapper whose velocity log says that it drifts to the side, and its pings."""
    rng, kept = np.random.default_rng(1), KeptPings(max_bytes)
    mapper, poses = VehicleMapper(_CONFIG, "auv_1", watch=kept), there_and_back()
    for i, pose in enumerate(poses):
        stamp_ns = i * 500_000_000
        way = np.diff(poses[max(0, i - 1) : i + 1, :2], axis=0).sum(axis=0) / 0.5
        v_body = SE2(0.0, 0.0, pose[2]).inverse().apply(way) + np.array([0.0, 0.005])
        mapper.add_imu(stamp_ns, pose[2], 0.0, 0.002)
        mapper.add_velocity(stamp_ns, v_body, 1e-4 * np.eye(2))
        mapper.add_scan(stamp_ns, _BEARINGS, ranges_in_room(pose, rng), 40.0, SE2())
    mapper.finish()
    return mapper, kept, poses


def T_true_odom(mapper, true):  # noqa: N802 (a motion)
    return align_points(mapper.trajectory()[1][:, :2], true[:, :2])


def error_m(mapper, true):
    found = T_true_odom(mapper, true).apply(mapper.trajectory()[1][:, :2])
    return np.sqrt(((found - true[:, :2]) ** 2).sum(axis=1).mean())


def away_m(mapper, true):
    """How far wall cells lie from the room's walls, in the root of the mean square."""
    shown = mapper.vehicle_map()
    cells = np.argwhere(shown.values > 50)
    points = T_true_odom(mapper, true).apply(shown.spec.centers_of(cells))
    away = np.abs(np.hstack([points - _LOW, points - _HIGH])).min(axis=1)
    return np.sqrt((away**2).mean())


def drawn(submaps):
    placed = [(s.grid, s.T_odom_submap) for s in submaps]
    return fuse_maps(submaps[0].grid.spec, placed, 4.0)


def test_walls_and_path_become_truer():
    mapper, kept, true = mapped()
    before = mapper.submaps()
    error_before, away_before = error_m(mapper, true), away_m(mapper, true)
    after = redrawn(before, kept.of_submap, _CONFIG.occupancy)
    assert [s.submap_id for s in after] == [s.submap_id for s in before]
    assert [s.revision for s in after] == [s.revision + 1 for s in before]
    mapper.replace(after)
    assert error_m(mapper, true) < 0.5 * error_before
    assert away_m(mapper, true) < 0.5 * away_before


def test_a_mapper_goes_by_what_was_drawn_anew():
    mapper, kept, _ = mapped()
    mapper.vehicle_map()
    after = redrawn(mapper.submaps(), kept.of_submap, _CONFIG.occupancy)
    mapper.replace(after)
    for submap in after:
        again = mapper.issued(submap.sequence)
        assert again.revision == submap.revision
        assert again.T_odom_submap == submap.T_odom_submap
        assert again.grid.spec == submap.grid.spec
        np.testing.assert_array_equal(again.grid.values > 50, submap.grid.values > 50)
        np.testing.assert_array_equal(again.grid.known, submap.grid.known)
    last = SE2.from_array(mapper.trajectory()[1][-1])
    assert mapper.T_odom_base.distance_to(last) == pytest.approx((0.0, 0.0), abs=1e-9)
    summed, shown = drawn(after), mapper.vehicle_map()
    assert shown.spec.shape == summed.spec.shape
    assert ((shown.values > 50) == (summed.values > 50)).mean() > 0.999


def test_what_no_ping_is_kept_of_goes_along_with_what_was_before():
    mapper, kept, _ = mapped(max_bytes=100_000)
    before = mapper.submaps()
    whole = [s for s in before if s.submap_id in kept.of_submap]
    assert 0 < len(whole) < len(before)
    assert kept.num_left_out > 0
    after = redrawn(before, kept.of_submap, _CONFIG.occupancy)
    T_new_old = [
        b.T_odom_submap @ a.T_odom_submap.inverse() for a, b in zip(before, after, strict=True)
    ]
    for old, new, motion in zip(
        before[len(whole) :], after[len(whole) :], T_new_old[len(whole) :], strict=True
    ):
        assert new.grid is old.grid
        assert motion.distance_to(T_new_old[len(whole)]) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert kept.num_bytes < 105_000


def test_without_pings_there_is_nothing_to_draw():
    mapper, _, _ = mapped()
    assert redrawn(mapper.submaps(), {}, _CONFIG.occupancy) == []
    assert redrawn([], {}, _CONFIG.occupancy) == []
