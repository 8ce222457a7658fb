"""Mapper, manager and server together on one core: what share of it, and of 1 GB, they use.

``python benchmarks/bench_onboard.py [--quick]`` prints one JSON line. A sonar of 512 beams x 1000
ranges at 10 Hz is replayed in real time from another core; the three nodes are bound to core 0,
and a control group holds all three together to the limit. Where none can be made, each may take
as much memory of its own, and their sum is compared; the line says which it was.
"""

from __future__ import annotations

import contextlib
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from harness import emit, require, run_cases

from uw_dslam_ros2.cli.running.processes import free_domain
from uw_dslam_ros2.ros.plumbing.mission_control import MissionControl
from uw_dslam_ros2.sim.missions.mission import MissionConfig
from uw_dslam_ros2.sim.missions.recording import simulate_mission
from uw_dslam_ros2.sim.sonars.imaging import SonarConfig

_RATE_HZ = 10.0
_LIMIT_MB = 1000.0
_START_S, _FINISH_S = 120.0, 300.0
_NODES = ("sonar_mapper", "map_queue_manager", "registration_server")
_VEHICLE = "auv_1"
_START = "import sys; from uw_dslam_ros2.ros.nodes.{} import main; sys.exit(main())"


class _Limit:
    """What holds the memory of processes to the limit."""

    def __init__(self) -> None:
        self.kind = "each process"
        self._folder: Path | None = None
        self._peak = ""
        layouts = [
            ("cgroup v2", Path("/sys/fs/cgroup"), "memory.max", "memory.peak"),
            (
                "cgroup v1",
                Path("/sys/fs/cgroup/memory"),
                "memory.limit_in_bytes",
                "memory.max_usage_in_bytes",
            ),
        ]
        for kind, root, limit, peak in layouts:
            folder = root / f"bench_onboard_{os.getpid()}"
            with contextlib.suppress(OSError):
                folder.mkdir()
                if not (folder / peak).exists():  # the controller is not there
                    folder.rmdir()
                    continue
                (folder / limit).write_text(str(int(_LIMIT_MB * 1e6)))
                self.kind, self._folder, self._peak = kind, folder, peak
                break

    def apply(self) -> None:
        """In a process that begins: be held to it, on core 0."""
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
        if self._folder is not None:
            (self._folder / "cgroup.procs").write_text(str(os.getpid()))
        else:
            limit = int(_LIMIT_MB * 1e6)
            resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))

    def peak_mb(self) -> float:
        """Most memory that was charged to all, file pages included; NaN where nobody counts."""
        if self._folder is None:
            return math.nan
        return int((self._folder / self._peak).read_text()) * 1e-6

    def end(self) -> None:
        """When all processes are gone."""
        if self._folder is not None:
            self._folder.rmdir()


class _Nodes:
    """The three nodes on one core, and what they use."""

    def __init__(self, domain_id: int, logs: Path) -> None:
        self.limit = _Limit()
        self._environment = {
            **os.environ,
            "ROS_DOMAIN_ID": str(domain_id),
            "ROS_LOG_DIR": str(logs),
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
        }
        self._processes: list[subprocess.Popen[bytes]] = []
        mapper = ["-r", f"__ns:=/{_VEHICLE}", "-p", "is_reliable:=true"]
        for node in _NODES:
            arguments = mapper if node == "sonar_mapper" else []
            self._processes.append(self.start(node, ["--ros-args", *arguments], is_bound=True))

    def start(
        self, node: str, arguments: Sequence[str], *, is_bound: bool = False
    ) -> subprocess.Popen[bytes]:
        """Start a node; bound: on core 0, with the limit."""
        return subprocess.Popen(
            [sys.executable, "-c", _START.format(node), *arguments],
            env=self._environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            preexec_fn=self.limit.apply if is_bound else None,
        )

    def check(self) -> None:
        """Stop the benchmark if a node is gone."""
        for node, process in zip(_NODES, self._processes, strict=True):
            require(process.poll() is None, f"{node} ended with code {process.poll()}")

    def cpu_s(self) -> list[float]:
        """CPU seconds of each so far."""
        ticks = os.sysconf("SC_CLK_TCK")
        return [
            sum(map(int, _read(process.pid, "stat").rsplit(")", 1)[1].split()[11:13])) / ticks
            for process in self._processes
        ]

    def memory_mb(self) -> list[float]:
        """Memory of each; what several share counts in parts (proportional set size)."""
        return [
            int(_read(process.pid, "smaps_rollup").split("Pss:")[1].split()[0]) * 1.024e-3
            for process in self._processes
        ]

    def end(self) -> None:
        """Stop them."""
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            process.wait(timeout=30.0)
        self.limit.end()


def onboard(quick: bool) -> None:
    """Share of one core and of 1 GB at 10 Hz, and whether all pings are mapped in time."""
    duration_s = 20.0 if quick else 90.0
    config = MissionConfig(
        seed=1,
        num_vehicles=1,
        duration_s=duration_s,
        ping_rate_hz=_RATE_HZ,
        sonar=SonarConfig(num_beams=512, num_ranges=1000),
    )
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    domain_id, claim = free_domain()
    with claim, tempfile.TemporaryDirectory() as folder:
        simulate_mission(folder, config, num_processes=os.cpu_count() or 1)
        nodes = _Nodes(domain_id, Path(folder) / "logs")
        try:
            with MissionControl(domain_id, nodes.check) as control:
                control.wait_for_nodes([_VEHICLE], _START_S)
                _replay(nodes, control, Path(folder) / _VEHICLE, duration_s)
        finally:
            nodes.end()


def _replay(nodes: _Nodes, control: MissionControl, bag: Path, duration_s: float) -> None:
    topic = f"/{_VEHICLE}/sonar"
    # As fast as it was recorded, and never waiting for the mapper.
    player = nodes.start("bag_player", [str(bag), "--rate", "1.0", "--wait-for", topic])
    before, begun_s, peak_mb = nodes.cpu_s(), time.monotonic(), [0.0] * len(_NODES)
    while player.poll() is None:
        nodes.check()
        for _ in range(10):
            control.spin()
        peak_mb = [max(pair) for pair in zip(peak_mb, nodes.memory_mb(), strict=True)]
    played_s = time.monotonic() - begun_s
    used = [after - was for after, was in zip(nodes.cpu_s(), before, strict=True)]
    told = control.finish_mappers([_VEHICLE], _FINISH_S)[_VEHICLE]
    behind_s = time.monotonic() - begun_s - played_s
    num_mapped, num_sent = int(told["num_pings"]), round(duration_s * _RATE_HZ)
    emit(
        "onboard",
        {
            "pings_sent": num_sent,
            "pings_mapped": num_mapped,
            "recorded_s": duration_s,
            "played_s": played_s,
            "behind_at_the_end_s": behind_s,
            # Of the recorded time; with the kernels that are loaded once.
            "share_of_the_core": sum(used) / duration_s,
            **{f"{n}_share": s / duration_s for n, s in zip(_NODES, used, strict=True)},
            "peak_mb": sum(peak_mb),
            **{f"{n}_peak_mb": mb for n, mb in zip(_NODES, peak_mb, strict=True)},
            "share_of_1_gb": sum(peak_mb) / _LIMIT_MB,
            "limit": nodes.limit.kind,
            "charged_peak_mb": nodes.limit.peak_mb(),
            "keeps_up": num_mapped >= 0.99 * num_sent,
        },
    )
    require(sum(peak_mb) <= _LIMIT_MB, f"{sum(peak_mb):.0f} MB in all")


def _read(pid: int, name: str) -> str:
    return Path(f"/proc/{pid}/{name}").read_text()


if __name__ == "__main__":
    sys.exit(run_cases((__doc__ or "").splitlines()[0], {"onboard": onboard}))
