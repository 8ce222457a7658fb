import math

import numpy as np
import pytest

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.sim.waters.world import NO_HIT, Surface, WorldBuilder, cast_rays

pytestmark = pytest.mark.kernels


def slow_range(segments, origin, angle, max_range):
    """One ray, one segment at a time, by a linear solve."""
    direction = np.array([math.cos(angle), math.sin(angle)])
    best = math.inf
    for x0, y0, x1, y1 in segments:
        start, edge = np.array([x0, y0]), np.array([x1 - x0, y1 - y0])
        matrix = np.column_stack([direction, -edge])
        if abs(np.linalg.det(matrix)) < 1e-12:
            continue
        r, u = np.linalg.solve(matrix, start - origin)
        if 0.0 < r <= max_range and 0.0 <= u <= 1.0:
            best = min(best, r)
    return best


def test_rays_equal_a_solve_for_every_segment(rng):
    segments = rng.uniform(-20.0, 20.0, (40, 4))
    angles = rng.uniform(-4.0, 4.0, 60)
    for origin in rng.uniform(-15.0, 15.0, (5, 2)):
        hits = cast_rays(segments, origin, angles, 12.0)
        expected = [slow_range(segments, origin, angle, 12.0) for angle in angles]
        np.testing.assert_allclose(hits.range_m, expected, rtol=1e-9)
        np.testing.assert_array_equal(hits.segment == NO_HIT, np.isinf(expected))


def test_literal_hits():
    # A wall across the way at x = 3, and one at 45 degrees behind the origin's left shoulder.
    segments = np.array([[3.0, -1.0, 3.0, 5.0], [-2.0, 0.0, 0.0, 2.0]])
    angles = np.radians([0.0, 45.0, 135.0, -90.0])
    hits = cast_rays(segments, (0.0, 0.0), angles, 10.0)
    root = math.sqrt(2.0)
    np.testing.assert_allclose(hits.range_m, [3.0, 3.0 * root, root, np.inf])
    assert hits.segment.tolist() == [0, 0, 1, NO_HIT]
    np.testing.assert_allclose(hits.cos_incidence, [1.0, 1.0 / root, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(hits.along_m[:3], [1.0, 4.0, root])


def test_wrong_shapes_are_named():
    with pytest.raises(InvalidInputError, match=r"origin has shape \(3,\)"):
        cast_rays(np.zeros((1, 4)), (0.0, 0.0, 0.0), [0.0], 1.0)


def test_builder_closes_outlines_and_keeps_surfaces():
    builder = WorldBuilder()
    steel, rock = Surface("steel", 0.0, 8.0), Surface("rock", -6.0, 0.0)
    builder.add(rock, [[0, 0], [1, 0], [0, 2]], is_closed=True)
    builder.add(steel, [[5, 5], [6, 5]])
    world = builder.build("test", 3, (4.0, 4.0), 8.0)
    assert world.segments.tolist()[2] == [0.0, 2.0, 0.0, 0.0]
    assert [world.surfaces[i].name for i in world.surface_of] == ["rock"] * 3 + ["steel"]
    assert world.bounds == (0.0, 0.0, 6.0, 5.0)
