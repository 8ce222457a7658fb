"""Whom a manager asks for submaps that never came, and how often."""

from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy")

from places import room_submap
from rclpy.task import Future
from uw_dslam_msgs.srv import GetSubmap

from uw_dslam_ros2.core.submap import SubmapId
from uw_dslam_ros2.ros.convert.core_types import submap_to_msg
from uw_dslam_ros2.ros.manager import missing_submaps
from uw_dslam_ros2.ros.manager.missing_submaps import MissingSubmaps

pytestmark = pytest.mark.ros

TOPIC = "/auv_1/submap"
NEWEST = SubmapId("auv_1", 0, 9)


class Mapper:
    """A mapper that can be asked; the first `num_lost` of its answers get lost."""

    def __init__(self, clock, num_lost=0, result=GetSubmap.Response.DONE):
        self.asked = []
        self._clock, self._num_lost, self._result = clock, num_lost, result
        self._sent = []

    def service_is_ready(self):
        return True

    def remove_pending_request(self, future):
        future.cancel()

    def call_async(self, request):
        self.asked.append((self._clock.now_s, request.sequence))
        future = Future()
        if len(self.asked) > self._num_lost:
            self._sent.append((future, request.sequence))
        return future

    def answer(self):
        """Send what waits, until nothing does."""
        while self._sent:
            future, sequence = self._sent.pop(0)
            msg = submap_to_msg(room_submap("auv_1", sequence))
            future.set_result(GetSubmap.Response(result=self._result, submap=msg))


class Asker:
    """`MissingSubmaps` with a mapper, in a time of its own."""

    def __init__(self, monkeypatch, missing, **how):
        self.now_s, self.got = 0.0, []
        monkeypatch.setattr(missing_submaps.time, "monotonic", lambda: self.now_s)
        self.mapper = Mapper(self, **how)
        publisher = SimpleNamespace(node_namespace="/auv_1", node_name="sonar_mapper")
        node = SimpleNamespace(
            get_publishers_info_by_topic=lambda _: [publisher],
            create_client=lambda *_, **__: self.mapper,
            get_logger=lambda: SimpleNamespace(warning=lambda _: None),
        )
        self.missing = MissingSubmaps(node, lambda job: job(), self._on_submap)
        self.missing.note(TOPIC, NEWEST)
        self._left = list(missing)

    def _on_submap(self, topic, msg):
        assert topic == TOPIC
        self.got.append(msg.sequence)
        self._left.remove(msg.sequence)

    def run(self, seconds):
        for _ in range(2 * seconds):
            self.missing.look({NEWEST.track: list(self._left)} if self._left else {})
            self.mapper.answer()
            self.now_s += 0.5


def test_all_are_got_one_after_the_other(monkeypatch):
    asker = Asker(monkeypatch, [2, 3, 7])
    asker.run(4)
    assert asker.got == [2, 3, 7]
    assert [sequence for _, sequence in asker.mapper.asked] == [2, 3, 7]


@pytest.mark.parametrize(("num_lost", "until_s"), [(1, 4), (3, 11)])
def test_answers_that_get_lost_while_a_mapper_discovers_who_asks_cost_seconds(
    monkeypatch, num_lost, until_s
):
    asker = Asker(monkeypatch, range(5), num_lost=num_lost)
    asker.run(until_s)
    assert asker.got == [0, 1, 2, 3, 4]
    assert len(asker.mapper.asked) == 5 + num_lost


def test_who_never_answers_is_asked_ever_more_rarely_and_told(monkeypatch):
    asker = Asker(monkeypatch, [4], num_lost=1000)
    asker.run(100)
    waits_s = [
        b[0] - a[0] for a, b in zip(asker.mapper.asked, asker.mapper.asked[1:], strict=False)
    ]
    assert waits_s == sorted(waits_s)
    assert waits_s[-1] > missing_submaps._TIMEOUT_S
    assert len(waits_s) < 8
    assert "auv_1: 4" in asker.missing.lost


def test_what_a_mapper_has_not_is_asked_once(monkeypatch):
    asker = Asker(monkeypatch, [4], result=GetSubmap.Response.NOT_FOUND)
    asker.run(30)
    assert len(asker.mapper.asked) == 1
    assert "auv_1: 4" in asker.missing.lost
