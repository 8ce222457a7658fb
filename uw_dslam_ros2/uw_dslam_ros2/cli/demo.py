"""``./uw demo``: recordings through the real nodes to one map and a report."""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from uw_dslam_ros2.cli.common import (
    config_file,
    num_processors,
    parser_for,
    progress_bar,
    run_command,
    versions,
)
from uw_dslam_ros2.cli.reporting.link_report import add_maps
from uw_dslam_ros2.cli.reporting.outcome import outcome_of
from uw_dslam_ros2.cli.reporting.report import RunFacts, headline, write_report
from uw_dslam_ros2.cli.reporting.scoring import Scores, Truth, read_truth
from uw_dslam_ros2.cli.running.demo_link import (
    DEFAULT_LINK_RATE,
    LINK_PRESETS,
    LinkedMission,
    run_linked,
)
from uw_dslam_ros2.cli.running.mapping import OfflineConfig
from uw_dslam_ros2.cli.running.processes import Child, Children, free_domain
from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.merging import MapQueueConfig
from uw_dslam_ros2.io.datasets.aracati2017 import read_aracati2017, write_bags
from uw_dslam_ros2.io.sessions.session import SESSION_FOLDER, load_session
from uw_dslam_ros2.io.settings import SettingsFile
from uw_dslam_ros2.sim.missions.mission import SONAR_KINDS, MissionConfig
from uw_dslam_ros2.sim.missions.recording import simulate_mission

__all__ = ["main"]

_MARK = ".uw_demo"
_NUM_STEPS = 6
_START_TIMEOUT_S = 90.0
_FINISH_TIMEOUT_S = 300.0
_SETTLE_TIMEOUT_S = 600.0
# As fast as the mappers keep up: the player holds when one is this far behind, in recorded time.
# While one searches for a loop the others go on, so it is long.
_UNLIMITED_RATE = 10_000.0
_NODES = "uw_dslam_ros2.ros.nodes"
_CLOCK_HZ = 2.0
_MAX_LAG_S = 20.0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the demo; exit code 0 also where some vehicles could not be merged."""
    args = _parser().parse_args(argv)
    # A demo that is told to end ends its processes too.
    signal.signal(signal.SIGTERM, _interrupt)
    return run_command("demo", lambda: _run(args))


def _interrupt(*_: Any) -> None:
    raise KeyboardInterrupt


def _parser() -> argparse.ArgumentParser:
    parser = parser_for(
        "./uw demo",
        "Simulate vehicles in a harbour (or convert a public recording), replay the recordings\n"
        "through the real nodes in separate processes, and write the merged map and a report.",
        "./uw demo --out my_demo --seed 7",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("uw_demo"), metavar="DIR", help="default: %(default)s"
    )
    parser.add_argument(
        "--seed", type=int, default=MissionConfig().seed, help="another place for each"
    )
    parser.add_argument("--vehicles", type=int, default=3, metavar="N", help="default: 3")
    parser.add_argument(
        "--duration",
        type=float,
        default=MissionConfig().duration_s,
        metavar="S",
        help="length of each recording [s] (default: %(default)s)",
    )
    parser.add_argument(
        "--sonar",
        choices=SONAR_KINDS,
        default=MissionConfig().sonar_kind,
        help="a fan of beams at once, or one beam that turns in 14 s",
    )
    parser.add_argument(
        "--rate",
        type=float,
        metavar="R",
        help="recorded seconds per second (default: as fast as the mappers keep up)",
    )
    parser.add_argument(
        "--dataset", choices=("aracati2017",), help="a real recording, not a simulated one"
    )
    parser.add_argument("--data", type=Path, metavar="DIR", help="folder of the dataset")
    parser.add_argument(
        "--link",
        choices=LINK_PRESETS,
        help="each vehicle has a manager of its own, and nothing but acoustic modems joins them",
    )
    parser.add_argument(
        "--loss", type=float, default=0.0, metavar="SHARE", help="of packets on the link"
    )
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings of the nodes (YAML)")
    return parser


@dataclass(slots=True)
class _Steps:
    """Says what is being done and how long it took."""

    times_s: dict[str, float] = field(default_factory=dict)
    _begun_s: float = field(default_factory=time.monotonic)
    _last: str = ""

    def begin(self, name: str, text: str) -> None:
        """A step begins, and with it the last one ends."""
        self.end()
        self._last, self._begun_s = name, time.monotonic()
        print(f"[demo] {len(self.times_s) + 1}/{_NUM_STEPS} {text}", flush=True)

    def end(self) -> None:
        """Note the time of the step that ends."""
        if self._last:
            self.times_s[self._last] = time.monotonic() - self._begun_s
            self._last = ""

    def say(self, text: str) -> None:
        """A line below the step."""
        print(f"[demo]     {text}", flush=True)


@dataclass(frozen=True, slots=True)
class _Recordings:
    """What is replayed."""

    title: str
    vehicles: tuple[str, ...]
    bags: tuple[Path, ...]
    truth: Truth
    ping_topic: str
    config: Path | None
    seeds: dict[str, int]


def _run(args: argparse.Namespace) -> int:
    if args.dataset and not args.data:
        raise DataError(f"--dataset {args.dataset} needs --data, the folder of its files")
    if not 0.0 <= args.loss < 1.0:
        raise DataError(f"--loss is {args.loss:g}, expected 0 to less than 1")
    SettingsFile(args.config)  # a wrong file is told before anything is simulated
    out = _prepared(args.out)
    steps = _Steps()
    started_s = time.monotonic()
    recordings = _convert(args, out, steps) if args.dataset else _simulate(args, out, steps)
    link: dict[str, Any] = {}
    linked = _linked(args, recordings) if args.link else None
    if linked is not None:
        notes, link = run_linked(out, linked, steps.begin)
    else:
        notes = _replay(args, out, recordings, steps)
    steps.begin("writing the report", "writing maps, pictures and report")
    outcome = outcome_of(load_session(out / SESSION_FOLDER, _queue_config(recordings)))
    if linked is not None:
        notes += add_maps(link, linked, out, _queue_config(recordings), recordings.truth)
    steps.end()
    facts = RunFacts(
        title=recordings.title,
        source=[bag.name for bag in recordings.bags],
        command="./uw demo " + " ".join(sys.argv[1:]),
        settings=OfflineConfig.read(recordings.config, recordings.vehicles).to_dict(),
        seeds=recordings.seeds,
        versions=versions(),
        times_s=steps.times_s | {"all": time.monotonic() - started_s},
        notes=notes,
        link=link,
    )
    scores = write_report(out, outcome, facts, recordings.truth)
    for note in notes:
        print(f"[demo] warning: {note}", file=sys.stderr, flush=True)
    _conclude(out, headline(outcome, scores), scores, time.monotonic() - started_s)
    return 0


def _linked(args: argparse.Namespace, recordings: _Recordings) -> LinkedMission:
    return LinkedMission(
        recordings.vehicles,
        recordings.bags,
        recordings.ping_topic,
        recordings.config,
        args.link,
        args.loss,
        args.rate or DEFAULT_LINK_RATE,
    )


def _conclude(out: Path, text: str, scores: Scores, seconds: float) -> None:
    if scores.alone_rmse_m and scores.trajectory is not None:
        alone = ", ".join(f"{name} {error:.2f} m" for name, error in scores.alone_rmse_m.items())
        print(f"[demo] own drift of each vehicle before merging: {alone}")
    print(f"[demo] done in {seconds:.0f} s: {text}")
    print(f"[demo] look at {out / 'report.html'} and {out / 'before_after.png'}")
    print(f"[demo] numbers in {out / 'report.json'}, the map in {out / 'global_map.yaml'}")


def _prepared(out: Path) -> Path:
    """Make an empty folder; an earlier demo's is replaced, anything else is left alone."""
    out = out.resolve()
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        if not (out / _MARK).is_file():
            raise DataError(
                f"{out} holds other files than a demo's; give another --out or remove it"
            )
        shutil.rmtree(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / _MARK).write_text("The next ./uw demo with this folder replaces it.\n")
    except OSError as error:
        raise DataError(f"cannot write to {out}: {error.strerror}") from error
    return out


# --- recordings ------------------------------------------------------------------------------


def _simulate(args: argparse.Namespace, out: Path, steps: _Steps) -> _Recordings:
    config = MissionConfig(
        seed=args.seed,
        num_vehicles=args.vehicles,
        duration_s=float(args.duration),
        sonar_kind=args.sonar,
    )
    steps.begin(
        "simulating",
        f"simulating a {config.place} (seed {config.seed}) and {config.num_vehicles} vehicles, "
        f"{config.duration_s:.0f} s of recordings each",
    )
    with progress_bar("simulating", " pings") as progress:
        mission = simulate_mission(
            out / "recordings", config, num_processes=num_processors(), progress=progress
        )
    num_bytes = sum(f.stat().st_size for bag in mission.bags for f in bag.iterdir())
    steps.say(f"{len(mission.bags)} bags, {num_bytes / 1e6:.0f} MB")
    return _Recordings(
        f"Simulated {config.place}, seed {config.seed}: {config.num_vehicles} vehicles",
        mission.vehicle_ids,
        mission.bags,
        read_truth(mission.truth_map.parent),
        "scan" if config.is_turning else "sonar",
        args.config,
        {"mission": config.seed},
    )


def _convert(args: argparse.Namespace, out: Path, steps: _Steps) -> _Recordings:
    steps.begin("converting", f"converting {args.dataset} to bags")
    with progress_bar("converting", " bags") as progress:
        bags = write_bags(read_aracati2017(args.data), out / "recordings", progress=progress)
    chosen = [bag for bag in bags if bag.name.startswith("auv_") and bag.parent.name != "whole"]
    return _Recordings(
        "Aracati 2017: one recording as three vehicles",
        tuple(bag.name for bag in chosen),
        tuple(chosen),
        read_truth(out / "recordings" / "truth"),
        "points",
        args.config or config_file("aracati2017.yaml"),
        {},
    )


# --- nodes -----------------------------------------------------------------------------------


def _replay(
    args: argparse.Namespace, out: Path, recordings: _Recordings, steps: _Steps
) -> list[str]:
    """Everything from the start of the nodes to the saved session; returns what went wrong."""
    # Only here, so that help and wrong usage are told at once and without ROS.
    from uw_dslam_ros2.ros.plumbing.mission_control import MissionControl  # noqa: TID251 (it runs nodes)

    domain_id, claim = free_domain()
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(domain_id),
        "ROS_LOG_DIR": str(out / "logs" / "ros"),
        "PYTHONUNBUFFERED": "1",
        # Many processes share the cores; each one's own pool of threads would only be in the way.
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }
    with claim, Children(environment, out / "logs") as children:
        steps.begin("starting the nodes", f"starting the nodes on ROS domain {domain_id}")
        _start_nodes(children, recordings)
        with MissionControl(domain_id, children.check) as control:
            control.wait_for_nodes(recordings.vehicles, _START_TIMEOUT_S)
            steps.begin("replaying", "replaying the bags, as fast as the mappers keep up")
            player = _start_player(children, args.rate, recordings)
            _follow(control, player, children.check)
            told = control.finish_mappers(recordings.vehicles, _FINISH_TIMEOUT_S)
            steps.begin("registering", "waiting for the last registrations")
            control.settle_queue()
            is_settled = _settle(control, steps)
            steps.begin("saving", "saving through the manager's services")
            problem = control.save_map(str(out / "global_map"))
            control.save_session(str(out / SESSION_FOLDER))
            notes = control.notes_on(told)
    if problem:
        notes.append(f"The manager saved no map: {problem}.")
    if not is_settled:
        notes.append(
            f"The queue was still registering after {_SETTLE_TIMEOUT_S:.0f} s; "
            "this is what was merged by then."
        )
    return notes


def _start_nodes(children: Children, recordings: _Recordings) -> None:
    ros = ["--ros-args"]
    if recordings.config is not None:
        ros += ["--params-file", str(recordings.config.resolve())]
    for vehicle in recordings.vehicles:
        parameters = ["-r", f"__ns:=/{vehicle}", "-p", "use_sim_time:=true"]
        parameters += ["-p", "is_reliable:=true"]
        if recordings.ping_topic == "scan":
            parameters += ["-p", "input:=scan"]
        children.start(f"{vehicle}_sonar_mapper", f"{_NODES}.sonar_mapper", [*ros, *parameters])
    children.start("registration_server", f"{_NODES}.registration_server", ros)
    parameters = ["-p", "use_sim_time:=true"]
    children.start("map_queue_manager", f"{_NODES}.map_queue_manager", [*ros, *parameters])


def _start_player(children: Children, rate: float | None, recordings: _Recordings) -> Child:
    topics = [f"/{vehicle}/{recordings.ping_topic}" for vehicle in recordings.vehicles]
    arguments = [str(bag) for bag in recordings.bags]
    arguments += ["--rate", str(rate or _UNLIMITED_RATE), "--max-lag-s", str(_MAX_LAG_S)]
    arguments += ["--wait-for", *topics]
    # The nodes go by the messages' own stamps; every tick of /clock costs each of them a callback.
    arguments += ["--ros-args", "-p", f"clock_hz:={_CLOCK_HZ}"]
    return children.start("bag_player", f"{_NODES}.bag_player", arguments, may_end=True)


def _follow(control: Any, player: Child, check: Callable[[], None]) -> None:
    """Wait until all is played."""
    shown = ""
    while player.poll() is None:
        check()
        control.spin()
        status = control.status
        text = (
            "" if status is None else f"{len(status.submaps)} submaps, {status.num_merged} merged"
        )
        if text != shown and sys.stderr.isatty():
            print(f"\r[demo]     {text}\x1b[K", end="", file=sys.stderr, flush=True)
            shown = text
    if shown:
        print("\r\x1b[K", end="", file=sys.stderr)
    check()


def _settle(control: Any, steps: _Steps) -> bool:
    shown = [""]

    def show(status: Any) -> None:
        text = (
            f"{len(status.submaps)} submaps, {status.num_merged} merged, "
            f"{status.num_registrations} registrations"
        )
        if text != shown[0] and sys.stderr.isatty():
            print(f"\r[demo]     {text}\x1b[K", end="", file=sys.stderr, flush=True)
        shown[0] = text

    is_settled = bool(control.wait_until_settled(_SETTLE_TIMEOUT_S, show))
    if sys.stderr.isatty():
        print("\r\x1b[K", end="", file=sys.stderr)
    steps.say(shown[0])
    return is_settled


# --- results ---------------------------------------------------------------------------------


def _queue_config(recordings: _Recordings) -> MapQueueConfig:
    return SettingsFile(recordings.config).section(MapQueueConfig, "queue", "/map_queue_manager")


if __name__ == "__main__":
    sys.exit(main())
