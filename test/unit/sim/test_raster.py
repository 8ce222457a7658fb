import itertools

import numpy as np
import pytest

from uw_dslam_ros2.core.grid import GridSpec
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.waters.raster import grid_over, seen_map, wall_mask
from uw_dslam_ros2.sim.waters.world import Surface, WorldBuilder

pytestmark = pytest.mark.kernels

WALL = Surface("wall", 0.0, 0.0)


def world_of(*lines):
    builder = WorldBuilder()
    for line in lines:
        builder.add(WALL, line)
    return builder.build("test", 0, (0.0, 0.0), 8.0)


def test_wall_cells_of_a_small_grid():
    # Rows grow with y: the wall y = 0.5 is in row 0, the step at x = 2.5 goes up from there.
    world = world_of([[0.2, 0.5], [2.5, 0.5], [2.5, 2.5]])
    mask = wall_mask(world, GridSpec(1.0, 3, 4))
    assert mask.astype(int).tolist() == [[1, 1, 1, 0], [0, 0, 1, 0], [0, 0, 1, 0]]


def test_diagonal_walls_have_no_gaps(rng):
    points = rng.uniform(0.0, 10.0, (8, 2))
    spec = GridSpec(0.5, 20, 20)
    mask = wall_mask(world_of(points), spec)
    for start, end in itertools.pairwise(points):
        along = start + np.linspace(0.0, 1.0, 2000)[:, None] * (end - start)
        cells = spec.cells_of(along)
        assert mask[cells[:, 0], cells[:, 1]].all()


def test_what_lies_behind_a_wall_stays_unknown():
    # The sonar looks east; a short wall at x = 5 hides the middle of a long one at x = 8.
    world = world_of([[5.1, -1.0], [5.1, 1.0]], [[8.1, -6.0], [8.1, 6.0]])
    spec = GridSpec(0.2, 80, 60, SE2(-2.0, -8.0))
    seen = seen_map(world, spec, [[0.1, 0.1, 0.0]], np.radians(90.0), 10.0)

    def value(x, y):
        (cell,) = spec.cells_of(np.array([[x, y]]))
        return int(seen.values[tuple(cell)])

    assert value(5.1, 0.5) == 100
    assert value(3.0, 1.0) == 0
    assert value(6.5, 0.1) == -1  # in the shadow
    assert value(8.1, 0.1) == -1
    assert value(8.1, 4.5) == 100
    assert value(8.1, -4.5) == 100
    assert value(-1.0, 0.1) == -1  # behind the sonar
    assert value(1.0, 4.0) == -1  # outside the field of view
    assert value(9.0, 3.0) == -1


def test_grid_over_a_place_holds_it_on_the_lattice():
    world = world_of([[-3.33, 1.0], [7.77, 2.22]])
    spec = grid_over(world, 0.05)
    assert spec.contains(spec.cells_of(world.segments.reshape(-1, 2))).all()
    steps = np.array([spec.T_frame_grid.x, spec.T_frame_grid.y]) / 0.05
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6)
