"""What is drawn again in part is what is drawn anew; work that repeats itself takes its share."""

import dataclasses

import numpy as np
import pytest
from unit.merging.fleet import three_vehicles

from uw_dslam_ros2.core.merging import SubmapRecord, SubmapState
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId
from uw_dslam_ros2.view.pace import Pace
from uw_dslam_ros2.view.showing import Showing

FLEET = three_vehicles()
TILES = [(zoom, col, row) for zoom in (-1, 1, 2) for col in range(-2, 4) for row in range(-3, 2)]


def records():
    first = FLEET.T_world_submap[SubmapId("auv_1", 0, 0)]
    return {
        i: SubmapRecord(
            submap, SubmapState.MERGED, 0, first.inverse() @ FLEET.T_world_submap[i], 1, ""
        )
        for i, submap in FLEET.submaps.items()
    }


def tiles(showing, moment=None):
    return [showing.tile(moment, *tile) for tile in TILES]


def changes():
    """One after the other: a submap moves, one goes, a group comes apart, one is sent again."""
    one, two, three = (SubmapId(f"auv_{k}", 0, 1) for k in (1, 2, 3))
    now = records()
    now[one] = dataclasses.replace(
        now[one], T_component_submap=now[one].T_component_submap @ SE2(0.7, 0.3, 0.1)
    )
    yield dict(now)
    now[two] = dataclasses.replace(now[two], state=SubmapState.WITHDRAWN)
    yield dict(now)
    for i in [i for i in now if i.vehicle_id == "auv_3"]:
        now[i] = dataclasses.replace(now[i], component=1)
    yield dict(now)
    grid = now[three].submap.grid
    fuller = dataclasses.replace(
        now[three].submap,
        revision=1,
        grid=dataclasses.replace(grid, values=np.ascontiguousarray(grid.values[::-1])),
    )
    now[three] = dataclasses.replace(now[three], submap=fuller)
    yield dict(now)


def test_a_state_that_follows_another_shows_what_it_shows_alone():
    showing = Showing(list(records().values()), [])
    assert sum(tile is not None for tile in tiles(showing)) > 5
    for now in changes():
        before = tiles(showing)
        showing = Showing(list(now.values()), [], before=showing)
        alone = Showing(list(now.values()), [])
        assert tiles(showing) == tiles(alone)
        assert tiles(showing) != before
        assert showing.scene() == alone.scene()


def test_fifty_groups_stand_side_by_side_and_fill_a_page():
    one = next(iter(records().values()))
    fleet = [
        SubmapRecord(
            dataclasses.replace(one.submap, vehicle_id=f"auv_{k}"),
            SubmapState.MERGED if k == 0 else SubmapState.WAITING,
            k,
            SE2(yaw=0.1 * k),
            0,
            "",
        )
        for k in range(50)
    ]
    showing = Showing(fleet, [])
    groups = showing.scene()["groups"]
    assert groups[0]["shift"] == [0.0, 0.0], "the global map stays where it is"
    boxes = np.array([group["bounds"] for group in groups])
    low, high = boxes[:, :2], boxes[:, 2:]
    for k in range(50):
        others = np.arange(50) != k
        apart = (low[k] >= high[others]) | (high[k] <= low[others])
        assert apart.any(axis=1).all(), f"group {k} lies on another"
    width, height = high.max(axis=0) - low.min(axis=0)
    assert 0.5 < width / height < 4.0, "no strip of which a page shows nothing"
    x_m, y_m = boxes[49, :2] + 0.5 * (high[49] - low[49])
    assert showing.cell(x_m, y_m)["group"] == 49


def test_going_back_in_time_leaves_the_newest_as_it_is():
    showing = Showing(list(records().values()), [])
    newest = tiles(showing)
    past = tiles(showing, 5)
    assert past != newest
    assert tiles(showing) == newest
    shown = sorted(records().values(), key=lambda r: (r.submap.stamp_ns, r.submap.submap_id))[:5]
    # In one frame: where the page has it does not depend on the time.
    assert past == tiles(Showing(shown, []))
    assert tiles(showing, 0) == [None] * len(TILES)


def test_time_goes_on_while_somebody_looks_back():
    all_records = sorted(records().values(), key=lambda r: (r.submap.stamp_ns, r.submap.submap_id))
    showing = Showing(all_records[:8], [])
    past = tiles(showing, 5)
    later = Showing(all_records, [], before=showing)
    assert later.num_moments == len(all_records)
    assert tiles(later, 5) == past


@pytest.mark.parametrize("spent_s", [0.01, 0.2, 0.6])
def test_a_share_of_a_core_is_kept(spent_s):
    pace, now_s, busy_s = Pace(0.25), 100.0, 0.0
    for _ in range(50):
        now_s += pace.wait_s(now_s)
        pace.begin(now_s)
        pace.spend(spent_s)
        busy_s += spent_s
        now_s += spent_s
    now_s += pace.wait_s(now_s)
    assert busy_s / (now_s - 100.0) == pytest.approx(0.25)
    pace.spend(1000.0)
    assert pace.wait_s(now_s) == 5.0
