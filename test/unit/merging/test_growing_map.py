"""Maps that grow as a whole, cut into submaps: what is given when, and that they merge."""

import math

import numpy as np
import pytest

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import UNKNOWN, GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging import GrowingMap, GrowingMapConfig, MapQueue, SubmapState
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.maps.fleets import Fleet, KnowingMatcher, answer_all, make_walls

WORLD = make_walls(90.0, 0.25, 3)
CONFIG = GrowingMapConfig(tile_m=10.0)
PATH = np.column_stack([np.linspace(20.0, 70.0, 51), np.full(51, 40.0)])


def drawn(path, T_world_map=SE2(), radius_m=9.0, origin=(0.0, 0.0), margin=0):
    """What a vehicle has seen from a path in the world, as a map in its own frame.

    The lattice begins at an origin of its own, as those of programs that draw a map anew do.
    """
    T_map_world = T_world_map.inverse()
    local = T_map_world.apply(path)
    corner = local.min(axis=0) - radius_m - margin + origin
    size = np.ceil((local.max(axis=0) + radius_m + margin - corner) / 0.25).astype(int)
    spec = GridSpec(0.25, int(size[1]), int(size[0]), SE2(*corner))
    cells = np.argwhere(np.ones(spec.shape, np.bool_))
    centers = T_world_map.apply(spec.centers_of(cells))
    near = np.zeros(len(cells), np.bool_)
    for point in path:
        near |= ((centers - point) ** 2).sum(axis=1) < radius_m**2
    seen = WORLD.spec.cells_of(centers)
    near &= WORLD.spec.contains(seen)
    values = np.full(spec.shape, UNKNOWN, np.int8)
    known = cells[near]
    values[known[:, 0], known[:, 1]] = WORLD.values[seen[near, 0], seen[near, 1]]
    return OccupancyMap(spec, values)


def ids(change):
    return [(submap.sequence, submap.revision) for submap in change.submaps]


def test_every_known_cell_is_in_one_tile_and_where_it_was():
    whole = drawn(PATH)
    growing = GrowingMap("robot", GrowingMapConfig(tile_m=10.0, min_change=0.85))
    first, rest = growing.update(whole, 5).submaps, growing.rest().submaps
    assert first
    assert rest
    submaps = [*first, *rest]
    total = 0
    for submap in submaps:
        known = np.argwhere(submap.grid.known)
        total += len(known)
        points = submap.T_odom_submap.apply(submap.grid.spec.centers_of(known))
        cells = whole.spec.cells_of(points)
        np.testing.assert_array_equal(
            submap.grid.values[known[:, 0], known[:, 1]], whole.values[cells[:, 0], cells[:, 1]]
        )
        middle = submap.T_odom_submap.as_array()
        assert np.abs(points - middle[:2]).max() <= 5.0
        assert (middle[:2] % 10.0).tolist() == [5.0, 5.0]
        assert submap.stamp_ns == 5
    assert total == np.count_nonzero(whole.known)
    assert [submap.sequence for submap in submaps] == list(range(len(submaps)))


def test_tiles_that_follow_each_other_are_neighbours():
    submaps = GrowingMap("robot", CONFIG).update(drawn(PATH), 0).submaps
    places = np.array([submap.T_odom_submap.as_array()[:2] for submap in submaps])
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert np.mean(steps < 15.0) > 0.8


def test_what_did_not_change_is_not_given_again():
    growing = GrowingMap("robot", CONFIG)
    assert growing.update(drawn(PATH), 0).submaps
    growing.rest()
    assert not growing.update(drawn(PATH), 1).submaps
    # The lattice moves by parts of a cell, and the outline grows by what is not known.
    for origin in ((0.1, 0.0), (-0.07, 0.21)):
        change = growing.update(drawn(PATH, origin=origin, margin=3), 2)
        assert not change.submaps
        assert not change.has_jumped
    assert not GrowingMap("robot", CONFIG).rest().submaps


def test_a_map_that_grows_gives_new_tiles_and_few_revisions():
    growing = GrowingMap("robot", CONFIG)
    given = []
    for end in range(1, len(PATH) + 1, 2):
        change = growing.update(drawn(PATH[:end]), end)
        assert not change.has_jumped
        given += ids(change)
    given += ids(growing.rest())
    assert not growing.rest().submaps
    num_tiles = len({sequence for sequence, _ in given})
    assert num_tiles == 14
    assert len(given) < 8 * num_tiles
    assert len(set(given)) == len(given)
    for sequence in range(num_tiles):
        revisions = [revision for number, revision in given if number == sequence]
        assert revisions == list(range(len(revisions)))


def test_a_map_that_jumps_says_so_and_gives_all_its_tiles_anew():
    growing = GrowingMap("robot", CONFIG)
    first = growing.update(drawn(PATH), 0)
    change = growing.update(drawn(PATH, T_world_map=SE2(2.0, 1.0, 0.05)), 1)
    assert not first.has_jumped
    assert change.has_jumped
    assert {s for s, r in ids(change) if r == 1} == {s for s, _ in ids(first)}


def test_a_tile_that_the_map_has_left_is_emptied():
    growing = GrowingMap("robot", CONFIG)
    growing.update(drawn(PATH), 0)
    change = growing.update(drawn(PATH[:20]), 1)
    emptied = [submap for submap in change.submaps if not submap.grid.known.any()]
    assert emptied
    assert not growing.update(drawn(PATH[:20]), 2).submaps


def test_it_goes_on_from_submaps_that_were_given_before():
    first = GrowingMap("robot", CONFIG)
    submaps = {submap.sequence: submap for submap in first.update(drawn(PATH[:30]), 0).submaps}
    again = GrowingMap("robot", CONFIG, submaps.values())
    assert not again.update(drawn(PATH[:30]), 1).submaps
    expected, found = (one.update(drawn(PATH), 2) for one in (first, again))
    assert ids(found) == ids(expected)
    assert min(sequence for sequence, revision in ids(found) if revision == 0) == len(submaps)


def test_a_grid_with_a_turned_origin_is_the_same_map():
    plain = drawn(PATH)
    num_rows, num_cols = plain.spec.shape
    T_frame_grid = plain.spec.T_frame_grid @ SE2(0.25 * num_cols, 0.0, math.pi / 2)
    spec = GridSpec(0.25, num_cols, num_rows, T_frame_grid)
    turned = OccupancyMap(spec, np.ascontiguousarray(plain.values.T[::-1]))
    growing = GrowingMap("robot", CONFIG)
    growing.update(plain, 0)
    growing.rest()
    assert not growing.update(turned, 1).submaps


def test_a_map_that_is_too_large_is_refused_and_an_empty_one_is_nothing():
    growing = GrowingMap("robot", GrowingMapConfig(max_cells=100))
    with pytest.raises(InvalidInputError, match="121 cells, expected at most 100"):
        growing.update(OccupancyMap(GridSpec(0.1, 11, 11), np.zeros((11, 11), np.int8)), 0)
    empty = OccupancyMap(GridSpec(0.1, 10, 10), np.full((10, 10), UNKNOWN, np.int8))
    assert not growing.update(empty, 0).submaps


T_WORLD_MAP = {"robot_1": SE2(20.0, 40.0, 0.3), "robot_2": SE2(60.0, 44.0, 2.5)}


def paths_of_two():
    x = np.linspace(20.0, 70.0, 26)
    return {
        "robot_1": np.column_stack([x, np.full(26, 40.0)]),
        "robot_2": np.column_stack([x[::-1], np.full(26, 46.0)]),
    }


class Robots:
    """Growing maps of two robots into one queue, answered by who knows the truth."""

    def __init__(self):
        self.truth, self.queue = Fleet(WORLD), MapQueue()
        self.matcher = KnowingMatcher(self.truth)
        self.maps = {name: GrowingMap(name, CONFIG) for name in T_WORLD_MAP}
        self.T_world_map = dict(T_WORLD_MAP)

    def take(self, name, change):
        if change.has_jumped:
            self.queue.forget_answers(name)
        for submap in change.submaps:
            place = self.T_world_map[name] @ submap.T_odom_submap
            self.truth.T_world_submap[submap.submap_id] = place
            self.queue.add_submap(submap)

    def drive(self, *, is_growing):
        self.queue.is_growing = is_growing
        for end in range(2, 27, 4):
            for name, path in paths_of_two().items():
                whole = drawn(path[:end], self.T_world_map[name])
                self.take(name, self.maps[name].update(whole, end))
            answer_all(self.queue, self.matcher)

    def settle(self):
        self.queue.is_growing = False
        for name, growing in self.maps.items():
            self.take(name, growing.rest())
        answer_all(self.queue, self.matcher)

    def error_m(self):
        T_1, T_2 = (self.queue.T_map_odom(name) for name in T_WORLD_MAP)
        expected = self.T_world_map["robot_1"].inverse() @ self.T_world_map["robot_2"]
        return (T_1.inverse() @ T_2).distance_to(expected)


def test_maps_of_two_robots_become_one_while_they_grow():
    robots = Robots()
    robots.drive(is_growing=True)
    assert {record.state for record in robots.queue.submaps()} == {SubmapState.MERGED}
    num_growing = robots.matcher.num_asked
    robots.settle()
    assert {record.state for record in robots.queue.submaps()} == {SubmapState.MERGED}
    assert robots.error_m()[0] < 0.5
    assert num_growing < 40


def test_a_map_that_jumps_is_placed_anew():
    robots = Robots()
    robots.drive(is_growing=True)
    robots.settle()
    T_map_new = SE2(3.0, -2.0, 0.4)
    robots.T_world_map["robot_2"] = T_WORLD_MAP["robot_2"] @ T_map_new
    whole = drawn(paths_of_two()["robot_2"], robots.T_world_map["robot_2"])
    robots.take("robot_2", robots.maps["robot_2"].update(whole, 99))
    assert robots.queue.T_map_odom("robot_2") is None, "nothing is believed of it now"
    robots.settle()
    assert robots.error_m()[0] < 0.5
