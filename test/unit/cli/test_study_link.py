"""What the study of the link says of runs over it."""

from dataclasses import dataclass, replace

import pytest

from uw_dslam_ros2.cli.reporting.scoring import Truth
from uw_dslam_ros2.cli.studies import _link_joining as joining
from uw_dslam_ros2.cli.studies._finished import FinishedParts
from uw_dslam_ros2.cli.studies._fleet_missions import FleetMission
from uw_dslam_ros2.cli.studies._link_joining import Joining, Merged, known_by
from uw_dslam_ros2.core.merging import MapQueue
from uw_dslam_ros2.sim.maps.fleets import lawnmower_fleet
from uw_dslam_ros2.sim.missions.link_mission import LinkRun

SUBMAPS = {s.vehicle_id: s for s in lawnmower_fleet(2, 1, 0).submaps.values()}
ONE, TWO = sorted(SUBMAPS)


def at_layer(name, layer):
    return replace(SUBMAPS[name], revision=layer)


@pytest.fixture
def played():
    """The first vehicle knows the other's submap after 7 s coarsely, after 9 s finely."""
    run = LinkRun(5.0)
    run.known = {
        ONE: [(5.0, at_layer(ONE, 2)), (7.0, at_layer(TWO, 1)), (9.0, at_layer(TWO, 2))],
        TWO: [(4.0, at_layer(TWO, 2)), (8.0, at_layer(ONE, 1))],
    }
    return run


@pytest.mark.parametrize(
    ("at_s", "expected"),
    [
        (4.5, {}),
        (7.5, {TWO: 1}),
        (8.0, {ONE: 1, TWO: 1}),
        (9.0, {ONE: 1, TWO: 2}),
    ],
)
def test_what_all_know_is_what_the_one_has_who_has_least(played, at_s, expected):
    known = known_by(played, [ONE, TWO], at_s)
    assert {s.vehicle_id: s.revision for s in known} == expected


@dataclass(eq=False)
class Fake(Joining):
    """Joins two vehicles where all that is known is in that layer at least."""

    layer: int = 1

    def merged(self, submaps):
        is_joined = min(s.revision for s in submaps) >= self.layer
        return Merged(len(submaps) if is_joined else 1, 0.0)


@pytest.mark.parametrize(("layer", "expected"), [(1, 7.0), (2, 9.0), (3, None)])
def test_the_first_join_is_when_enough_is_known(played, layer, expected):
    mission = FleetMission("two", tuple(SUBMAPS.values()), Truth({}, None))
    assert Fake(mission, layer=layer).first_join_s(played, ONE) == expected


def test_a_part_is_made_once_and_anew_by_other_code(tmp_path):
    made = []

    def make():
        made.append(1)
        return {"rows": [{"kB": 1.5, "first_join_s": ""}]}

    for digest, num in (("a", 1), ("a", 1), ("b", 2)):
        found = FinishedParts(tmp_path / "cache", digest).get("demo 0, nano: 30% lost", make)
        assert found == {"rows": [{"kB": 1.5, "first_join_s": ""}]}
        assert len(made) == num


def test_a_question_is_searched_once(monkeypatch):
    fleet, asked = lawnmower_fleet(2, 2, 0), []

    def search(*_, **__):
        asked.append(1)
        return "an answer"

    monkeypatch.setattr(joining, "register_grids", search)
    mine = Joining(FleetMission("fleet", tuple(fleet.submaps.values()), Truth({}, None)))
    queue = MapQueue()
    for submap in fleet.submaps.values():
        queue.add_submap(submap)
    request = queue.next_requests(1)[0]
    assert mine._match(request) == mine._match(replace(request, request_id=99)) == "an answer"
    assert len(asked) == 1
    mine._match(replace(request, source=request.target))
    assert len(asked) == 2
