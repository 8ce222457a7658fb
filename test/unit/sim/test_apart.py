"""Maps that were built apart show their places, and the stated motion lays them on each other."""

import math

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import FREE, GridSpec, OccupancyMap
from uw_dslam_ros2.core.mapping import OccupancyConfig, VehicleMapperConfig
from uw_dslam_ros2.core.metrics import align_points
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.maps.apart import ApartMap, apart_pair, different_pair, make_apart_map
from uw_dslam_ros2.sim.maps.pairs import is_right, pair_errors
from uw_dslam_ros2.sim.missions.mapped import MappedRun, map_run
from uw_dslam_ros2.sim.missions.mission import plan_mission, tiny_mission_config
from uw_dslam_ros2.sim.waters.places import make_canal, make_harbour, make_lake, make_symmetric
from uw_dslam_ros2.sim.waters.raster import grid_over, wall_mask
from uw_dslam_ros2.sim.waters.seasons import another_season, loose_objects
from uw_dslam_ros2.sim.waters.world import Surface, WorldBuilder

_MAPPER = VehicleMapperConfig(occupancy=OccupancyConfig(resolution_m=0.2))


def _placed_run(T_world_map, window, true_poses):
    """A map that knows the window [x_min, y_min, x_max, y_max] of the world, in its own frame."""
    x_min, y_min, x_max, y_max = window
    spec = GridSpec(
        0.5, round((y_max - y_min) / 0.5), round((x_max - x_min) / 0.5),
        T_world_map.inverse() @ SE2(x_min, y_min),
    )  # fmt: skip
    inverse = T_world_map.inverse()
    poses = [(inverse @ SE2.from_array(pose)).as_array() for pose in true_poses]
    return MappedRun(
        OccupancyMap(spec, np.full(spec.shape, FREE, np.int8)), np.array(poses), true_poses
    )


def _apart(window, T_world_map, site=("lake", 1, 0)):
    along = np.linspace(window[0], window[2], 30)
    across = window[1] + 5.0 + 2.0 * np.sin(along / 5.0)
    return ApartMap(
        site[0], site, 0,
        _placed_run(T_world_map, window, np.column_stack([along, across, 0.0 * along])),
    )  # fmt: skip


def test_a_quick_map_shows_the_walls_where_they_are():
    mission = plan_mission(tiny_mission_config(3))
    run = map_run(mission, 0, _MAPPER)
    walls = np.argwhere(run.map.values >= 65)
    assert len(walls) > 100
    start = align_points(run.poses[:, :2], run.true_poses[:, :2])
    spec = grid_over(mission.world, 0.2)
    distance = distance_transform_edt(~wall_mask(mission.world, spec)) * 0.2
    cells = spec.cells_of(start.apply(run.map.spec.centers_of(walls)))
    cells = cells[spec.contains(cells)]
    assert (distance[cells[:, 0], cells[:, 1]] < 1.0).mean() > 0.9


def test_a_map_is_the_same_each_time_and_another_for_every_vehicle():
    first, again, other = (make_apart_map("harbour", 7, number) for number in (0, 0, 1))
    assert np.array_equal(first.run.map.values, again.run.map.values)
    assert first.run.map.spec == again.run.map.spec
    assert first.site == other.site
    assert first.run.map.spec != other.run.map.spec
    with pytest.raises(InvalidInputError, match="kind is 'pond'"):
        make_apart_map("pond", 0, 0)


def test_maps_of_one_place_are_laid_on_each_other():
    T_a, T_b = SE2(3.0, -2.0, 1.1), SE2(-7.0, 5.0, -2.4)
    source, target = _apart((0.0, 0.0, 40.0, 20.0), T_a), _apart((30.0, 0.0, 70.0, 20.0), T_b)
    pair = apart_pair(source, target)
    assert pair.overlap == pytest.approx(0.25, abs=0.04)
    expected = T_b.inverse() @ T_a
    assert pair.T_target_source is not None
    assert pair_errors(pair, expected)[0] < 1e-6
    # In the middle of what both know, which is (35, 10) in the world.
    assert T_a.apply(np.array(pair.middle_m)) == pytest.approx([35.0, 10.0], abs=0.6)
    assert is_right(pair, expected @ SE2(0.5, 0.0, 0.0))
    assert not is_right(pair, expected @ SE2(2.0, 0.0, 0.0))
    turned = SE2(yaw=math.radians(5.0))
    assert not is_right(pair, expected @ turned)


def test_a_bend_widens_the_tolerance():
    straight = _apart((0.0, 0.0, 40.0, 20.0), SE2())
    run = straight.run
    bent_poses = run.poses + np.column_stack([0.0 * run.poses[:, 0], 0.5 * np.sin(run.poses[:, 0]),
                                              0.0 * run.poses[:, 0]])  # fmt: skip
    bent = ApartMap("lake", ("lake", 1, 0), 0, MappedRun(run.map, bent_poses, run.true_poses))
    plain, wide = (apart_pair(straight, one).tolerance_m for one in (straight, bent))
    assert plain is not None
    assert wide is not None
    assert plain == pytest.approx(0.3 + 2 * 0.5)
    assert 0.2 < wide - plain < 0.5


def test_maps_that_share_nothing_have_no_answer():
    source, target = _apart((0, 0, 20, 20), SE2()), _apart((50, 0, 70, 20), SE2())
    assert apart_pair(source, target).T_target_source is None
    elsewhere = _apart((0, 0, 20, 20), SE2(), ("twin", 4, 2))
    assert different_pair(_apart((0, 0, 20, 20), SE2(), ("twin", 4, 1)), elsewhere).kind == "twin"
    assert different_pair(source, elsewhere).kind == "any"


def test_loose_objects_are_closed_outlines():
    builder = WorldBuilder()
    wall = Surface("wall", 0.0, 0.0)
    builder.add(wall, [[0, 0], [10, 0], [10, 10]])
    builder.add(wall, [[2, 2], [3, 2], [3, 3]], is_closed=True)
    builder.add(wall, [[5, 5], [6, 5], [6, 6]], is_closed=True)
    world = builder.build("made up", 0, (1.0, 1.0), 8.0)
    assert [index.tolist() for index in loose_objects(world)] == [[2, 3, 4], [5, 6, 7]]


@pytest.mark.parametrize("make", [make_harbour, make_lake])
def test_in_another_season_little_has_changed(make):
    world = make(11, width_m=80.0)
    later = another_season(world, np.random.default_rng(0))
    before, after = (set(map(tuple, one.segments.tolist())) for one in (world, later))
    objects = [{tuple(row) for row in world.segments[index].tolist()} for index in
               loose_objects(world)]  # fmt: skip
    changed = [outline for outline in objects if not outline <= after]
    assert 2 <= len(changed) <= 2 + 0.2 * len(objects)
    gone = before - after
    assert gone == set().union(*changed)  # the quays stand
    assert max(len(outline) for outline in changed) > 10  # of a hull
    assert len(later.segments) < len(world.segments)


def test_twins_have_one_outline():
    first, second = (make_harbour(3, width_m=80.0, twin=number) for number in (1, 2))
    assert not np.array_equal(first.segments[: len(second.segments)], second.segments)
    spec = grid_over(first, 0.5)
    walls = [wall_mask(world, spec) for world in (first, second)]
    west = np.zeros(spec.shape, bool)
    west[:, : round(9.0 / 0.5)] = True
    distance = distance_transform_edt(~walls[1])
    assert (distance[walls[0] & west] <= 2.0).mean() > 0.8


def test_a_symmetric_place_is_itself_after_half_a_turn():
    world = make_symmetric(5, 90.0)
    x_min, y_min, x_max, y_max = world.bounds
    turned = np.tile([x_min + x_max, y_min + y_max], 2) - world.segments

    def ends(segments):
        return sorted(np.round(segments, 6).tolist())

    assert ends(turned) == ends(world.segments)


def test_a_canal_is_long_and_straight():
    world = make_canal(1, 100.0)
    length = np.hypot(*(world.segments[:, 2:] - world.segments[:, :2]).T)
    is_along = np.abs(world.segments[:, 3] - world.segments[:, 1]) < 1e-9
    assert length[is_along].sum() > 120.0
