"""``./uw demo --link``: each vehicle on a ROS domain of its own, joined by modems alone."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from uw_dslam_ros2.cli.running.link_watch import Known, what_is_open
from uw_dslam_ros2.cli.running.processes import Child, Children, free_domain
from uw_dslam_ros2.core.link.transport.channel import CHANNEL_PRESETS, ChannelConfig
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
_REST_S = 3.0
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
        self._known = [Known(vehicle) for vehicle in mission.vehicles]
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
        told = [
            self._controls[index].finish_mappers([vehicle], _FINISH_TIMEOUT_S)
            for index, vehicle in vehicles
        ]
        end_s = self._look()
        begin("registering", "waiting for the last packets and registrations")
        complete_s, still_open = self._settle(end_s)
        begin("saving", "saving through the managers' services")
        for index, vehicle in vehicles:
            folder = mission.session_folder(self._out, vehicle)
            folder.parent.mkdir(parents=True, exist_ok=True)
            self._controls[index].save_session(str(folder))
        notes = [note for i, _ in vehicles for note in self._controls[i].notes_on(told[i])]
        if still_open:
            notes.append(f"When the demo ended, {', '.join(still_open)}.")
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

    def _what_is_open(self) -> list[str]:
        """What is missing until all have the same map for good."""
        links, managers = (
            [control.diagnostics_of(node) for control in self._controls[:-1]]
            for node in ("acoustic_link", "map_queue_manager")
        )
        found = what_is_open(self._mission.vehicles, links, managers)
        return found if self._is_complete() else ["not every vehicle has every submap", *found]

    def _settle(self, end_s: float) -> tuple[float | None, list[str]]:
        """When every manager knew every submap, if ever; and what was missing in the end."""
        complete_s: float | None = None
        settled: dict[tuple[str, int, int], int] = {}
        rest_s = time.monotonic()
        until_s = rest_s + _SETTLE_TIMEOUT_S
        found = self._what_is_open()
        while (now_s := self._look()) < end_s + _LINK_PATIENCE_S and time.monotonic() < until_s:
            found = self._what_is_open()
            if self._is_complete():
                complete_s = complete_s or now_s
                if settled != self._known[0].revisions:
                    settled = dict(self._known[0].revisions)
                    for control in self._controls[:-1]:
                        control.settle_queue()
            # What is told is a second old, and what was found last may be on its way to a link.
            if found:
                rest_s = time.monotonic()
            elif time.monotonic() - rest_s > _REST_S:
                break
        return complete_s, found

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
                known.vehicle: known.facts(control.diagnostics_of("acoustic_link"))
                for known, control in zip(self._known, self._controls, strict=False)
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
