"""Submaps to layers of bytes and back."""

import dataclasses

import numpy as np
import places
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.link import Layer, LayeredSubmap, encode_submap, read_outline
from uw_dslam_ros2.core.link.coding.cells import blocks_of_known, seen_free, with_walls
from uw_dslam_ros2.core.metrics import interpolate_poses, resample
from uw_dslam_ros2.core.mosaic import fuse_maps
from uw_dslam_ros2.core.se2 import SE2

COVARIANCE = np.array([[0.04, 0.01, 0.001], [0.01, 0.09, -0.002], [0.001, -0.002, 0.0004]])


def submap(**changes):
    whole = places.room_submap(
        "auv_1", sequence=7, revision=2, T_odom_submap=SE2(-123.456, 78.9, 2.5)
    )
    return dataclasses.replace(whole, covariance=COVARIANCE, **changes)


LAYERS = encode_submap(submap())


def received(last, key=b"", layers=LAYERS):
    held = LayeredSubmap(key)
    for layer, data in layers.items():
        if layer <= last:
            held.add(data)
    return held


def test_the_outline_alone_is_small_and_says_where_and_what_it_is():
    assert len(LAYERS[Layer.OUTLINE]) <= 56
    outline = read_outline(LAYERS[Layer.OUTLINE])
    assert (outline.sequence, outline.revision, outline.is_final) == (7, 2, True)
    off_m, off_rad = outline.T_odom_submap.distance_to(submap().T_odom_submap)
    assert off_m < 0.01
    assert off_rad < 1e-4
    # The room is 12 m x 8 m with its corner at (0.5, 0.5).
    assert outline.reach_m[0] == pytest.approx(12.5, abs=1.0)
    assert outline.reach_m[2] == pytest.approx(8.5, abs=1.0)
    assert outline.wall_length_m == pytest.approx(2 * (12 + 8) + 8, rel=0.3)
    assert outline.likeness(outline) == pytest.approx(outline.wall_length_m)


def test_an_outline_stays_small_far_away():
    far = submap(T_odom_submap=SE2(9_000.0, -9_000.0, -3.0))
    assert len(encode_submap(far)[Layer.OUTLINE]) <= 56


@pytest.mark.parametrize("layer", [Layer.COARSE, Layer.FINE])
def test_walls_with_no_free_water_near_are_sent_too(layer):
    spec, values = GridSpec(0.1, 120, 120), np.full((120, 120), -1, np.int8)
    values[12:48, 12:48] = 0
    values[81:84, 30:90] = 100  # three metres from what is free
    layers = encode_submap(submap(grid=OccupancyMap(spec, values)))
    got = received(layer, layers=layers).submap("auv_1").grid
    walls = got.spec.centers_of(np.argwhere(got.values > 50))
    assert walls.min(axis=0) == pytest.approx([3.0, 8.1], abs=0.2)
    assert walls.max(axis=0) == pytest.approx([9.0, 8.4], abs=0.2)


@pytest.mark.parametrize(("layer", "resolution_m"), [(Layer.COARSE, 0.3), (Layer.FINE, 0.1)])
def test_each_layer_shows_the_same_place(layer, resolution_m):
    got = received(layer).submap("auv_1")
    assert got.grid.spec.resolution_m == pytest.approx(resolution_m)
    assert got.revision == 4 * 2 + layer
    for values, is_there in (
        (got.grid.values > 50, lambda v: v > 50),
        ((got.grid.values >= 0) & (got.grid.values < 50), lambda v: v >= 0),
    ):
        points = got.grid.spec.centers_of(np.argwhere(values))
        cells = submap().grid.spec.cells_of(points)
        seen = submap().grid.values
        reach = 2  # cells of the room's own 0.1 m around
        found = [
            is_there(seen[max(0, r - reach) : r + reach + 1, max(0, c - reach) : c + reach + 1])
            for r, c in cells
        ]
        assert all(part.any() for part in found)
    share = (got.grid.values > 50).sum() * resolution_m / (2 * (12 + 8) + 8)
    assert 0.7 < share < 1.4  # walls are there, and about one cell wide


def test_there_is_no_submap_before_both_outline_and_cells():
    held = LayeredSubmap()
    held.add(LAYERS[Layer.COARSE])
    assert held.submap("auv_1") is None
    held.add(LAYERS[Layer.OUTLINE])
    assert held.submap("auv_1").sequence == 7


def test_a_finer_layer_needs_the_one_below():
    held = received(Layer.OUTLINE)
    with pytest.raises(InvalidInputError, match="FINE builds on none"):
        held.add(LAYERS[Layer.FINE])
    assert held.cells is None


def test_walls_told_exactly_leave_free_space_on_the_side_that_was_seen():
    # Known before: free, a wall three cells thick, nothing. Next to a wall nothing is told.
    known = np.array([[1, 1, 2, 2, 2, 0, 0]] * 3, np.int8)
    walls = np.zeros((3, 7), bool)
    walls[:, 2] = True
    np.testing.assert_array_equal(with_walls(known, walls), [[1, 0, 2, 0, 0, 0, 0]] * 3)
    walls = np.roll(walls, 2, axis=1)
    np.testing.assert_array_equal(with_walls(known, walls), [[1, 1, 1, 0, 2, 0, 0]] * 3)


def test_free_water_is_told_where_whole_blocks_are_known_and_not_behind_walls():
    cells = np.zeros((12, 12), np.int8)
    cells[1:12, 0:12] = 1
    np.testing.assert_array_equal(blocks_of_known(cells)[:, 2], [False, *[True] * 5])
    free = np.ones((9, 9), bool)
    free[:, 6] = False  # a wall; behind it a strip of two cells
    np.testing.assert_array_equal(seen_free(free)[4], [*[True] * 6, *[False] * 3])


def test_finer_layers_show_the_walls_that_the_map_has():
    values = submap().grid.values
    got = received(Layer.FINE).submap("auv_1").grid
    is_wall = resample(got, submap().grid.spec) > 50
    assert np.mean(is_wall[values > 50]) > 0.95
    assert np.mean(values[is_wall] > 50) > 0.95


@pytest.mark.parametrize("layer", [Layer.COARSE, Layer.FINE])
def test_a_wall_outlives_the_free_water_of_one_other_submap_and_not_of_two(layer):
    water = np.where(submap().grid.values > 50, np.int8(0), submap().grid.values)
    bare = submap(grid=OccupancyMap(submap().grid.spec, water))
    walls, free = (
        received(layer, layers=encode_submap(one)).submap("auv_1").grid for one in (submap(), bare)
    )
    lattice = GridSpec(walls.spec.resolution_m, 1, 1)
    for num_free in (1, 2):
        fused = fuse_maps(lattice, [(walls, SE2()), *[(free, SE2())] * num_free], 8.0)
        is_wall = resample(fused, walls.spec) > 60
        is_contested = (walls.values > 50) & (resample(free, walls.spec) >= 0)
        assert is_contested.sum() > 50
        assert is_wall[is_contested].all() == (num_free == 1)
        assert is_wall[is_contested].any() == (num_free == 1)


def test_a_pose_that_moved_costs_an_outline_and_no_cells():
    moved = submap(revision=3, T_odom_submap=SE2(5.0, 6.0, 0.5))
    held = received(Layer.FINE)
    layers = encode_submap(moved)
    assert layers[Layer.COARSE] == LAYERS[Layer.COARSE]
    held.add(layers[Layer.OUTLINE])
    got = held.submap("auv_1")
    assert (got.T_odom_submap.x, got.revision) == (pytest.approx(5.0), 4 * 3 + Layer.FINE)
    held.add(LAYERS[Layer.OUTLINE])  # an older one comes late
    assert held.submap("auv_1").T_odom_submap.x == pytest.approx(5.0)


def test_sender_and_receiver_have_the_same_bytes():
    a, b = received(Layer.FINE).submap("a"), received(Layer.FINE).submap("a")
    assert a.grid.values.tobytes() == b.grid.values.tobytes()
    assert a.trajectory.tobytes() == b.trajectory.tobytes()


@given(
    st.lists(st.floats(-1.0, 1.0), min_size=9, max_size=9),
    st.floats(1e-4, 1e3),
)
def test_any_covariance_stays_one_and_is_never_much_smaller(numbers, scale):
    root = scale * np.array(numbers).reshape(3, 3)
    covariance = root @ root.T
    got = received(Layer.COARSE, layers=encode_submap(submap_with(covariance))).outline.covariance
    np.testing.assert_array_equal(got, got.T)
    assert np.linalg.eigvalsh(got)[0] >= -1e-9 * np.abs(got).max()
    # What it grows by is an eighth of an octave, in deviations; tiny ones are 10 micrometres.
    before, after = np.sqrt(np.diag(covariance)), np.sqrt(np.diag(got))
    assert (after >= before * (1 - 1e-6)).all()
    assert (after <= np.maximum(before * 1.1, 1.1e-5)).all()


def submap_with(covariance):
    tiny = OccupancyMap(GridSpec(0.1, 6, 6), np.zeros((6, 6), np.int8))
    return dataclasses.replace(submap(), covariance=covariance, grid=tiny)


def test_the_path_is_where_it_was(rng):
    time_s = np.sort(rng.uniform(0.0, 60.0, 150))
    path = np.column_stack(
        [10 * np.cos(time_s / 8) - 10, 10 * np.sin(time_s / 8), time_s / 8 + np.pi / 2]
    )
    stamps_ns = (time_s * 1e9).astype(np.int64) + 1_700_000_000 * 10**9
    path[:, 2] = (path[:, 2] + np.pi) % (2 * np.pi) - np.pi
    got = received(
        Layer.COARSE,
        layers=encode_submap(submap(trajectory=path, trajectory_stamp_ns=stamps_ns)),
    ).submap("auv_1")
    truth, is_known = interpolate_poses((stamps_ns, path), got.trajectory_stamp_ns)
    assert is_known.sum() > 55  # each second
    off = (got.trajectory - truth)[is_known]
    assert np.abs(off[:, :2]).max() < 0.15
    assert np.sqrt(np.mean(off[:, :2] ** 2)) < 0.04
    assert np.abs((off[:, 2] + np.pi) % (2 * np.pi) - np.pi).max() < 0.15


def test_a_vehicle_that_never_moved_has_a_path_too():
    still = submap(trajectory=np.zeros((1, 3)), trajectory_stamp_ns=np.array([5_000_000_000]))
    got = received(Layer.COARSE, layers=encode_submap(still)).submap("auv_1")
    assert got.trajectory_stamp_ns.tolist() == [5_000_000_000]
    none = submap(trajectory=np.empty((0, 3)), trajectory_stamp_ns=np.empty(0, np.int64))
    got = received(Layer.COARSE, layers=encode_submap(none)).submap("auv_1")
    assert got.trajectory.shape == (0, 3)


def test_a_map_without_anything_known_can_be_sent():
    empty = OccupancyMap(GridSpec(0.05, 40, 30), np.full((40, 30), -1, np.int8))
    got = received(Layer.FINE, layers=encode_submap(submap(grid=empty)))
    assert not got.submap("auv_1").grid.known.any()


@pytest.mark.parametrize(
    "spec", [GridSpec(0.1, 90, 130, SE2(3.0, -2.0, 0.7)), GridSpec(1 / 12, 90, 130)]
)
def test_turned_grids_and_odd_cells_are_drawn_anew(spec):
    turned = OccupancyMap(spec, places.room_map().values)
    got = received(Layer.COARSE, layers=encode_submap(submap(grid=turned))).submap("auv_1")
    walls = got.grid.spec.centers_of(np.argwhere(got.grid.values > 50))
    cells = spec.cells_of(walls)
    near = [turned.values[max(0, r - 5) : r + 6, max(0, c - 5) : c + 6] for r, c in cells]
    assert len(near) > 50
    assert all((part > 50).any() for part in near)


def test_large_cells_stay_as_they_are():
    large = OccupancyMap(GridSpec(0.25, 90, 130), places.room_map().values)
    got = received(Layer.FINE, layers=encode_submap(submap(grid=large)))
    assert got.submap("auv_1").grid.spec.resolution_m == pytest.approx(0.25)


# --- damage ----------------------------------------------------------------------------------


def content(held):
    got = held.submap("auv_1")
    return None if got is None else (
        repr((got.sequence, got.revision, got.T_odom_submap, got.grid.spec)).encode()
        + got.grid.values.tobytes() + got.trajectory.tobytes() + got.covariance.tobytes()
    )  # fmt: skip


@given(st.sampled_from(list(Layer)), st.data())
def test_what_is_damaged_is_refused_and_changes_nothing(layer, data):
    damaged = bytearray(LAYERS[layer])
    way = data.draw(st.sampled_from(["flip", "cut", "longer"]))
    if way == "flip":
        at = data.draw(st.integers(0, 8 * len(damaged) - 1))
        damaged[at // 8] ^= 1 << at % 8
    elif way == "cut":
        del damaged[data.draw(st.integers(0, len(damaged) - 1)) :]
    else:
        damaged += data.draw(st.binary(min_size=1, max_size=8))
    held = received(Layer(layer - 1)) if layer else LayeredSubmap()
    before = content(held)
    try:
        held.add(bytes(damaged))
    except InvalidInputError:
        assert content(held) == before
    else:  # a code's last bits may not count: then the cells are those that were sent
        assert content(held) == content(received(layer))


@given(st.binary(max_size=200))
def test_noise_is_refused(data):
    with pytest.raises(InvalidInputError):
        LayeredSubmap().add(data)


def test_another_version_is_refused():
    other = bytes([LAYERS[Layer.COARSE][0] + 4]) + LAYERS[Layer.COARSE][1:]
    with pytest.raises(InvalidInputError, match="version of the codec is 6, expected 5"):
        LayeredSubmap().add(other)


def test_who_does_not_know_the_key_cannot_make_a_layer():
    held = LayeredSubmap(b"ours")
    for layer in (Layer.OUTLINE, Layer.COARSE):
        with pytest.raises(InvalidInputError):
            held.add(LAYERS[layer])
        held.add(encode_submap(submap(), b"ours")[layer])
    assert held.submap("auv_1") is not None


def test_a_submap_too_large_is_refused_by_name():
    values = np.zeros((3000, 10), np.int8)
    large = OccupancyMap(GridSpec(0.1, 3000, 10), values)
    with pytest.raises(InvalidInputError, match="expected at most 2000 a side"):
        encode_submap(submap(grid=large))
