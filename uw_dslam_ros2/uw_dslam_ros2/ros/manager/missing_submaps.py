"""Submaps that were sent before anybody listened, or were lost: their mappers are asked."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.client import Client
from rclpy.node import Node
from rclpy.task import Future
from uw_dslam_msgs.msg import Submap as SubmapMsg
from uw_dslam_msgs.srv import GetSubmap

from uw_dslam_ros2.core.submap import SubmapId, Track, track_name
from uw_dslam_ros2.ros.plumbing.qos import SERVICES

__all__ = ["MissingSubmaps"]

_SERVICE = "get_submap"
_PATIENCE_S = 2.0  # what is on its way has come by then
_LOST_S = 10.0
_TIMEOUT_S = 10.0
# A sender that has never answered may not have discovered its asker: then its answers get lost.
_FIRST_TIMEOUT_S = 1.0
_MAX_TRIES = 3


@dataclass(slots=True, eq=False)
class _Asked:
    submap_id: SubmapId
    client: Client
    future: Future
    deadline_s: float


class MissingSubmaps:
    """Asks for what a run's sequence numbers show to be missing; one at a time of each run.

    All methods belong to one thread.

    Parameters
    ----------
    node
        Whose clients they are.
    post
        Hands a function to the thread that owns this object.
    on_submap
        Called with the topic and the message of each that was got.
    in_words
        Makes a sentence readable for people.
    """

    def __init__(
        self,
        node: Node,
        post: Callable[[Callable[[], None]], None],
        on_submap: Callable[[str, SubmapMsg], None],
        in_words: Callable[[str], str] = str,
    ) -> None:
        self._node, self._post, self._on_submap = node, post, on_submap
        self._in_words = in_words
        self._group = ReentrantCallbackGroup()
        self._clients: dict[str, Client] = {}
        self._patience_s: dict[Client, float] = {}
        self._topics: dict[Track, str] = {}
        self._since_s: dict[Track, float] = {}
        self._tries: Counter[SubmapId] = Counter()
        self._asked: dict[Track, _Asked] = {}
        self._missing: Mapping[Track, Sequence[int]] = {}
        self.lost = ""
        """What is missing and cannot be had; empty: nothing."""

    def note(self, topic: str, submap_id: SubmapId) -> None:
        """Remember on which topic a run's submaps come: its sender is asked for others."""
        self._topics[submap_id.track] = topic

    def look(self, missing: Mapping[Track, Sequence[int]]) -> None:
        """Ask for what is missing now."""
        now_s = time.monotonic()
        self._missing = missing
        self._since_s = {track: self._since_s.get(track, now_s) for track in missing}
        for track, asked in list(self._asked.items()):
            if now_s > asked.deadline_s:
                asked.client.remove_pending_request(asked.future)
                del self._asked[track]
                longer_s = 2.0 * self._patience_s[asked.client]
                self._patience_s[asked.client] = min(longer_s, _TIMEOUT_S)
        lost = []
        for track, sequences in missing.items():
            waited_s = now_s - self._since_s[track]
            if waited_s < _PATIENCE_S or track in self._asked:
                continue
            if not self._ask(track, sequences) and waited_s >= _LOST_S:
                lost.append(f"{track_name(track)}: {_ranges(sequences)}")
        text = f"submaps that never came and cannot be had: {'; '.join(lost)}" if lost else ""
        text = self._in_words(text)
        if text and text != self.lost:
            self._node.get_logger().warning(text)
        self.lost = text

    def values(self) -> dict[str, float | int | str]:
        """For the diagnostics."""
        return {"num_submaps_missing": sum(len(numbers) for numbers in self._missing.values())}

    def _ask(self, track: Track, sequences: Sequence[int]) -> bool:
        """Ask for the first that is worth it; False if there is none, or nobody to ask."""
        client = self._client(track)
        if client is None:
            return False
        for sequence in sequences:
            submap_id = SubmapId(*track, sequence)
            if self._tries[submap_id] < _MAX_TRIES:
                break
        else:
            return False
        patience_s = self._patience_s.setdefault(client, _FIRST_TIMEOUT_S)
        self._tries[submap_id] += patience_s >= _TIMEOUT_S
        request = GetSubmap.Request(
            vehicle_id=track.vehicle_id, run_id=track.run_id, sequence=sequence
        )
        future = client.call_async(request)
        self._asked[track] = _Asked(submap_id, client, future, time.monotonic() + patience_s)
        future.add_done_callback(lambda done: self._post(lambda: self._answered(track, done)))
        return True

    def _answered(self, track: Track, future: Future) -> None:
        asked = self._asked.get(track)
        if asked is None or asked.future is not future or future.cancelled():
            return  # given up before
        del self._asked[track]
        self._patience_s[asked.client] = _TIMEOUT_S
        response = future.result()
        if response is not None and response.result == GetSubmap.Response.DONE:
            self._on_submap(self._topics[track], response.submap)
        else:
            self._tries[asked.submap_id] = _MAX_TRIES
        # It is on its way into the queue: ask for the next one, not for the same.
        rest = [n for n in self._missing.get(track, ()) if n > asked.submap_id.sequence]
        if rest:
            self._ask(track, rest)

    def _client(self, track: Track) -> Client | None:
        """Of a node that sends the run's submaps and can be asked."""
        topic = self._topics.get(track)
        if topic is None:
            return None
        for info in self._node.get_publishers_info_by_topic(topic):
            name = f"{info.node_namespace.rstrip('/')}/{info.node_name}/{_SERVICE}"
            if name not in self._clients:
                self._clients[name] = self._node.create_client(
                    GetSubmap, name, qos_profile=SERVICES, callback_group=self._group
                )
            if self._clients[name].service_is_ready():
                return self._clients[name]
        return None


def _ranges(numbers: Sequence[int]) -> str:
    """0 to 3, 7."""
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][1] + 1:
            parts[-1][1] = number
        else:
            parts.append([number, number])
    return ", ".join(str(low) if low == high else f"{low} to {high}" for low, high in parts)
