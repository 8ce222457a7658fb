"""Occupancy grids: the sensor model against a slow one, sums in any order, growth on a lattice."""

import itertools
import math

import numpy as np
import pytest

from uw_dslam_ros2.core.grid import MAX_MAP_SIDE, UNITS_PER_NAT, GridSpec
from uw_dslam_ros2.core.mapping.config import OccupancyConfig
from uw_dslam_ros2.core.mapping.drawing.grid_kernels import beam_table, diamond
from uw_dslam_ros2.core.mapping.drawing.occupancy import GrowingGrid
from uw_dslam_ros2.core.mapping.section import ClosedSection
from uw_dslam_ros2.core.mapping.vehicle_map import VehicleMap
from uw_dslam_ros2.core.mosaic import fuse_maps
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar import Detections

pytestmark = pytest.mark.kernels

CONFIG = OccupancyConfig(resolution_m=0.1, free_range_max_m=8.0)


def ping(ranges, bearings, beamwidth=0.05, weight=1.0, stamp_ns=0):
    ranges, bearings = np.asarray(ranges, float), np.asarray(bearings, float)
    is_echo = np.isfinite(ranges)
    r, b = ranges[is_echo], bearings[is_echo]
    points = np.column_stack([r * np.cos(b), r * np.sin(b)])
    free = np.where(is_echo, ranges, 3.0)
    return Detections(
        stamp_ns, points, np.full(len(points), weight), bearings, free, beamwidth, 0.03
    )


def random_ping(rng):
    bearings = np.linspace(-0.9, 0.9, 37)
    ranges = rng.uniform(1.5, 7.0, 37)
    ranges[rng.random(37) < 0.2] = np.inf
    return ping(ranges, bearings, weight=rng.uniform(0.2, 1.0))


def log_odds_at(grid, x, y):
    part = grid.trimmed()
    row = math.floor(y / part.resolution_m) - part.row
    col = math.floor(x / part.resolution_m) - part.col
    if not (0 <= row < part.log_odds.shape[0] and 0 <= col < part.log_odds.shape[1]):
        return None
    return part.log_odds[row, col] / UNITS_PER_NAT if part.observed[row, col] else None


def wall_ping(x, bearings, rng=None, sigma=0.0, **kwargs):
    """A flat wall across the x axis."""
    noise = 0.0 if rng is None else rng.normal(0.0, sigma, len(bearings))
    return ping(x / np.cos(bearings) + noise, bearings, **kwargs)


def test_target_to_port_is_mapped_to_port():
    grid = GrowingGrid(CONFIG)
    # The vehicle looks north; 5 m away, 30 degrees to port, is north-west.
    grid.add(ping([5.0], [math.pi / 6]), SE2(10.0, 20.0, math.pi / 2))
    x, y = 10.0 - 2.5, 20.0 + 4.330127
    assert 0.2 * CONFIG.hit_log_odds < log_odds_at(grid, x, y) < CONFIG.hit_log_odds
    assert log_odds_at(grid, 10.0 - 1.25, 20.0 + 2.165) == pytest.approx(-CONFIG.free_log_odds)
    assert log_odds_at(grid, 10.0 + 2.5, y) is None
    beyond = 6.0 / 5.0
    assert log_odds_at(grid, 10.0 - 2.5 * beyond, 20.0 + 4.33 * beyond) is None


def test_free_water_is_what_the_obvious_loop_says(rng):
    pose = SE2(1.3, -0.7, 0.6)
    bearings = np.sort(rng.uniform(-1.0, 1.0, 25))
    found = ping(np.full(25, np.inf), bearings, beamwidth=0.08)
    grid = GrowingGrid(CONFIG)
    grid.add(found, pose)
    wrong = checked = 0
    for x, y in itertools.product(np.arange(-3.95, 6.0, 0.1), repeat=2):
        lx, ly = pose.inverse().apply([x, y])
        away = np.abs(bearings - math.atan2(ly, lx))
        margin = abs(away.min() - 0.75 * 0.08), abs(math.hypot(lx, ly) - (3.0 - 0.15))
        if min(margin) < 2e-3:  # on the edge, where the table's steps decide
            continue
        is_free = away.min() < 0.75 * 0.08 and math.hypot(lx, ly) < 3.0 - 0.15
        checked += 1
        wrong += (log_odds_at_fast(grid, x, y) is not None) != is_free
    assert checked > 9000
    assert wrong == 0


def log_odds_at_fast(grid, x, y, cache={}):  # noqa: B006 (a cache)
    if cache.get("grid") is not grid:
        cache.clear()
        cache.update(grid=grid, part=grid.trimmed())
    part = cache["part"]
    row = math.floor(y / part.resolution_m) - part.row
    col = math.floor(x / part.resolution_m) - part.col
    inside = 0 <= row < part.log_odds.shape[0] and 0 <= col < part.log_odds.shape[1]
    return True if inside and part.observed[row, col] else None


def test_diamond_angle_rises_with_the_angle():
    angles = np.linspace(-math.pi + 1e-6, math.pi - 1e-6, 5000)
    values = np.array([diamond(math.cos(a), math.sin(a)) for a in angles])
    assert (np.diff(values) > 0.0).all()
    assert values.min() >= -2.0
    assert values.max() <= 2.0


def test_beams_behind_the_sonar_have_their_directions():
    table = beam_table(np.array([math.pi - 0.01, 0.0]), 0.05, 4096)

    def slot(angle):
        return table[min(4095, int((diamond(math.cos(angle), math.sin(angle)) + 2.0) * 1024))]

    assert slot(math.pi - 0.03) == 0
    assert slot(-math.pi + 0.02) == 0  # across the seam
    assert slot(0.02) == 1
    assert slot(1.0) == -1


def test_order_of_pings_does_not_matter(rng):
    pings = [(random_ping(rng), SE2(*rng.uniform(-2, 2, 3))) for _ in range(8)]
    grids = []
    for order in (range(8), reversed(range(8)), rng.permutation(8)):
        grid = GrowingGrid(CONFIG)
        for i in order:
            grid.add(*pings[i])
        grids.append(grid.trimmed())
    for other in grids[1:]:
        assert (grids[0].row, grids[0].col) == (other.row, other.col)
        np.testing.assert_array_equal(grids[0].log_odds, other.log_odds)
        np.testing.assert_array_equal(grids[0].observed, other.observed)


def test_growth_moves_no_cell(rng):
    near, far = random_ping(rng), random_ping(rng)
    grid = GrowingGrid(CONFIG)
    grid.add(near, SE2())
    before = grid.trimmed()
    grid.add(far, SE2(-200.0, 300.0, 1.0))
    after = grid.trimmed()
    rows = slice(before.row - after.row, before.row - after.row + before.log_odds.shape[0])
    cols = slice(before.col - after.col, before.col - after.col + before.log_odds.shape[1])
    np.testing.assert_array_equal(after.log_odds[rows, cols], before.log_odds)
    spec = after.to_occupancy(4.0).spec
    for value in (spec.T_frame_grid.x, spec.T_frame_grid.y):
        assert value / 0.1 == pytest.approx(round(value / 0.1), abs=1e-9)


def test_one_ping_counts_once_in_a_cell():
    # Twenty beams cross the cells near the sonar, and two echoes share a cell.
    grid = GrowingGrid(CONFIG)
    grid.add(ping(np.full(21, 2.0), np.linspace(-0.01, 0.01, 21), beamwidth=0.02), SE2(0, 0.05, 0))
    part = grid.trimmed()
    assert part.log_odds.min() == -round(CONFIG.free_log_odds * UNITS_PER_NAT)
    assert part.log_odds.max() <= round(CONFIG.hit_log_odds * UNITS_PER_NAT)


def test_weak_echo_stays_weak():
    strong, weak = GrowingGrid(CONFIG), GrowingGrid(CONFIG)
    strong.add(ping([3.0], [0.0], weight=1.0), SE2())
    weak.add(ping([3.0], [0.0], weight=0.2), SE2())
    assert log_odds_at(weak, 3.0, 0.0) == pytest.approx(
        0.2 * log_odds_at(strong, 3.0, 0.0), abs=2e-3
    )


def test_packing_loses_nothing(rng):
    grid = GrowingGrid(CONFIG)
    grid.add(random_ping(rng), SE2(3.0, 4.0, 1.0))
    part = grid.trimmed()
    again = part.compressed().decompressed()
    np.testing.assert_array_equal(part.log_odds, again.log_odds)
    np.testing.assert_array_equal(part.observed, again.observed)
    assert (part.row, part.col) == (again.row, again.col)


def test_percent_is_the_logistic_function():
    grid = GrowingGrid(CONFIG)
    for _ in range(3):
        grid.add(wall_ping(3.05, np.linspace(-0.4, 0.4, 81), beamwidth=0.02), SE2())
    part = grid.trimmed()
    found = part.to_occupancy(4.0)
    cell = tuple(found.spec.cells_of([[3.05, 0.05]])[0])
    # All along a wall each ping counts as one echo there.
    assert part.log_odds[cell] == pytest.approx(3 * CONFIG.hit_log_odds * UNITS_PER_NAT, rel=0.1)
    p = 1.0 / (1.0 + math.exp(-part.log_odds[cell] / UNITS_PER_NAT))
    assert found.values[cell] == round(100 * p)
    assert (found.values == -1).any()


def test_a_face_lies_where_noisy_echoes_heap_up(rng):
    """Thinner than they scatter, in the right place; before it water, behind it nothing."""
    config = OccupancyConfig(resolution_m=0.05, free_range_max_m=20.0)
    grid = GrowingGrid(config)
    bearings = np.linspace(-0.6, 0.6, 121)
    for y in np.linspace(-1.0, 1.0, 21):
        seen = wall_ping(6.0, bearings, rng, sigma=0.06, beamwidth=0.01)
        grid.add(seen, SE2(0.0, float(y), 0.0))
    part = grid.trimmed()
    rows = slice(*(int(y / 0.05) - part.row for y in (-2.0, 2.0)))
    columns = np.arange(part.log_odds.shape[1]) + part.col
    wall = part.observed[rows] & (part.log_odds[rows] > 0)
    assert wall.any(axis=1).all()
    assert wall.sum(axis=1).mean() < 3.0
    middle = (wall * (columns + 0.5)).sum(axis=1) / wall.sum(axis=1) * 0.05
    assert np.abs(middle - 6.0).mean() < 0.03
    assert (part.log_odds[rows, columns * 0.05 < 5.6] <= 0).all()
    assert not part.observed[rows, columns * 0.05 > 6.3].any()


def test_arcs_of_wide_beams_become_the_wall_that_they_touch(rng):
    config = OccupancyConfig(resolution_m=0.1, free_range_max_m=20.0)
    grid = GrowingGrid(config)
    for y in np.arange(-3.0, 3.01, 0.1):
        # The nearest point of the wall answers a beam of seven degrees, wherever it points.
        bearing = rng.uniform(-0.06, 0.06)
        grid.add(ping([6.03], [bearing], beamwidth=0.12), SE2(0.0, float(y), 0.0))
    part = grid.trimmed()
    rows = slice(*(int(y / 0.1) - part.row for y in (-2.0, 2.0)))
    columns = np.arange(part.log_odds.shape[1]) + part.col
    wall = part.observed[rows] & (part.log_odds[rows] > 0)
    assert wall.any(axis=1).mean() > 0.95
    where = np.broadcast_to((columns + 0.5) * 0.1, wall.shape)[wall]
    assert np.abs(where - 6.03).mean() < 0.1
    assert (np.abs(where - 6.03) > 0.2).mean() < 0.05


def test_a_weak_tail_behind_a_face_is_no_wall():
    config = OccupancyConfig(resolution_m=0.05, free_range_max_m=20.0)
    bearings = np.linspace(-0.4, 0.4, 81)
    grid = GrowingGrid(config)
    for number in range(10):
        x = 6.2 if number % 5 == 0 else 6.0
        grid.add(wall_ping(x, bearings, beamwidth=0.01), SE2())
    assert log_odds_at(grid, 6.02, 0.02) > 3.0
    assert log_odds_at(grid, 6.22, 0.02) is None


def test_a_wall_that_most_pings_missed_stays_where_they_count_for_less():
    config = OccupancyConfig(resolution_m=0.05, free_range_max_m=20.0)
    bearings = np.linspace(-0.4, 0.4, 81)
    for share, is_wall in ((1.0, False), (0.4, True)):
        grid = GrowingGrid(config, share_against=share)
        for number in range(8):
            grid.add(wall_ping(6.0 if number == 0 else 9.0, bearings, beamwidth=0.01), SE2())
        assert (log_odds_at(grid, 6.02, 0.02) > 0.0) == is_wall
        assert log_odds_at(grid, 5.02, 0.02) == pytest.approx(-8 * config.free_log_odds)


def test_a_compressed_grid_is_drawn_as_the_grid_itself(rng):
    grid = GrowingGrid(CONFIG)
    grid.add(random_ping(rng), SE2(3.0, 4.0, 1.0))
    part = grid.trimmed()
    direct = part.to_occupancy(4.0)
    for drawable in (part, part.compressed()):
        fused = fuse_maps(GridSpec(CONFIG.resolution_m, 1, 1), [(drawable, SE2())], 4.0)
        np.testing.assert_array_equal(fused.values, direct.values)
        off = fused.spec.T_frame_grid.distance_to(direct.spec.T_frame_grid)
        assert off == pytest.approx((0.0, 0.0), abs=1e-9)


def test_a_vehicles_map_leaves_out_what_would_make_it_too_large():
    grid = GrowingGrid(CONFIG)
    grid.add(ping([3.0], [0.0]), SE2())
    kept = grid.trimmed().compressed()
    away_m = CONFIG.resolution_m * MAX_MAP_SIDE

    def section(number, T_odom_issued):
        none = np.empty((0, 2)), np.empty(0), np.empty((0, 3)), np.empty(0, np.int64)
        return ClosedSection(number, 0, kept, *none, np.eye(3), np.eye(3), T_odom_issued)

    sections = [section(0, SE2()), section(1, SE2(away_m, 0.0)), section(2, SE2(5.0, 0.0))]
    vehicle_map = VehicleMap(CONFIG)
    for _ in range(2):  # what was left out once is not tried again and again, and not forgotten
        occupancy = vehicle_map.draw(sections, None, SE2())
        assert vehicle_map.num_left_out == 1
        assert max(occupancy.spec.shape) < 200
    sections[1].T_odom_issued = SE2(10.0, 0.0)
    assert max(vehicle_map.draw(sections, None, SE2()).spec.shape) > 100
    assert vehicle_map.num_left_out == 0
