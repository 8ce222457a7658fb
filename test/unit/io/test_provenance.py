"""Who saw what: against asking each cell, and there and back through a file."""

import tracemalloc

import cv2
import numpy as np
import pytest
from unit.merging.fleet import three_vehicles

from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging import MapQueue
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap
from uw_dslam_ros2.io.maps.provenance import read_provenance, write_provenance
from uw_dslam_ros2.sim.maps.fleets import KnowingMatcher, answer_all

FLEET = three_vehicles(num_submaps=3)


def settled(order=1) -> MapQueue:
    queue = MapQueue()
    ids = sorted(FLEET.submaps)
    for submap_id in [ids[0], *ids[1:][::order]]:
        queue.add_submap(FLEET.submaps[submap_id])
    answer_all(queue, KnowingMatcher(FLEET))
    return queue


def test_every_cell_names_the_submaps_that_saw_it():
    queue = settled()
    found = queue.provenance()
    fused = queue.global_map()
    assert found.spec == fused.spec
    np.testing.assert_array_equal(found.owners.dense() > 0, fused.known)
    assert found.contributors[0] == ()
    centres = found.spec.centers_of(np.argwhere(fused.known)[::97])
    cells = found.spec.cells_of(centres)
    for record in queue.submaps():
        grid, T_map_submap = record.submap.grid, record.T_component_submap
        inside = T_map_submap.inverse().apply(centres)
        own = grid.spec.cells_of(inside)
        # A cell's width from the rim of a submap's circle, rounding may decide either way.
        is_clear = np.abs(np.hypot(*inside.T) - FLEET.radius_m) > 2.0 * found.spec.resolution_m
        expected = grid.spec.contains(own)
        expected[expected] = grid.known[own[expected, 0], own[expected, 1]]
        named = [record.submap.submap_id in found.of_cell(*cell) for cell in cells]
        np.testing.assert_array_equal(np.array(named)[is_clear], expected[is_clear])


def test_provenance_does_not_depend_on_the_order_and_counts_dissent():
    one, other = settled(1).provenance(), settled(-1).provenance()
    assert one.contributors == other.contributors
    np.testing.assert_array_equal(one.owners.dense(), other.owners.dense())
    number = one.contradictions.dense()
    np.testing.assert_array_equal(number, other.contradictions.dense())
    sizes = np.array([len(ids) for ids in one.contributors])[one.owners.dense()]
    assert (2 * number <= sizes).all()
    assert number.max() >= 1


def test_a_withdrawn_submap_is_named_no_more():
    queue = settled()
    queue.withdraw(("auv_2", 0, 1))
    named = {i for ids in queue.provenance().contributors for i in ids}
    assert named == set(FLEET.submaps) - {("auv_2", 0, 1)}


def test_what_is_written_is_read_again(tmp_path):
    provenance = settled().provenance()
    picture, archive = write_provenance(tmp_path / "map", provenance)
    again = read_provenance(archive)
    assert (again.spec, again.contributors) == (provenance.spec, provenance.contributors)
    np.testing.assert_array_equal(again.owners.dense(), provenance.owners.dense())
    np.testing.assert_array_equal(again.contradictions.dense(), provenance.contradictions.dense())
    pixels = cv2.imread(str(picture))[::-1]  # rows of a picture run from the top
    is_white = (pixels == 255).all(axis=2)
    seen, disputed = provenance.owners.dense() > 0, provenance.contradictions.dense() > 0
    np.testing.assert_array_equal(is_white, seen & ~disputed)
    archive.write_bytes(b"nothing")
    with pytest.raises(DataError, match="not a map's provenance"):
        read_provenance(archive)


def test_memory_goes_by_what_was_seen_and_not_by_the_box_around_it(tmp_path):
    values = np.full((200, 200), -1, np.int8)
    values[20:180, 20:180] = 0
    queue = MapQueue()
    for number in range(3):
        submap = Submap(
            vehicle_id="auv_1",
            sequence=number,
            revision=0,
            is_final=True,
            stamp_ns=1 + number * 10**11,
            T_odom_submap=SE2(150.0 * number, 150.0 * number),
            covariance=np.diag([1e-4, 1e-4, 1e-6]),
            grid=OccupancyMap(GridSpec(0.05, 200, 200), values),
        )
        queue.add_submap(submap)
    num_cells = np.prod(queue.changed_window()[0].shape)
    assert num_cells > 30_000_000
    tracemalloc.start()
    try:
        _, archive = write_provenance(tmp_path / "map", queue.provenance())
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    # What a few strips take; arrays of the box take six bytes of each cell.
    assert peak < num_cells
    again = read_provenance(archive)
    assert np.count_nonzero(again.owners.dense()) == 3 * 160**2
    assert again.contributors[1:] == tuple((("auv_1", 0, number),) for number in range(3))


def test_an_empty_queue_has_none():
    assert MapQueue().provenance() is None
