"""Submaps of simulated vehicles for the studies of the merging, made once for each seed."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import uw_dslam_ros2
from uw_dslam_ros2.cli.reporting.scoring import Truth, read_truth
from uw_dslam_ros2.cli.running.mapping import OfflineConfig, map_recording
from uw_dslam_ros2.core.merging import MapQueue
from uw_dslam_ros2.core.submap import Submap
from uw_dslam_ros2.io.maps.files import write_map
from uw_dslam_ros2.io.sessions.session import load_session, save_session
from uw_dslam_ros2.io.trajectories import write_tum
from uw_dslam_ros2.io.vehicles import recordings_of
from uw_dslam_ros2.sim.missions.mission import MissionConfig
from uw_dslam_ros2.sim.missions.recording import simulate_mission
from uw_dslam_ros2.sim.sonars.imaging import SonarConfig

__all__ = ["FleetMission", "code_digest", "demo_mission", "mapped_bags", "simulated_mission"]

_PARTS = ("sim", "core/sonar", "core/navigation", "core/mapping", "core/registration")


@dataclass(frozen=True, slots=True, eq=False)
class FleetMission:
    """What the vehicles of one mission made, each by itself, and the truth."""

    name: str
    submaps: tuple[Submap, ...]
    truth: Truth


def simulated_mission(
    seed: int, num_vehicles: int, duration_s: float, place: str, cache: Path
) -> FleetMission:
    """Simulate and map a mission with a small sonar, or take it from the cache.

    What is cached is made anew when the configuration or the code that makes it has changed.
    """
    config = MissionConfig(
        seed=seed,
        place=place,
        num_vehicles=num_vehicles,
        duration_s=duration_s,
        ping_rate_hz=2.0,
        truth_resolution_m=0.1,
        sonar=SonarConfig(num_beams=128, num_ranges=250),
    )
    return _cached(f"{place}_{seed}", config, cache)


def demo_mission(seed: int, cache: Path) -> FleetMission:
    """Simulate and map the mission of ``./uw demo``, or take it from the cache."""
    return _cached(f"demo_{seed}", MissionConfig(seed=seed), cache)


def _cached(name: str, config: MissionConfig, cache: Path) -> FleetMission:
    folder = cache / f"{name}_{code_digest(repr(config.to_dict()), *_PARTS)}"
    if not (folder / "done").exists():
        with TemporaryDirectory() as work:
            mission = simulate_mission(Path(work) / "mission", config)
            _store(folder, mapped_bags(name, mission.bags, mission.truth_map.parent, None))
    submaps = [record.submap for record in load_session(folder).submaps()]
    return FleetMission(name, tuple(submaps), read_truth(folder / "truth"))


def mapped_bags(
    name: str, bags: tuple[Path, ...], truth: Path, settings: Path | None
) -> FleetMission:
    """Map each bag by itself, one after the other."""
    recordings = recordings_of(bags)
    config = OfflineConfig.read(settings, [recording.vehicle_id for recording in recordings])
    submaps: list[Submap] = []
    for recording in recordings:
        vehicle = recording.vehicle_id
        mapped = map_recording(recording, config.mapper[vehicle], config.sensors[vehicle])
        submaps += mapped.submaps
    return FleetMission(name, tuple(submaps), read_truth(truth))


def _store(folder: Path, mission: FleetMission) -> None:
    queue = MapQueue()
    for submap in mission.submaps:
        queue.add_submap(submap)
    save_session(folder, queue)
    (folder / "truth").mkdir(exist_ok=True)
    for vehicle, trajectory in mission.truth.trajectories.items():
        write_tum(folder / "truth" / f"{vehicle}.tum", *trajectory)
    if mission.truth.map is not None:
        write_map(folder / "truth" / "map", mission.truth.map)
    (folder / "done").touch()


def code_digest(configuration: str, *parts: str) -> str:
    """Of a configuration and of all code in some folders of the package."""
    root = Path(uw_dslam_ros2.__file__).parent
    hasher = hashlib.blake2b(configuration.encode(), digest_size=6)
    for part in parts:
        for path in sorted((root / part).rglob("*.py")):
            hasher.update(path.read_bytes())
    return hasher.hexdigest()
