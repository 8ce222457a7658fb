"""One vehicle's end of an acoustic link: its submaps out through a modem, the others' in."""

from __future__ import annotations

import re
import secrets
import threading
import time
from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_msgs.msg import Empty, UInt8MultiArray
from uw_dslam_msgs.msg import Submap as SubmapMsg

from uw_dslam_ros2.core.errors import ConfigError, DataError, InvalidInputError
from uw_dslam_ros2.core.link import NUM_EPOCHS, AcousticLink, LinkConfig, LinkState
from uw_dslam_ros2.core.submap import Submap, SubmapId, Track
from uw_dslam_ros2.io.sessions.link_state import load_link_state, save_link_state
from uw_dslam_ros2.ros.convert.core_types import submap_from_msg, submap_id_of, submap_to_msg
from uw_dslam_ros2.ros.manager.missing_submaps import MissingSubmaps
from uw_dslam_ros2.ros.plumbing.diagnostics import Diagnostics, Report
from uw_dslam_ros2.ros.plumbing.node_settings import AcousticLinkConfig
from uw_dslam_ros2.ros.plumbing.parameters import declare_config, refuse_unknown_parameters
from uw_dslam_ros2.ros.plumbing.qos import ANSWERS, MODEM, SUBMAPS
from uw_dslam_ros2.ros.plumbing.running import run_node

__all__ = ["AcousticLinkNode", "main"]

_SAVE_PERIOD_S = 2.0


class AcousticLinkNode(Node):
    """Drives an `AcousticLink`: the modem says when a packet may go, and brings what has come."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("acoustic_link", **kwargs)
        self._config = declare_config(self, AcousticLinkConfig)
        link_config = declare_config(self, LinkConfig, "link")
        refuse_unknown_parameters(self)
        self._vehicle_id = self._config.vehicle_id or self.get_namespace().strip("/")
        if not self._vehicle_id:
            raise ConfigError(
                "parameter vehicle_id is empty and the node has no namespace; "
                "give one of them (-r __ns:=/auv_1)"
            )
        self._lock = threading.Lock()
        self._outputs: dict[str, Publisher] = {}
        self._saved: LinkState | None = None
        self._problem = ""
        self._link = self._resumed(link_config)
        # Callbacks are short, and the link is one thing: one after the other.
        group = MutuallyExclusiveCallbackGroup()
        self._modem = self.create_publisher(UInt8MultiArray, "modem/send", MODEM)
        self.create_subscription(
            SubmapMsg, "submap", self._on_submap, SUBMAPS, callback_group=group
        )
        self.create_subscription(
            UInt8MultiArray,
            "modem/received",
            self._on_packet,
            MODEM,
            callback_group=group,
        )
        self.create_subscription(Empty, "modem/ready", self._on_ready, MODEM, callback_group=group)
        self._answers_heard = self.create_publisher(UInt8MultiArray, "link/answers_heard", ANSWERS)
        self.create_subscription(
            UInt8MultiArray, "link/answers", self._on_answer, ANSWERS, callback_group=group
        )
        self._decisions_heard = self.create_publisher(
            UInt8MultiArray, "link/decisions_heard", ANSWERS
        )
        self.create_subscription(
            UInt8MultiArray, "link/decisions", self._on_decision, ANSWERS, callback_group=group
        )
        self._submap_topic = self.resolve_topic_name("submap")
        self._wanted: dict[Track, int] = {}
        self._missing = MissingSubmaps(
            self, lambda job: job(), lambda _, msg: self._on_submap(msg)
        )
        self._give(self._link.submaps())
        self._give_told()
        self._diagnostics = Diagnostics(self, self._report, self._vehicle_id)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_SAVE_PERIOD_S, self._save, clock=steady, callback_group=group)
        self.create_timer(1.0, self._look_for_missing, clock=steady, callback_group=group)

    def stop(self) -> None:
        """Keep what was received."""
        self._save()

    def destroy_node(self) -> None:
        """Save, then destroy."""
        self.stop()
        super().destroy_node()

    def _now_s(self) -> float:
        return time.monotonic() * self._config.time_scale

    def _resumed(self, config: LinkConfig) -> AcousticLink:
        state = load_link_state(self._config.state) if self._config.state else None
        if state is None:
            # The others must not take what comes now for what came before.
            return AcousticLink(config, self._vehicle_id, secrets.randbelow(NUM_EPOCHS))
        link = AcousticLink.from_state(config, self._vehicle_id, state)
        num_submaps = sum(1 for _ in link.submaps())
        self.get_logger().info(f"went on with {num_submaps} submaps from {self._config.state}")
        return link

    # --- callbacks ---------------------------------------------------------------------------

    def _on_submap(self, msg: SubmapMsg) -> None:
        submap_id = submap_id_of(msg)
        self._missing.note(self._submap_topic, submap_id)
        self._wanted.setdefault(submap_id.track, 0)
        self._wanted[submap_id.track] = max(self._wanted[submap_id.track], submap_id.sequence + 1)
        try:
            with self._lock:
                found = self._taken(msg, submap_id)
        except InvalidInputError as error:
            self._complain(str(error))
            return
        self._give(found)

    def _taken(self, msg: SubmapMsg, submap_id: SubmapId) -> list[Submap]:
        held = self._link.own_submap(submap_id)
        # Cells that are on their way are not sent once more where a mapper draws them anew.
        is_known = held is not None and held.is_final and msg.revision > 0
        if not msg.is_pose_only and not is_known:
            return self._link.add_submap(submap_from_msg(msg))
        if held is None:
            return []  # the mapper is asked for it
        msg.is_pose_only = True
        return self._link.move_submap(submap_from_msg(msg, held))

    def _look_for_missing(self) -> None:
        """Ask the mapper for submaps that were sent before this node listened."""
        missing = {}
        for track, count in self._wanted.items():
            with self._lock:
                ids = [SubmapId(*track, sequence) for sequence in range(count)]
                absent = [i.sequence for i in ids if self._link.own_submap(i) is None]
            if absent:
                missing[track] = absent
        self._missing.look(missing)

    def _on_packet(self, msg: UInt8MultiArray) -> None:
        with self._lock:
            found = self._link.receive(bytes(msg.data), self._now_s())
        self._save()  # before a report says that it is here
        self._give(found)
        self._give_told()

    def _on_answer(self, msg: UInt8MultiArray) -> None:
        self._tell(self._link.add_answer, msg)

    def _on_decision(self, msg: UInt8MultiArray) -> None:
        self._tell(self._link.add_decision, msg)

    def _tell(self, add: Callable[[bytes], None], msg: UInt8MultiArray) -> None:
        try:
            with self._lock:
                add(bytes(msg.data))
        except InvalidInputError as error:
            self._complain(str(error))

    def _on_ready(self, _: Empty) -> None:
        with self._lock:
            packet = self._link.next_packet(self._now_s())
        if packet is not None:
            self._save()  # or its number could mean something else after a restart
            self._modem.publish(UInt8MultiArray(data=packet))

    # --- out ---------------------------------------------------------------------------------

    def _give(self, submaps: Any) -> None:
        for submap in submaps:
            self._output_of(submap).publish(submap_to_msg(submap))

    def _give_told(self) -> None:
        with self._lock:
            answers, decisions = self._link.take_answers(), self._link.take_decisions()
        for output, told in ((self._answers_heard, answers), (self._decisions_heard, decisions)):
            for data in told:
                output.publish(UInt8MultiArray(data=data))

    def _output_of(self, submap: Submap) -> Publisher:
        name = re.sub(r"\W", "_", submap.vehicle_id, flags=re.ASCII)
        topic = f"link/{name if name[0].isalpha() else '_' + name}/submap"
        if topic not in self._outputs:
            self._outputs[topic] = self.create_publisher(SubmapMsg, topic, SUBMAPS)
        return self._outputs[topic]

    def _save(self) -> None:
        if not self._config.state:
            return
        with self._lock:
            state = self._link.to_state()
        if state == self._saved:
            return
        try:
            save_link_state(self._config.state, state)
            self._saved, self._problem = state, ""
        except DataError as error:
            self._complain(str(error))

    def _complain(self, text: str) -> None:
        if text != self._problem:
            self.get_logger().warning(text)
        self._problem = text

    def _report(self) -> Report:
        now_s = self._now_s()
        with self._lock:
            link, counts = self._link, self._link.counts
            values: dict[str, float | int | str] = {
                "vehicles heard": sum(1 for n in range(32) if link.age_s(n, now_s) is not None),
                "submaps known": sum(1 for _ in link.outlines()),
                "items to send": link.num_open(now_s),
                "items unconfirmed": link.num_unconfirmed(now_s),
                "items lacking": link.num_lacking,
                "loss": link.loss,
                "received packets": counts.received_packets,
                "received bytes": counts.received_bytes,
                "duplicates": counts.duplicates,
                "repairs": counts.repairs,
            }
            values |= {f"sent bytes {kind}": num for kind, num in counts.sent_bytes.items()}
            values |= {f"sent packets {kind}": num for kind, num in counts.sent_packets.items()}
            values |= {f"refused: {why}": num for why, num in counts.refused.items()}
            for number in range(32):
                if (age_s := link.age_s(number, now_s)) is not None:
                    values[f"age of {link.name_of(number) or number} [s]"] = age_s
        if self._problem:
            return "warning", self._problem, values
        return "info", f"{values['submaps known']} submaps known", values


def main(argv: list[str] | None = None) -> int:
    """Run the node."""
    return run_node("acoustic_link", AcousticLinkNode, argv)
