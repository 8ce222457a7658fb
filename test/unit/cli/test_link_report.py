"""What a report says of vehicles' own maps: the same only where all their cells are."""

import dataclasses

import pytest
from unit.merging.fleet import three_vehicles

from uw_dslam_ros2.cli.reporting.link_report import add_maps
from uw_dslam_ros2.cli.reporting.scoring import Truth
from uw_dslam_ros2.cli.running.demo_link import LinkedMission
from uw_dslam_ros2.core.merging import MapQueue, MapQueueConfig
from uw_dslam_ros2.io.sessions.session import save_session

FLEET = three_vehicles()
VEHICLES = ("auv_1", "auv_2")
MISSION = LinkedMission(VEHICLES, (), "sonar", None, "nano", 0.0, rate=1.0)


def queue_of(submap):
    queue = MapQueue()
    queue.add_submap(submap)
    return queue


@pytest.mark.parametrize("is_one_cell_different", [False, True])
def test_maps_are_the_same_cell_by_cell(tmp_path, is_one_cell_different):
    submap = FLEET.submaps["auv_1", 0, 0]
    values = submap.grid.values.copy()
    if is_one_cell_different:
        row, col = (values == 0).nonzero()
        values[row[0], col[0]] = 100
    other = dataclasses.replace(submap, grid=dataclasses.replace(submap.grid, values=values))
    for vehicle, own in zip(VEHICLES, (submap, other), strict=True):
        save_session(MISSION.session_folder(tmp_path, vehicle), queue_of(own))
    link = {"vehicles": {vehicle: {} for vehicle in VEHICLES}}
    notes = add_maps(link, MISSION, tmp_path, MapQueueConfig(), Truth({}, None))
    digests = [link["vehicles"][vehicle]["cells_digest"] for vehicle in VEHICLES]
    assert digests[0] == queue_of(submap).global_map().cells_digest()
    assert link["is_same_map"] == (not is_one_cell_different) == (digests[0] == digests[1])
    assert bool(notes) == is_one_cell_different
