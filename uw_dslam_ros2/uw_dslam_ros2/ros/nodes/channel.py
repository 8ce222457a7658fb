"""The water between simulated acoustic modems, which may be on ROS domains of their own."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import Empty, UInt8MultiArray

from uw_dslam_ros2.core.errors import ConfigError
from uw_dslam_ros2.core.link.transport.channel import CHANNEL_PRESETS, ChannelConfig, SharedChannel
from uw_dslam_ros2.ros.plumbing.diagnostics import Diagnostics, Report
from uw_dslam_ros2.ros.plumbing.node_settings import ChannelNodeConfig
from uw_dslam_ros2.ros.plumbing.parameters import declare_config, refuse_unknown_parameters
from uw_dslam_ros2.ros.plumbing.qos import MODEM
from uw_dslam_ros2.ros.plumbing.running import run_node

__all__ = ["ChannelNode", "main"]

_TICK_S = 0.01
_MAX_DOMAIN = 232


@dataclass(slots=True)
class _Modem:
    """One vehicle's modem: what it may send now, and since when."""

    name: str
    position_m: tuple[float, float]
    turn_s: float = 0.0  # when its next turn begins
    is_open: bool = False  # whether it has been told that it is its turn
    waiting: deque[bytes] = field(default_factory=deque)
    node: Node | None = None
    received: Any = None
    ready: Any = None


class ChannelNode(Node):
    """Tells each modem when it may send, and brings what it sent to the others."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("channel", **kwargs)
        self._config = declare_config(self, ChannelNodeConfig)
        given = declare_config(self, ChannelConfig, "channel")
        refuse_unknown_parameters(self)
        self._channel_config = self._preset(given)
        names, domains = self._config.vehicles, self._config.domains
        if not names or (domains and len(domains) != len(names)):
            raise ConfigError(
                f"parameter vehicles has {len(names)} names and domains {len(domains)} numbers; "
                "expected at least one name, and a domain for each or none"
            )
        self._water = SharedChannel(
            self._channel_config, range(len(names)), _blackouts(self._config.blackouts_s)
        )
        self._modems = [
            _Modem(
                name.strip("/"), (self._config.spacing_m * k, 0.0), self._water.next_turn(k, 0.0)
            )
            for k, name in enumerate(names)
        ]
        self._lock = threading.Lock()
        self._num_missed = 0
        self._begun_s = time.monotonic()
        self._contexts: list[rclpy.Context] = []
        self._executors: list[SingleThreadedExecutor] = []
        for index, modem in enumerate(self._modems):
            self._connect(index, modem, _domain(domains[index]) if domains else None)
        self._diagnostics = Diagnostics(self, self._report, "channel")
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_TICK_S, self._tick, clock=steady)

    def stop(self) -> None:
        """End the threads of the other domains."""
        for executor in self._executors:
            executor.shutdown(timeout_sec=0.5)
        for modem in self._modems:
            if modem.node is not None and modem.node is not self:
                modem.node.destroy_node()
                modem.node = None
        for context in self._contexts:
            context.try_shutdown()
        self._executors, self._contexts = [], []

    def destroy_node(self) -> None:
        """Stop, then destroy."""
        self.stop()
        super().destroy_node()

    def _preset(self, given: ChannelConfig) -> ChannelConfig:
        name = self._config.preset
        if not name:
            return given
        if name not in CHANNEL_PRESETS:
            raise ConfigError(
                f"preset is {name!r}, expected one of {', '.join(CHANNEL_PRESETS)}, or nothing"
            )
        # What the water does is told beside what the modem can.
        own = {key: getattr(given, key) for key in ("loss", "seed", "access", "aloha_load")}
        return ChannelConfig.from_dict(CHANNEL_PRESETS[name].to_dict() | own)

    def _connect(self, index: int, modem: _Modem, domain_id: int | None) -> None:
        node: Node = self
        if domain_id is not None:
            context = rclpy.Context()
            rclpy.init(context=context, domain_id=domain_id)
            node = rclpy.create_node(f"channel_{index}", context=context)
            executor = SingleThreadedExecutor(context=context)
            executor.add_node(node)
            self._contexts.append(context)
            self._executors.append(executor)
            threading.Thread(target=_spin, args=(executor,), daemon=True).start()
        modem.node = node
        modem.received = node.create_publisher(
            UInt8MultiArray, f"/{modem.name}/modem/received", MODEM
        )
        modem.ready = node.create_publisher(Empty, f"/{modem.name}/modem/ready", MODEM)
        node.create_subscription(
            UInt8MultiArray, f"/{modem.name}/modem/send", self._taker(modem), MODEM
        )

    def _taker(self, modem: _Modem) -> Callable[[UInt8MultiArray], None]:
        def take(msg: UInt8MultiArray) -> None:
            with self._lock:
                modem.waiting.append(bytes(msg.data))

        return take

    def _now_s(self) -> float:
        return (time.monotonic() - self._begun_s) * self._config.time_scale

    def _tick(self) -> None:
        now_s = self._now_s()
        with self._lock:
            for index, modem in enumerate(self._modems):
                self._take_turn(index, modem, now_s)
            arrived = self._water.arrived(now_s)
        for _, receiver, data in arrived:
            self._modems[receiver].received.publish(UInt8MultiArray(data=data))

    def _take_turn(self, index: int, modem: _Modem, now_s: float) -> None:
        """Open a turn, send what comes while it lasts, and end it.

        What comes too late waits in the modem for the next turn.
        """
        per_turn, turn_s = self._channel_config.packets_per_turn, self._channel_config.turn_s
        if now_s < modem.turn_s:
            return
        if not modem.is_open:
            modem.is_open = True
            for _ in range(per_turn - len(modem.waiting)):
                modem.ready.publish(Empty())
        is_full = len(modem.waiting) >= per_turn
        if is_full or (modem.waiting and now_s >= modem.turn_s + 0.8 * turn_s):
            packets = [modem.waiting.popleft() for _ in range(min(per_turn, len(modem.waiting)))]
            where = {k: other.position_m for k, other in enumerate(self._modems)}
            # As if sent when its turn began: the way between nodes is not through water.
            self._water.send(index, packets, modem.turn_s, where)
            self._next_turn(index, modem, now_s)
        elif now_s >= modem.turn_s + turn_s:
            self._num_missed += 1
            self._next_turn(index, modem, now_s)

    def _next_turn(self, index: int, modem: _Modem, now_s: float) -> None:
        modem.is_open = False
        modem.turn_s = self._water.next_turn(index, max(now_s, modem.turn_s))

    def _report(self) -> Report:
        with self._lock:
            counts = self._water.counts
            values = {
                "sent": counts.sent,
                "delivered": counts.delivered,
                "lost": counts.lost,
                "collided": counts.collided,
                "out of range": counts.out_of_range,
                "blacked out": counts.blacked_out,
                "turns not used": self._num_missed,
            }
        return "info", f"{counts.sent} packets sent, {counts.delivered} delivered", values


def _domain(text: str) -> int:
    if not (text.isdigit() and int(text) <= _MAX_DOMAIN):
        raise ConfigError(f"parameter domains holds {text!r}, expected 0 to {_MAX_DOMAIN}")
    return int(text)


def _blackouts(times_s: tuple[float, ...]) -> list[tuple[float, float]]:
    if len(times_s) % 2 or any(a >= b for a, b in pairwise(times_s)):
        raise ConfigError(
            f"parameter blackouts_s is {list(times_s)}, expected times that increase, "
            "an even number of them"
        )
    return list(zip(times_s[::2], times_s[1::2], strict=True))


def _spin(executor: SingleThreadedExecutor) -> None:
    with contextlib.suppress(ExternalShutdownException):
        executor.spin()


def main(argv: list[str] | None = None) -> int:
    """Run the node."""
    return run_node("channel", ChannelNode, argv)
