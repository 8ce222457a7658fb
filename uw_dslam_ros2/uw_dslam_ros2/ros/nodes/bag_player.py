"""Plays recordings, with /clock, for where ``ros2 bag play`` is not installed."""

from __future__ import annotations

import argparse
import functools
import heapq
import importlib
import sys
import threading
import time
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import fields
from typing import Any

from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.task import Future
from rclpy.utilities import remove_ros_args, try_shutdown
from rosgraph_msgs.msg import Clock as ClockMsg
from std_srvs.srv import SetBool

from uw_dslam_ros2.core.errors import ConfigError, DataError, UwDslamError
from uw_dslam_ros2.io.recordings import BagReader, RawMessage, open_bags
from uw_dslam_ros2.ros.convert.core_types import stamp_ns_from_msg, stamp_to_msg
from uw_dslam_ros2.ros.plumbing.node_settings import BagPlayerConfig
from uw_dslam_ros2.ros.plumbing.parameters import declare_config, refuse_unknown_parameters
from uw_dslam_ros2.ros.plumbing.playback import Pacer
from uw_dslam_ros2.ros.plumbing.qos import CLOCK, DEFAULT, PLAYBACK, STATIC_TF
from uw_dslam_ros2.ros.plumbing.running import init_ros

__all__ = ["BagPlayer", "BagPlayerConfig", "main"]

_STATIC = "/tf_static"
_OWN_TOPICS = ("/clock", "/rosout", "/parameter_events")
_SETTLED_S = 1.0
_MAX_HOLD_S = 20.0


class BagPlayer(Node):
    """Publishes the messages of bags as they were recorded; `finished` is set when all are out."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("bag_player", **kwargs)
        self._config = declare_config(self, BagPlayerConfig)
        refuse_unknown_parameters(self)
        if not self._config.bags:
            raise ConfigError("parameter bags is empty, expected at least one path")
        self.finished: Future = Future()
        self._stopped = threading.Event()
        self._pacer = Pacer(self._config.rate, time.monotonic, self._is_stopped)
        self._pacer.set_paused(self._config.is_paused)
        self._clock_pub = self.create_publisher(ClockMsg, "/clock", CLOCK)
        self._playing_pubs: dict[str, Publisher] = {}
        self._lags = _Lags(self._config.max_lag_s)
        self._last_clock_ns: int | None = None
        self.num_published = 0
        self.create_service(SetBool, "~/pause", self._on_pause)
        self._thread = threading.Thread(target=self._run, name="playback", daemon=True)
        self._thread.start()

    def destroy_node(self) -> None:
        """Stop playing, then destroy."""
        self._stopped.set()
        self._thread.join()
        super().destroy_node()

    def _is_stopped(self) -> bool:
        return self._stopped.is_set() or not self.context.ok()

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._pacer.set_paused(request.data)
        response.success = True
        response.message = "paused" if request.data else "playing"
        return response

    def _run(self) -> None:
        try:
            with open_bags(self._config.bags) as readers:
                summary = self._play(readers)
            self.get_logger().info(summary)
            self.finished.set_result(0)
        except UwDslamError as error:
            self.get_logger().fatal(str(error))
            self.finished.set_result(1)
        except Exception as error:  # noqa: BLE001 (a context that was shut down under us, most often)
            if not self._is_stopped():
                self.get_logger().fatal(f"{type(error).__name__}: {error}")
            self.finished.set_result(1)

    # --- playing -----------------------------------------------------------------------------

    def _play(self, readers: Sequence[BagReader]) -> str:
        topics = [self._playable(reader) for reader in readers]
        if not any(topics):
            raise DataError(f"nothing to play in {', '.join(self._config.bags)}")
        first_ns = min(reader.start_ns for reader in readers)
        start_ns = first_ns + int(self._config.start_s * 1e9)
        stop_ns = max(reader.end_ns for reader in readers) + 1
        if self._config.duration_s > 0.0:
            stop_ns = min(stop_ns, start_ns + int(self._config.duration_s * 1e9))
        if start_ns >= stop_ns:
            raise ConfigError(
                f"parameter start_s is {self._config.start_s}, expected less than the recording's "
                f"{(stop_ns - first_ns) * 1e-9:.1f} s"
            )
        self._create_publishers(readers, topics)
        self._publish_static(readers)
        self._wait_for_readers(topics)
        begun_s = time.monotonic()
        while not self._is_stopped():
            self._pacer.restart()
            self._last_clock_ns = None
            self._lags.clear()
            last: RawMessage | None = None
            for raw in _merged(readers, topics, start_ns, stop_ns):
                if not self._publish(raw):
                    break
                last = raw
            if last is not None and last.stamp_ns != self._last_clock_ns:
                self._tick(last.stamp_ns)  # the clock stands at the end, not at its last full step
            if not self._config.is_looping:
                break
        self._flush()
        seconds = time.monotonic() - begun_s
        recorded_s = ((self._last_clock_ns or start_ns) - start_ns) * 1e-9
        word = "stopped" if self._is_stopped() else "done"
        return (
            f"{word}: played {self.num_published} messages, "
            f"{recorded_s:.1f} s of recording, in {seconds:.1f} s"
        )

    def _playable(self, reader: BagReader) -> set[str]:
        """Topics of a bag that we can and shall publish."""
        if missing := [t for t in self._config.topics if t not in reader.topics]:
            self.get_logger().warning(f"{reader.path} has no topic {', '.join(missing)}")
        playable = set()
        for topic, msgtype in reader.topics.items():
            is_chosen = not self._config.topics or topic in self._config.topics
            if topic in _OWN_TOPICS or topic == _STATIC or not is_chosen:
                continue
            if message_class(msgtype) is None:
                self.get_logger().warning(
                    f"{topic} is left out: its type {msgtype} is not installed here"
                )
                continue
            playable.add(topic)
        return playable

    def _create_publishers(
        self, readers: Sequence[BagReader], topics: Sequence[Collection[str]]
    ) -> None:
        types: dict[str, str] = {}
        for reader, chosen in zip(readers, topics, strict=True):
            for topic in sorted(chosen):
                msgtype = reader.topics[topic]
                if types.setdefault(topic, msgtype) != msgtype:
                    raise DataError(
                        f"topic {topic} has type {types[topic]} in one bag "
                        f"and {msgtype} in {reader.path}"
                    )
        for topic, msgtype in types.items():
            self._playing_pubs[topic] = self.create_publisher(
                message_class(msgtype), topic, PLAYBACK
            )
        if self._config.max_lag_s > 0.0:
            for vehicle in sorted({namespace_of(topic) for topic in types} - {""}):
                heard = functools.partial(self._on_odometry, vehicle)
                self.create_subscription(Odometry, f"/{vehicle}/odom", heard, DEFAULT)

    def _on_odometry(self, vehicle: str, msg: Odometry) -> None:
        self._lags.heard(vehicle, stamp_ns_from_msg(msg.header.stamp))

    def _publish_static(self, readers: Sequence[BagReader]) -> None:
        """Fixed transforms hold from the beginning, wherever the playing begins."""
        msgtype = "tf2_msgs/msg/TFMessage"
        publisher = self.create_publisher(message_class(msgtype), _STATIC, STATIC_TF)
        self._playing_pubs[_STATIC] = publisher
        sent: set[bytes] = set()
        for reader in readers:
            if reader.topics.get(_STATIC) == msgtype:
                for raw in reader.raw([_STATIC]):
                    if raw.data not in sent:
                        sent.add(bytes(raw.data))
                        publisher.publish(bytes(raw.data))

    def _publish(self, raw: RawMessage) -> bool:
        """Send one message when it is due; False when stopped."""
        if not self._pacer.wait_for(raw.stamp_ns):
            return False
        vehicle = namespace_of(raw.topic)
        self._hold_for_followers(vehicle)
        self._advance_clock(raw.stamp_ns)
        publisher = self._playing_pubs[raw.topic]
        publisher.publish(bytes(raw.data))
        self._lags.sent(vehicle, raw.stamp_ns)
        self.num_published += 1
        return True

    def _advance_clock(self, stamp_ns: int) -> None:
        last_ns = self._last_clock_ns
        if last_ns is None or stamp_ns - last_ns >= 1e9 / self._config.clock_hz:
            self._tick(stamp_ns)

    def _tick(self, stamp_ns: int) -> None:
        self._clock_pub.publish(ClockMsg(clock=stamp_to_msg(stamp_ns)))
        self._last_clock_ns = stamp_ns

    def _hold_for_followers(self, vehicle: str) -> None:
        if not self._lags.is_behind(vehicle):
            return
        since_s = time.monotonic()
        while self._lags.is_behind(vehicle) and not self._is_stopped():
            if time.monotonic() - since_s > _MAX_HOLD_S:
                self.get_logger().warning(
                    f"/{vehicle}/odom has not moved for {_MAX_HOLD_S:.0f} s; playing on",
                    throttle_duration_sec=_MAX_HOLD_S,
                )
                self._lags.forgive(vehicle)
                break
            self._lags.wait(0.05)
        self._pacer.restart()

    # --- before and after --------------------------------------------------------------------

    def _wait_for_readers(self, topics: Sequence[Collection[str]]) -> None:
        """Wait until the wanted topics, and one of every bag, are read, and no reader comes."""
        begun_s = changed_s = time.monotonic()
        counts: dict[str, int] = {}
        while not self._is_stopped():
            now_s = time.monotonic()
            found = {t: p.get_subscription_count() for t, p in self._playing_pubs.items()}
            if found != counts:
                counts, changed_s = found, now_s
            is_ready = all(counts.get(topic, 0) > 0 for topic in self._config.wait_for) and all(
                any(counts[topic] for topic in chosen) for chosen in topics if chosen
            )
            if is_ready and now_s - changed_s >= _SETTLED_S:
                return
            if now_s - begun_s >= self._config.wait_s:
                unread = sorted(topic for topic, count in counts.items() if count == 0)
                self.get_logger().warning(
                    f"nobody reads {', '.join(unread)} after {self._config.wait_s:.0f} s; "
                    "playing anyway"
                )
                return
            self._stopped.wait(0.05)

    def _flush(self) -> None:
        if self._last_clock_ns is not None and not self._is_stopped():
            self._clock_pub.publish(ClockMsg(clock=stamp_to_msg(self._last_clock_ns)))
        for publisher in (*self._playing_pubs.values(), self._clock_pub):
            if not self._is_stopped():
                publisher.wait_for_all_acked(Duration(seconds=10))


class _Lags:
    """How far each vehicle's odometry is behind what was sent to it."""

    def __init__(self, max_lag_s: float) -> None:
        self._max_lag_ns = int(max_lag_s * 1e9)
        self._changed = threading.Condition()
        self._first_ns: dict[str, int] = {}
        self._sent_ns: dict[str, int] = {}
        self._heard_ns: dict[str, int] = {}

    def clear(self) -> None:
        """Forget all: the recording begins again."""
        with self._changed:
            for table in (self._first_ns, self._sent_ns, self._heard_ns):
                table.clear()

    def sent(self, vehicle: str, stamp_ns: int) -> None:
        """Note the stamp of what was last played of a vehicle."""
        with self._changed:
            self._first_ns.setdefault(vehicle, stamp_ns)
            self._sent_ns[vehicle] = stamp_ns

    def heard(self, vehicle: str, stamp_ns: int) -> None:
        """Note the stamp up to which a vehicle is mapped."""
        with self._changed:
            self._heard_ns[vehicle] = stamp_ns
            self._changed.notify_all()

    def forgive(self, vehicle: str) -> None:
        """Take a vehicle as caught up, since it has not moved for too long."""
        with self._changed:
            self._heard_ns[vehicle] = self._sent_ns[vehicle]

    def wait(self, timeout_s: float) -> None:
        """Until a vehicle is heard of, or the time is over."""
        with self._changed:
            self._changed.wait(timeout_s)

    def is_behind(self, vehicle: str) -> bool:
        """Whether a vehicle is mapped less far than the limit allows."""
        with self._changed:
            if self._max_lag_ns == 0 or vehicle not in self._sent_ns or not vehicle:
                return False
            heard_ns = self._heard_ns.get(vehicle, self._first_ns[vehicle])
            return self._sent_ns[vehicle] - heard_ns > self._max_lag_ns


def _merged(
    readers: Sequence[BagReader], topics: Sequence[Collection[str]], start_ns: int, stop_ns: int
) -> Iterator[RawMessage]:
    def numbered(index: int) -> Iterable[tuple[int, int, RawMessage]]:
        for raw in readers[index].raw(topics[index], start_ns, stop_ns):
            yield raw.stamp_ns, index, raw

    streams = [numbered(index) for index in range(len(readers)) if topics[index]]
    for _, _, raw in heapq.merge(*streams, key=lambda item: item[:2]):
        yield raw


def namespace_of(topic: str) -> str:
    """First part of a topic's name where it has several."""
    parts = topic.strip("/").split("/")
    return parts[0] if len(parts) > 1 else ""


def message_class(msgtype: str) -> Any:
    """Class of a message type (``sensor_msgs/msg/Imu``); None where its package is missing."""
    package, _, name = msgtype.replace("/msg/", "/").partition("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name, None)
    except ImportError:
        return None


def _overrides(arguments: Sequence[str]) -> list[Parameter]:
    """Command-line options as parameters: each setting has one."""
    parser = argparse.ArgumentParser(
        prog="bag_player", description=__doc__, epilog="ROS arguments follow --ros-args."
    )
    parser.add_argument("bags", nargs="*", help="rosbag2 folders, .mcap or .db3 files")
    for field in fields(BagPlayerConfig):
        if field.name == "bags":
            continue
        option = "--" + field.name.removeprefix("is_").replace("_", "-")
        kwargs: dict[str, Any] = {
            "dest": field.name,
            "help": field.metadata["doc"],
            "default": None,
        }
        if isinstance(field.default, bool):
            kwargs["action"] = "store_true"
        elif isinstance(field.default, tuple):
            kwargs["nargs"] = "+"
        else:
            kwargs["type"] = type(field.default)
        parser.add_argument(option, **kwargs)
    values = {k: v for k, v in vars(parser.parse_args(arguments)).items() if v not in (None, [])}
    return [Parameter(name, value=value) for name, value in values.items()]


def main(argv: Sequence[str] | None = None) -> int:
    """Play bags, then exit: 0 when all was played."""
    arguments = list(sys.argv if argv is None else argv)
    if not init_ros("bag_player", arguments):
        return 1
    node: BagPlayer | None = None
    try:
        node = BagPlayer(parameter_overrides=_overrides(remove_ros_args(arguments)[1:]))
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        executor.spin_until_future_complete(node.finished)
        return int(node.finished.result() or 0) if node.finished.done() else 0
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except UwDslamError as error:
        get_logger("bag_player").fatal(str(error))
        return 1
    finally:
        if node is not None:
            node.destroy_node()
        try_shutdown()
