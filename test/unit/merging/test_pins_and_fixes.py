"""Where people say that the frame is, and that the map lies on earth."""

import dataclasses
import math

import numpy as np
import pytest
from unit.merging.deciding import (
    FLEET,
    KNOWING,
    about,
    confirm,
    groups,
    id_of,
    remark_of,
    settled,
    undo,
)
from unit.merging.fleet import map_bytes

from uw_dslam_ros2.core.merging import (
    DecisionKind,
    MapQueue,
    SubmapState,
    planning,
)
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.maps.fleets import answer_all


def test_the_frame_goes_where_a_person_pins_it_and_back():
    queue = settled()
    before = map_bytes(queue)
    queue.decide(about(DecisionKind.PIN, id_of(2, 2)))
    poses = {r.submap.submap_id: (r.component, r.T_component_submap) for r in queue.submaps()}
    assert poses[id_of(2, 2)] == (0, SE2())
    assert any("as a person decided" in notice for notice in queue.take_notices())
    again = MapQueue.from_state(queue.to_state())
    assert map_bytes(again) == map_bytes(queue) != before
    again.decide(undo(1))
    answer_all(again, KNOWING)
    assert map_bytes(again) == before


@pytest.fixture
def liar(monkeypatch):
    """A queue in which the run of auv_1 is set aside; ``blamed`` holds it, for who forgives."""
    blamed = [id_of(1, 0).track]

    def blame(library, *_):
        return next((t for t in blamed if any(i.track == t for i in library.submaps)), None)

    monkeypatch.setattr(planning, "contradicting_track", blame)
    queue = settled()
    assert {r.state for r in queue.submaps()} == {SubmapState.SET_ASIDE, SubmapState.MERGED}
    return queue, blamed


def test_a_pin_on_what_is_set_aside_waits_and_the_others_keep_their_map(liar):
    queue, blamed = liar
    queue.decide(about(DecisionKind.PIN, id_of(1, 1)))
    answer_all(queue, KNOWING)
    assert {r.submap.vehicle_id for r in queue.submaps() if r.state is SubmapState.MERGED} == {
        "auv_2",
        "auv_3",
    }
    assert remark_of(queue, 1) == "waits: auv_1/1 is set aside"
    blamed.clear()
    queue.add_submap(dataclasses.replace(FLEET.submaps[id_of(1, 3)], revision=1))
    answer_all(queue, KNOWING)
    poses = {r.submap.submap_id: (r.component, r.T_component_submap) for r in queue.submaps()}
    assert poses[id_of(1, 1)] == (0, SE2())
    assert remark_of(queue, 1) == ""


@pytest.mark.parametrize("is_growing", [False, True])
def test_what_a_person_confirms_is_not_set_aside(liar, is_growing):
    queue, _ = liar
    queue.is_growing = is_growing
    queue.decide(confirm(id_of(1, 2), id_of(2, 1)))
    assert SubmapState.SET_ASIDE not in {r.state for r in queue.submaps()}
    assert groups(queue) == [["auv_1", "auv_2", "auv_3"]]
    if not is_growing:
        answer_all(queue, KNOWING)
        assert "auv_1 is in the map because of it, which contradicts" in remark_of(queue, 1)


def fix(submap_id, T_earth_map, queue, point=(0.0, 0.0), yaw=False, off=SE2(), **rest):
    """What somebody says who knows where the map lies on earth."""
    pose = next(r.T_component_submap for r in queue.submaps() if r.submap.submap_id == submap_id)
    x, y = (off @ T_earth_map @ pose).apply(np.array(point))
    values = {"sigma_m": 0.5, "sigma_rad": 0.02 if yaw else math.inf} | rest
    place = SE2(x, y, (T_earth_map @ pose).yaw)
    return about(
        DecisionKind.FIX, submap_id, point=point, place=place, earth_frame="EPSG:32632", **values
    )


def test_fixes_say_where_the_map_lies_on_earth():
    queue = settled()
    T_earth_map = SE2(512_345.6, 5_912_345.6, 2.5)
    queue.decide(fix(id_of(1, 0), T_earth_map, queue, point=(2.0, 1.0)))
    assert queue.georeference() is None
    assert "one more fix" in remark_of(queue, 1)
    queue.decide(fix(id_of(2, 1), T_earth_map, queue))
    found = queue.georeference()
    assert found.earth_frame == "EPSG:32632"
    metres, radians = found.T_earth_map.distance_to(T_earth_map)
    assert metres < 1e-3
    assert radians < 1e-5
    queue.decide(undo(2))
    assert queue.georeference() is None
    queue.decide(fix(id_of(3, 1), T_earth_map, queue, yaw=True))
    metres, radians = queue.georeference().T_earth_map.distance_to(T_earth_map)
    assert metres < 1e-3
    assert radians < 1e-5


def test_a_fix_that_the_others_contradict_is_told():
    queue = settled()
    T_earth_map = SE2(100.0, 200.0, -3.0)
    for submap_id in (id_of(1, 0), id_of(1, 3), id_of(2, 0), id_of(3, 2)):
        queue.decide(fix(submap_id, T_earth_map, queue))
    queue.decide(fix(id_of(3, 0), T_earth_map, queue, off=SE2(20.0, 0.0, 0.0)))
    assert remark_of(queue, 5).startswith("set aside, for the other fixes or the map contradict")
    assert "20.00 m off" in remark_of(queue, 5)
    assert queue.georeference().T_earth_map.distance_to(T_earth_map)[0] < 1e-3
    queue.decide(
        dataclasses.replace(fix(id_of(3, 0), T_earth_map, queue), earth_frame="EPSG:32633")
    )
    assert queue.georeference() is None
    assert "EPSG:32632 and in EPSG:32633" in remark_of(queue, 1)
