"""One vehicle's mapping, 512 beams x 1000 ranges: time of a ping by stage, memory over hours.

The trajectory is checked against the truth. ROS itself (transport, executors) is not in it.
"""

from __future__ import annotations

import os
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from harness import emit, require, run_cases

from uw_dslam_ros2.core.chart.pings import KeptPings
from uw_dslam_ros2.core.mapping import VehicleMapper, VehicleMapperConfig, section
from uw_dslam_ros2.core.mapping import vehicle_mapper as mapper_module
from uw_dslam_ros2.core.mapping.loops import estimators
from uw_dslam_ros2.core.mapping.scans import local_map
from uw_dslam_ros2.core.metrics import trajectory_error
from uw_dslam_ros2.core.sonar import SonarImage
from uw_dslam_ros2.io.drivers.projected_image import read_projected
from uw_dslam_ros2.io.drivers.settings import ReadSettings
from uw_dslam_ros2.io.heap import trim
from uw_dslam_ros2.io.interfaces import make_typestore
from uw_dslam_ros2.io.outgoing import MessageFactory
from uw_dslam_ros2.sim.missions.mission import T_BASE_DVL, T_BASE_SONAR, MissionConfig, PingMaker
from uw_dslam_ros2.sim.missions.mission import plan_mission as plan
from uw_dslam_ros2.sim.sonars.imaging import SonarConfig
from uw_dslam_ros2.sim.waters.world import cast_rays

_NUM_BEAMS, _NUM_RANGES, _RATE_HZ = 512, 1000, 10.0
_S = 1_000_000_000
_REACH_M = 25.0
_MAX_PING_BYTES = 128 * 2**20
"""As in the node, see `ros.mapper.last_pass`."""


class _Stages:
    """CPU seconds by stage; time inside a nested stage counts there only."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._open: list[str] = []
        self._since = 0.0

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        self._switch()
        self._open.append(name)
        try:
            yield
        finally:
            self._switch()
            self._open.pop()

    def wrap(self, owner: Any, attribute: str, name: str) -> None:
        inner: Callable[..., Any] = getattr(owner, attribute)

        def timed(*args: Any, **kwargs: Any) -> Any:
            with self.stage(name):
                return inner(*args, **kwargs)

        setattr(owner, attribute, timed)

    def _switch(self) -> None:
        now = time.process_time()
        if self._open:
            self.seconds[self._open[-1]] += now - self._since
        self._since = now


def ping(is_quick: bool) -> None:
    """Time of a ping at 10 Hz, by stage."""
    duration_s = 20.0 if is_quick else 120.0
    mission = plan(_mission_config(duration_s))
    run = mission.runs[0]
    store = make_typestore()
    factory = MessageFactory(store)
    messages = []
    for image in PingMaker(mission).pings(0, range(run.num_pings)):
        message = factory.sonar_image(
            "auv_1/sonar", image, beam_width_rad=0.01, frequency_hz=1.2e6, sound_speed_m_s=1500.0
        )
        messages.append(bytes(store.serialize_cdr(message, message.__msgtype__)))
    stages = _Stages()
    stages.wrap(mapper_module, "detect", "front end")
    stages.wrap(local_map.LocalMap, "match", "scan matching")
    stages.wrap(section.GrowingGrid, "add", "occupancy grid")
    stages.wrap(section.OpenSection, "close", "closing submaps")
    stages.wrap(estimators._Graph, "close_loops", "loops")
    mapper = VehicleMapper(VehicleMapperConfig(), "auv_1")
    per_ping: list[float] = []
    front_end: list[float] = []
    for message in messages[:3]:  # compile
        _image_of(store, message)
    # The first pings compile kernels that only a real mission reaches.
    num_cold = min(50, len(messages) // 4)
    for i, (data, navigation) in enumerate(zip(messages, _navigation(mission), strict=True)):
        if i == num_cold:
            stages.seconds.clear()
            per_ping.clear()
            front_end.clear()
        with stages.stage("navigation"):
            navigation(mapper)
        start, front = time.process_time(), stages.seconds["front end"]
        with stages.stage("rest"):
            with stages.stage("decoding"):
                image = _image_of(store, data)
            mapper.add_image(image, T_BASE_SONAR)
        per_ping.append(time.process_time() - start)
        front_end.append(stages.seconds["front end"] - front)
    mapper.finish()
    truth = run.motion.stamp_ns, run.motion.poses
    error = trajectory_error({"auv_1": mapper.trajectory()}, {"auv_1": truth})
    require(error.rmse_m < 0.5, f"the trajectory is {error.rmse_m:.2f} m off")
    total = sum(stages.seconds.values())
    emit("ping", {
        "beams": _NUM_BEAMS, "ranges": _NUM_RANGES, "pings": len(per_ping),
        "cpu_median_ms": 1e3 * np.median(per_ping),
        "cpu_mean_ms": 1e3 * np.mean(per_ping),
        "cpu_p95_ms": 1e3 * np.percentile(per_ping, 95),
        "front_end_median_ms": 1e3 * np.median([f for f in front_end if f > 0.0]),
        "front_end_p95_ms": 1e3 * np.percentile([f for f in front_end if f > 0.0], 95),
        "with_navigation_mean_ms": 1e3 * total / len(per_ping),
        "share_of_a_core": total / (len(per_ping) / _RATE_HZ),
        **{f"{name} share": s / total for name, s in sorted(stages.seconds.items())},
        "rmse_m": error.rmse_m,
    })  # fmt: skip


def memory(is_quick: bool) -> None:
    """Memory of the mapper over hours, with scans of the walls in place of images.

    Nothing of an image is kept anyway. As in the node, the map is asked for each minute, pings
    are kept for the last pass, and what closing a submap took is given back.
    """
    duration_s = 240.0 if is_quick else 7200.0
    small = replace(_mission_config(duration_s), ping_rate_hz=1.0)
    mission = plan(small)
    run = mission.runs[0]
    kept = KeptPings(_MAX_PING_BYTES)
    mapper = VehicleMapper(VehicleMapperConfig(), "auv_1", watch=kept)
    rng = np.random.default_rng(small.seed)
    poses, bearings = run.sonar_poses(), np.linspace(-1.1, 1.1, 128)
    before_mib, samples, seconds, map_seconds = _resident_mib(), [], 0.0, []
    for i, navigation in enumerate(_navigation(mission)):
        hits = cast_rays(mission.world.segments, poses[i, :2], poses[i, 2] + bearings, _REACH_M)
        ranges = hits.range_m + rng.normal(0.0, 0.03, len(bearings))
        start = time.process_time()
        navigation(mapper)
        stamp_ns = int(run.ping_motion.stamp_ns[i])
        if mapper.add_scan(stamp_ns, bearings, ranges, _REACH_M, T_BASE_SONAR):
            trim()
        seconds += time.process_time() - start
        if i % 60 == 59:
            start = time.process_time()
            mapper.vehicle_map()
            map_seconds.append(time.process_time() - start)
            samples.append((i / small.ping_rate_hz / 3600.0, _resident_mib() - before_mib))
    hours, mib = np.array(samples[len(samples) // 2 :]).T
    diagnostics = mapper.diagnostics()
    emit("memory", {
        "simulated_hours": duration_s / 3600.0, "submaps": diagnostics["num_submaps"],
        "loops": diagnostics["num_loops"],
        "mib_at_half": mib[0], "mib_at_end": mib[-1],
        "mib_per_hour": np.polyfit(hours, mib, 1)[0],
        "mib_kept_in_submaps": _closed_bytes(mapper) / 2**20,
        "mib_kept_in_pings": kept.num_bytes / 2**20,
        "mib_of_the_process": before_mib + mib[-1],
        "navigation_records": len(mapper._navigation._records),
        "share_of_a_core": seconds / duration_s,
        "last_map_ms": 1e3 * float(np.median(map_seconds[-5:])),
        "rmse_m": trajectory_error(
            {"auv_1": mapper.trajectory()}, {"auv_1": (run.motion.stamp_ns, run.motion.poses)}
        ).rmse_m,
    })  # fmt: skip


def _mission_config(duration_s: float) -> MissionConfig:
    return MissionConfig(
        seed=1,
        num_vehicles=1,
        duration_s=duration_s,
        ping_rate_hz=_RATE_HZ,
        sonar=SonarConfig(num_beams=_NUM_BEAMS, num_ranges=_NUM_RANGES),
    )


def _image_of(store: Any, data: bytes) -> SonarImage:
    message = store.deserialize_cdr(data, "marine_acoustic_msgs/msg/ProjectedSonarImage")
    (event,) = read_projected(message, ReadSettings(data_order="range_major"))
    return event.image


def _navigation(mission: Any) -> list[Callable[[VehicleMapper], None]]:
    """For every ping a function that feeds what the instruments said since the one before."""
    run, log = mission.runs[0], mission.runs[0].navigation
    instruments = mission.config.instruments
    noise = np.eye(2) * instruments.dvl_noise_m_s**2
    # Navigation ahead of the ping by as much as the mapper waits for.
    edges = run.ping_motion.stamp_ns + _S // 10
    imu = np.searchsorted(log.imu_stamp_ns, edges, side="right")
    dvl = np.searchsorted(log.dvl_stamp_ns, edges, side="right")

    def feeder(i: int) -> Callable[[VehicleMapper], None]:
        first = (imu[i - 1], dvl[i - 1]) if i else (0, 0)

        def feed(mapper: VehicleMapper) -> None:
            for k in range(first[0], imu[i]):
                stamp_ns = int(log.imu_stamp_ns[k])
                mapper.add_imu(
                    stamp_ns, log.yaw_rad[k], log.yaw_rate_rad_s[k], instruments.yaw_noise_rad
                )
            for k in range(first[1], dvl[i]):
                stamp_ns = int(log.dvl_stamp_ns[k])
                mapper.add_velocity(stamp_ns, log.dvl_velocity_m_s[k], noise, T_BASE_DVL)

        return feed

    return [feeder(i) for i in range(run.num_pings)]


def _resident_mib() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def _closed_bytes(mapper: VehicleMapper) -> int:
    return sum(
        len(s.grid.data) + s.points.nbytes + s.weight.nbytes + s.trajectory.nbytes
        + s.stamps_ns.nbytes
        for s in mapper._submaps.closed
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(run_cases(__doc__.splitlines()[0], {"ping": ping, "memory": memory}))
