"""``./uw demo --link``: each vehicle on a ROS domain of its own, joined by modems alone."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from uw_dslam_ros2.cli.running.processes import Child, Children, free_domain
from uw_dslam_ros2.core.link.transport.channel import CHANNEL_PRESETS, ChannelConfig
from uw_dslam_ros2.core.merging import SubmapState
from uw_dslam_ros2.io.sessions.session import SESSION_FOLDER

__all__ = ["DEFAULT_LINK_RATE", "LINK_PRESETS", "LinkedMission", "run_linked"]

DEFAULT_LINK_RATE = 3.0
"""Recorded seconds a second: the channel keeps time, so that it cannot go as fast as it likes."""
LINK_PRESETS = ("shared", *CHANNEL_PRESETS)
"""Modems that the demo knows; `shared`: 64 bytes, 1000 bit/s for all together."""
_NODES = "uw_dslam_ros2.ros.nodes"
_START_TIMEOUT_S = 180.0
_FINISH_TIMEOUT_S = 300.0
_SETTLE_TIMEOUT_S = 600.0
_LINK_PATIENCE_S = 1800.0  # of recorded time, after the last ping
_CLOCK_HZ = 2.0
_MAX_LAG_S = 20.0


@dataclass(frozen=True, slots=True)
class LinkedMission:
    """What is replayed: one bag for each vehicle, and the modems between them."""

    vehicles: tuple[str, ...]
    bags: tuple[Path, ...]
    ping_topic: str
    settings: Path | None
    preset: str
    loss: float
    rate: float

    @property
    def channel(self) -> ChannelConfig:
        """The modems, and the water."""
        preset = CHANNEL_PRESETS.get(self.preset, ChannelConfig())
        return ChannelConfig.from_dict(preset.to_dict() | {"loss": self.loss})

    def session_folder(self, out: Path, vehicle: str) -> Path:
        """Where a vehicle's manager saves what it knows; the first one's is the demo's."""
        first = vehicle == self.vehicles[0]
        return (out if first else out / "vehicles" / vehicle) / SESSION_FOLDER


@dataclass(slots=True)
class _Known:
    """What one vehicle's manager knew when; times in recorded seconds."""

    vehicle: str
    num_submaps: list[tuple[float, int]] = field(default_factory=list)
    joined_s: dict[str, float] = field(default_factory=dict)
    revisions: dict[tuple[str, int, int], int] = field(default_factory=dict)

    def look(self, status: Any, now_s: float) -> None:
        """Note how much it knows, and whom it has joined."""
        if status is None:
            return
        self.revisions = {(s.vehicle_id, s.run_id, s.sequence): s.revision for s in status.submaps}
        if not self.num_submaps or self.num_submaps[-1][1] != len(self.revisions):
            self.num_submaps.append((now_s, len(self.revisions)))
        merged = {s.vehicle_id for s in status.submaps if s.state == SubmapState.MERGED}
        if self.vehicle in merged:
            for vehicle in sorted(merged - {self.vehicle}):
                self.joined_s.setdefault(vehicle, now_s)


def run_linked(
    out: Path, mission: LinkedMission, begin: Callable[[str, str], None]
) -> tuple[list[str], dict[str, Any]]:
    """Replay the bags; returns notes, and the report's facts about the link.

    Each vehicle's session goes to `LinkedMission.session_folder`.
    """
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    with contextlib.ExitStack() as stack:
        domains = []
        for _ in range(len(mission.vehicles) + 1):
            domain_id, claim = free_domain()
            stack.enter_context(claim)
            domains.append(domain_id)
        return _Run(out, mission, domains, stack).run(begin)


class _Run:
    """Processes and clients while they run; the last domain is that of the channel."""

    def __init__(
        self,
        out: Path,
        mission: LinkedMission,
        domains: Sequence[int],
        stack: contextlib.ExitStack,
    ) -> None:
        # Only here, so that help and wrong usage are told at once and without ROS.
        from uw_dslam_ros2.ros.plumbing.mission_control import MissionControl  # noqa: TID251 (it runs nodes)

        self._out, self._mission, self._domains = out, mission, domains
        names = (*mission.vehicles, "channel")
        self._children = [
            stack.enter_context(Children(_environment(out, domain_id), out / "logs" / name))
            for domain_id, name in zip(domains, names, strict=True)
        ]
        self._controls = [
            stack.enter_context(MissionControl(domain_id, self._check)) for domain_id in domains
        ]
        self._known = [_Known(vehicle) for vehicle in mission.vehicles]
        self._begun_s = time.monotonic()

    def run(self, begin: Callable[[str, str], None]) -> tuple[list[str], dict[str, Any]]:
        """All of it."""
        mission = self._mission
        vehicles = list(enumerate(mission.vehicles))
        begin("starting the nodes", f"starting the nodes on ROS domains {self._domains}")
        for index, vehicle in vehicles:
            _start_vehicle(self._children[index], self._out, mission, vehicle)
        for index, vehicle in vehicles:
            self._controls[index].wait_for_nodes([vehicle], _START_TIMEOUT_S)
        begin("replaying", f"replaying the bags at {mission.rate:g} times their speed")
        _start_channel(self._children[-1], mission, self._domains)
        players = [_start_player(self._children[index], mission, index) for index, _ in vehicles]
        self._begun_s = time.monotonic()
        while any(player.poll() is None for player in players):
            self._look()
        answers = [
            self._controls[index].finish_mappers([vehicle], _FINISH_TIMEOUT_S)
            for index, vehicle in vehicles
        ]
        end_s = self._look()
        begin("registering", "waiting for the last packets and registrations")
        complete_s, is_settled = self._settle(end_s)
        begin("saving", "saving through the managers' services")
        for index, vehicle in vehicles:
            folder = mission.session_folder(self._out, vehicle)
            folder.parent.mkdir(parents=True, exist_ok=True)
            self._controls[index].save_session(str(folder))
        notes = [note for i, _ in vehicles for note in self._controls[i].notes_on(answers[i])]
        if not is_settled:
            notes.append("A queue was still registering, or a link sending, when the demo ended.")
        if complete_s is None:
            notes.append("Not every submap had crossed the link when the demo ended.")
        return notes, self._facts(end_s, complete_s)

    def _check(self) -> None:
        for children in self._children:
            children.check()

    def _look(self) -> float:
        """See what has come; the time [s] since the replay's beginning."""
        self._check()
        for control in self._controls:
            control.spin()
        now_s = (time.monotonic() - self._begun_s) * self._mission.rate
        for control, known in zip(self._controls, self._known, strict=False):
            known.look(control.status, now_s)
        return now_s

    def _is_complete(self) -> bool:
        """Whether all managers know the same, of every vehicle."""
        first = self._known[0].revisions
        names = {name for name, _, _ in first}
        return names == set(self._mission.vehicles) and all(
            known.revisions == first for known in self._known
        )

    def _is_at_rest(self) -> bool:
        """Whether that is so, and no link has anything left to send."""
        links = [control.diagnostics_of("acoustic_link") for control in self._controls[:-1]]
        return self._is_complete() and all(link.get("items to send") == "0" for link in links)

    def _settle(self, end_s: float) -> tuple[float | None, bool]:
        """When every manager knew every submap, if ever; and whether all came to rest."""
        complete_s: float | None = None
        until_s = time.monotonic() + _SETTLE_TIMEOUT_S
        while (now_s := self._look()) < end_s + _LINK_PATIENCE_S and time.monotonic() < until_s:
            if complete_s is None and self._is_complete():
                complete_s = now_s
            if not self._is_at_rest():
                continue
            before = self._known[0].revisions
            for control in self._controls[:-1]:
                control.settle_queue()
            for control in self._controls[:-1]:
                control.wait_until_settled(_SETTLE_TIMEOUT_S, lambda _: None)
            self._look()
            # What was found now are answers, which cross the link yet.
            if self._is_at_rest() and self._known[0].revisions == before:
                return complete_s, True
        return complete_s, False

    def _facts(self, end_s: float, complete_s: float | None) -> dict[str, Any]:
        """What the report says of the link."""
        mission = self._mission
        water = self._controls[-1].diagnostics_of("channel")
        late_s = None if complete_s is None else round(complete_s - end_s, 1)
        return {
            "preset": mission.preset,
            "loss": mission.loss,
            "channel": mission.channel.to_dict(),
            "packets": {name.replace(" ", "_"): int(value) for name, value in water.items()},
            "last_ping_s": round(end_s, 1),
            "complete_after_last_ping_s": late_s,
            "vehicles": {
                known.vehicle: _facts_of(known, control.diagnostics_of("acoustic_link"))
                for known, control in zip(self._known, self._controls, strict=False)
            },
        }


def _facts_of(known: _Known, told: Mapping[str, str]) -> dict[str, Any]:
    sent: dict[str, dict[str, int]] = {}
    for name, value in told.items():
        for unit in ("packets", "bytes"):
            if (kind := name.removeprefix(f"sent {unit} ")) != name:
                sent.setdefault(kind, {})[unit] = int(value)
    return {
        "num_submaps_known": len(known.revisions),
        "num_submaps_known_s": [[round(at_s, 1), num] for at_s, num in known.num_submaps],
        "joined_s": {name: round(at_s, 1) for name, at_s in known.joined_s.items()},
        "sent": sent,
        "received_packets": int(told.get("received packets", 0)),
        "received_bytes": int(told.get("received bytes", 0)),
        "repeated_packets": int(told.get("repairs", 0)),
        "duplicates": int(told.get("duplicates", 0)),
        "refused": {
            name.removeprefix("refused: "): int(value)
            for name, value in told.items()
            if name.startswith("refused: ")
        },
    }


# --- processes -------------------------------------------------------------------------------


def _environment(out: Path, domain_id: int) -> dict[str, str]:
    return {
        **os.environ,
        "ROS_DOMAIN_ID": str(domain_id),
        "ROS_LOG_DIR": str(out / "logs" / "ros"),
        "PYTHONUNBUFFERED": "1",
        # Many processes share the cores; each one's own pool of threads would only be in the way.
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }


def _start_vehicle(children: Children, out: Path, mission: LinkedMission, vehicle: str) -> None:
    ros = ["--ros-args"]
    if mission.settings is not None:
        ros += ["--params-file", str(mission.settings.resolve())]
    own = [*ros, "-r", f"__ns:=/{vehicle}", "-p", "use_sim_time:=true"]
    mapper = [*own, "-p", "is_reliable:=true"]
    if mission.ping_topic == "scan":
        mapper += ["-p", "input:=scan"]
    children.start("sonar_mapper", f"{_NODES}.sonar_mapper", mapper)
    number = mission.vehicles.index(vehicle) + 1
    link = [
        *(*own, "-p", f"link.number:={number}", "-p", f"time_scale:={mission.rate}"),
        *("-p", f"link.packet_bytes:={mission.channel.packet_bytes}"),
        *("-p", f"state:={out / 'vehicles' / vehicle}.link"),
    ]
    children.start("acoustic_link", f"{_NODES}.acoustic_link", link)
    children.start("registration_server", f"{_NODES}.registration_server", ros)
    # Every vehicle's manager takes what all have received, of its own vehicle too.
    sources = ", ".join(f"{vehicle}/link/{other}" for other in mission.vehicles)
    manager = [
        *(*ros, "-p", "use_sim_time:=true", "-p", f"vehicles:=[{sources}]"),
        *("-p", f"link:={vehicle}"),
        *("-p", f"queue.anchor_vehicle:={mission.vehicles[0]}", "-p", "queue.resolution_m:=0.1"),
    ]
    children.start("map_queue_manager", f"{_NODES}.map_queue_manager", manager)


def _start_channel(children: Children, mission: LinkedMission, domains: Sequence[int]) -> None:
    names = ", ".join(mission.vehicles)
    numbers = ", ".join(f"'{domain_id}'" for domain_id in domains[:-1])
    arguments = [
        *("--ros-args", "-p", f"vehicles:=[{names}]", "-p", f"domains:=[{numbers}]"),
        *("-p", f"time_scale:={mission.rate}", "-p", f"channel.loss:={mission.loss}"),
    ]
    if mission.preset in CHANNEL_PRESETS:
        arguments += ["-p", f"preset:={mission.preset}"]
    children.start("channel", f"{_NODES}.channel", arguments)


def _start_player(children: Children, mission: LinkedMission, index: int) -> Child:
    topic = f"/{mission.vehicles[index]}/{mission.ping_topic}"
    arguments = [str(mission.bags[index]), "--rate", str(mission.rate), "--wait-for", topic]
    arguments += ["--max-lag-s", str(_MAX_LAG_S), "--ros-args", "-p", f"clock_hz:={_CLOCK_HZ}"]
    return children.start("bag_player", f"{_NODES}.bag_player", arguments, may_end=True)
