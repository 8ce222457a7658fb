"""When a demo over acoustic links is over."""

from dataclasses import dataclass, field
from types import SimpleNamespace

import pytest

from uw_dslam_ros2.cli.running import demo_link
from uw_dslam_ros2.cli.running.demo_link import LinkedMission
from uw_dslam_ros2.cli.running.link_watch import Known

VEHICLES = ("auv_1", "auv_2")
SPIN_S, SETTLE_S = 0.5, 20.0


@dataclass
class Clock:
    now_s: float = 0.0


@dataclass
class Vehicle:
    """Its nodes as the demo sees them: all has come from `complete_s` on, all rests later."""

    clock: Clock
    complete_s: float
    rest_s: float
    settled_s: list[float] = field(default_factory=list)

    def spin(self):
        self.clock.now_s += SPIN_S

    def settle_queue(self):
        self.settled_s.append(self.clock.now_s)
        self.clock.now_s += SETTLE_S  # a busy machine

    @property
    def status(self):
        num = 2 if self.clock.now_s >= self.complete_s else 1
        submaps = [
            SimpleNamespace(vehicle_id=name, run_id=1, sequence=0, revision=2, state=0)
            for name in VEHICLES[:num]
        ]
        return SimpleNamespace(submaps=submaps)

    def diagnostics_of(self, node):
        rests = self.clock.now_s >= self.rest_s
        if node == "map_queue_manager":
            return {"is_settled": str(int(rests)), "map_digest": "aa"}
        open_items = "0" if rests else "2"
        names = "items to send", "items unconfirmed", "items lacking"
        return dict.fromkeys(names, open_items)


@pytest.fixture
def settled(monkeypatch):
    """``settled(complete_s, rest_s)``: vehicles, when it ended, and what it found."""

    def run(complete_s, rest_s):
        clock = Clock()
        monkeypatch.setattr(demo_link, "time", SimpleNamespace(monotonic=lambda: clock.now_s))
        vehicles = [Vehicle(clock, complete_s, rest_s) for _ in VEHICLES]
        one = demo_link._Run.__new__(demo_link._Run)
        one._mission = LinkedMission(VEHICLES, (), "sonar", None, "nano", 0.0, rate=1.0)
        one._controls, one._children, one._begun_s = [*vehicles, vehicles[0]], [], 0.0
        one._known = [Known(name) for name in VEHICLES]
        return vehicles, one._settle(0.0), clock.now_s

    return run


def test_it_is_over_when_all_has_rested_for_a_while(settled):
    vehicles, (complete_s, still_open), end_s = settled(30.0, 100.0)
    assert still_open == []
    assert 30.0 <= complete_s <= 30.0 + 3 * SPIN_S
    assert 100.0 + demo_link._REST_S <= end_s <= 100.0 + demo_link._REST_S + 6 * SPIN_S
    # Asked once, though that took longer than all have to rest.
    assert [len(v.settled_s) for v in vehicles] == [1, 1]
    assert all(at_s >= 30.0 for v in vehicles for at_s in v.settled_s)


def test_what_is_missing_when_time_is_up_is_told(settled):
    vehicles, (complete_s, still_open), _ = settled(30.0, 1e9)
    assert complete_s is not None
    assert "the queue of auv_2 is still registering" in still_open
    _, (complete_s, still_open), _ = settled(1e9, 1e9)
    assert complete_s is None
    assert still_open[0] == "not every vehicle has every submap"
    assert vehicles[0].settled_s != []
