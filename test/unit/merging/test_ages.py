"""When walls were last seen, by literal cells."""

import math

import numpy as np

from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging import SubmapRecord, SubmapState, last_seen_ns
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap


def record(sequence, values, T_map_submap, end_ns):
    grid = OccupancyMap(GridSpec(1.0, *np.shape(values), SE2()), np.array(values, np.int8))
    path = np.zeros((1 if end_ns else 0, 3))
    submap = Submap(
        "auv_1", sequence, 0, True, 0, SE2(), np.eye(3), grid,
        trajectory=path, trajectory_stamp_ns=np.full(len(path), end_ns, np.int64),
    )  # fmt: skip
    return SubmapRecord(submap, SubmapState.MERGED, 0, T_map_submap, 0, "")


def test_a_wall_is_as_young_as_the_last_submap_that_has_its_cell():
    spec, cells = GridSpec(1.0, 1, 5, SE2()), np.array([(0, col) for col in (0, 2, 3, 4)])
    records = [
        record(2, [[100, -1, 100]], SE2(), 9),
        record(0, [[100, 100, 100]], SE2(), 5),
        # Turned by a quarter: its column of cells lies along the map's row, at x = 2 to 4.
        record(1, [[0], [0], [-1]], SE2(5.0, 0.0, math.pi / 2.0), 7),
        record(3, [[100] * 5], SE2(), 0),
    ]
    # The turned submap knows cells 3 and 4 only.
    assert last_seen_ns(spec, records, cells).tolist() == [9, 9, 7, 7]
    assert last_seen_ns(spec, records[1:], cells).tolist() == [5, 5, 7, 7]
    assert last_seen_ns(spec, records[3:], cells).tolist() == [0] * 4
