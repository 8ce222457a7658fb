"""Walls as lines: what was drawn is found again."""

import numpy as np
import pytest

from uw_dslam_ros2.core.chart.lines import trace_walls
from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.se2 import SE2

RESOLUTION_M = 0.1


def drawn(cells, shape=(120, 160), pose=SE2()):
    values = np.zeros(shape, np.int8)
    for rows, cols in cells:
        values[rows, cols] = 100
    return OccupancyMap(GridSpec(RESOLUTION_M, *shape, pose), values)


def test_a_wall_is_a_line_of_its_length_width_and_place():
    (wall,), piers = trace_walls(drawn([(slice(40, 43), slice(20, 120))]))
    assert piers == []
    assert wall.length_m == pytest.approx(10.0, abs=0.3)
    assert wall.width_m == pytest.approx(0.3, abs=0.05)
    np.testing.assert_allclose(wall.points[:, 1], 4.15, atol=0.06)
    assert sorted(wall.points[:, 0])[0] == pytest.approx(2.0, abs=0.2)


def test_lines_lie_in_the_maps_frame():
    pose = SE2(100.0, -20.0, 0.5)
    cells = [(slice(40, 43), slice(20, 120))]
    (here,), _ = trace_walls(drawn(cells))
    (there,), _ = trace_walls(drawn(cells, pose=pose))
    np.testing.assert_allclose(there.points, pose.apply(here.points), atol=1e-9)


def test_a_pile_is_a_point_and_a_small_gap_no_gap():
    cells = [(slice(60, 62), slice(10, 60)), (slice(60, 62), slice(62, 130))]
    cells += [(slice(20, 25), slice(30, 35))]
    walls, (pier,) = trace_walls(drawn(cells), gap_m=0.3)
    assert len(walls) == 1
    assert (pier.x, pier.y) == pytest.approx((3.25, 2.25), abs=0.01)
    assert pier.width_m == pytest.approx(0.5)
    apart, _ = trace_walls(drawn(cells), gap_m=0.0)
    assert len(apart) == 2


def test_a_basin_is_a_ring_and_a_fork_joins_three_lines():
    ring = [(slice(10, 110), slice(20, 22)), (slice(10, 110), slice(138, 140))]
    ring += [(slice(10, 12), slice(20, 140)), (slice(108, 110), slice(20, 140))]
    walls, _ = trace_walls(drawn(ring))
    assert sum(wall.length_m for wall in walls) == pytest.approx(2 * (9.8 + 11.8), rel=0.03)
    fork = [(slice(60, 61), slice(10, 150)), (slice(20, 60), slice(80, 81))]
    walls, _ = trace_walls(drawn(fork))
    assert len(walls) == 3
    ends = np.vstack([wall.points[[0, -1]] for wall in walls])
    assert (np.hypot(*(ends - (8.05, 6.05)).T) < 0.25).sum() == 3


def test_a_wall_is_as_old_as_the_last_look_at_it():
    occupancy = drawn([(slice(40, 43), slice(20, 120)), (slice(80, 82), slice(30, 32))])
    ages = np.full(occupancy.values.shape, 5, np.int64)
    ages[41, 70] = 9
    (wall,), (pier,) = trace_walls(occupancy, lambda cells: ages[tuple(cells.T)])
    assert (wall.last_seen_ns, pier.last_seen_ns) == (9, 5)
    (wall,), (pier,) = trace_walls(occupancy)
    assert (wall.last_seen_ns, pier.last_seen_ns) == (None, None)


@pytest.mark.parametrize("width", [1, 2, 3, 6])
@pytest.mark.parametrize("angle", [0.0, 0.3, 0.9])
def test_a_width_does_not_depend_on_the_direction(width, angle):
    rows, cols = np.mgrid[:160, :160] - 80.0
    along = np.cos(angle) * cols + np.sin(angle) * rows
    across = np.cos(angle) * rows - np.sin(angle) * cols
    values = np.where((np.abs(across) <= width / 2) & (np.abs(along) < 50), 100, 0)
    occupancy = OccupancyMap(GridSpec(RESOLUTION_M, 160, 160, SE2()), values.astype(np.int8))
    walls, _ = trace_walls(occupancy)
    longest = max(walls, key=lambda wall: wall.length_m)
    seen = (values > 0).sum() / 100.0
    assert longest.width_m / RESOLUTION_M == pytest.approx(seen, rel=0.15)


def test_bends_are_kept_within_the_tolerance():
    shape = (120, 160)
    x = np.arange(10, 150)
    y = np.rint(60 + 25 * np.sin(x / 20.0)).astype(int)
    walls, _ = trace_walls(drawn([(slice(v, v + 4), u) for u, v in zip(x, y, strict=True)], shape))
    points = np.vstack([wall.points for wall in walls]) / RESOLUTION_M
    curve = 60 + 25 * np.sin(points[:, 0] / 20.0) + 2.0
    assert np.abs(points[:, 1] - curve).max() < 4.0
    assert sum(len(wall.points) for wall in walls) < 60


def test_nothing_gives_nothing_and_nonsense_is_refused():
    assert trace_walls(drawn([])) == ([], [])
    with pytest.raises(InvalidInputError, match=r"gap_m is -1\.0"):
        trace_walls(drawn([]), gap_m=-1.0)
