import hashlib
import itertools
from dataclasses import replace

import numpy as np
import pytest

from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.mounting import StaticFrames, fan_mount
from uw_dslam_ros2.io.bags import ImageEvent, ImuEvent, TransformEvent, TruthEvent, read_events
from uw_dslam_ros2.io.maps.files import read_map
from uw_dslam_ros2.io.trajectories import read_tum
from uw_dslam_ros2.sim.missions.mission import (
    T_BASE_DVL,
    T_BASE_SONAR,
    MissionConfig,
    every_metre,
    plan_mission,
    tiny_mission_config,
)
from uw_dslam_ros2.sim.missions.recording import read_mission, simulate_mission
from uw_dslam_ros2.sim.waters.raster import grid_over, seen_map

SHORT = replace(tiny_mission_config(), duration_s=4.0, truth_resolution_m=0.5)


def default_config(seed):
    return MissionConfig(seed=seed)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return simulate_mission(tmp_path_factory.mktemp("missions") / "tiny", tiny_mission_config())


def digest(folder):
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def test_same_seed_same_bytes_whatever_the_processes(tmp_path):
    simulate_mission(tmp_path / "a", SHORT)
    simulate_mission(tmp_path / "b", SHORT, num_processes=2)
    simulate_mission(tmp_path / "c", replace(SHORT, seed=1))
    first, second, other = (digest(tmp_path / name) for name in "abc")
    assert first == second
    assert first["auv_1/auv_1.mcap"] != other["auv_1/auv_1.mcap"]


def test_both_storages_hold_the_same(tmp_path):
    config = replace(SHORT, duration_s=3.0)
    events = []
    for storage in ("mcap", "sqlite3"):
        mission = simulate_mission(tmp_path / storage, config, storage=storage)
        events.append(list(read_events(mission.bags)))
    assert [(type(e), e.stamp_ns) for e in events[0]] == [(type(e), e.stamp_ns) for e in events[1]]


def test_bags_hold_every_topic_in_order_of_time(tiny):
    for bag, who in zip(tiny.bags, tiny.vehicle_ids, strict=True):
        events = list(read_events(bag))
        stamps = [e.stamp_ns for e in events if not isinstance(e, TransformEvent)]
        assert stamps == sorted(stamps)
        assert {e.vehicle_id for e in events} == {who}
        rates = {
            kind.__name__: sum(isinstance(e, kind) for e in events) / 60.0
            for kind in (ImageEvent, ImuEvent, TruthEvent)
        }
        assert rates["ImageEvent"] == pytest.approx(2.0, abs=0.1)
        assert rates["ImuEvent"] == pytest.approx(25.0, abs=0.2)
        assert rates["TruthEvent"] == pytest.approx(10.0, abs=0.2)


def test_mounts_in_the_bag_are_those_of_the_simulation(tiny):
    frames = StaticFrames()
    for event in read_events(tiny.bags[0]):
        if isinstance(event, TransformEvent):
            frames.add(event.frame_id, event.child_frame_id, event.T_parent_child)
    base = "auv_1/base_link"
    sonar = fan_mount(frames.lookup(base, "auv_1/sonar"), "z")
    assert sonar.T_base_fan.as_array() == pytest.approx(T_BASE_SONAR.as_array())
    assert sonar.projection is None
    dvl = frames.lookup(base, "auv_1/dvl")
    assert dvl[:2, 3] == pytest.approx(T_BASE_DVL.as_array()[:2])
    np.testing.assert_allclose(dvl[:3, 2], [0.0, 0.0, -1.0], atol=1e-12)


def test_bright_pixels_lie_on_true_walls_when_placed_by_the_truth(tiny):
    """The whole chain: simulator, message, bag, reader, frames, truth. A mirrored or shifted
    convention anywhere puts the echoes off the walls.
    """  # noqa: D205
    truth_map = read_map(tiny.truth_map)
    walls = np.argwhere(truth_map.values == 100)
    stamps, poses = read_tum(tiny.truth_trajectories[0])
    distances = []
    for event in read_events(tiny.bags[0]):
        if not isinstance(event, ImageEvent):
            continue
        image = event.image
        rows, beams = np.nonzero(image.intensity > 170)
        if len(rows) == 0:
            continue
        x, y, yaw = (
            np.interp(image.stamp_ns, stamps, np.unwrap(c) if i == 2 else c)
            for i, c in enumerate(poses.T)
        )
        angle = yaw + image.bearing_rad[beams]
        sonar = np.array([x + 0.3 * np.cos(yaw), y + 0.3 * np.sin(yaw)])
        points = sonar + image.range_m[rows, None] * np.column_stack(
            [np.cos(angle), np.sin(angle)]
        )
        cells = truth_map.spec.cells_of(points[:40])
        nearest = np.sqrt(((cells[:, None] - walls[None]) ** 2).sum(axis=2).min(axis=1))
        distances.append(nearest * truth_map.spec.resolution_m)
    distances = np.concatenate(distances)
    assert len(distances) > 500
    assert np.median(distances) < 0.2
    assert np.quantile(distances, 0.9) < 0.6


def test_truth_trajectory_is_that_of_the_bag(tiny):
    stamps, poses = read_tum(tiny.truth_trajectories[1])
    truth = [e for e in read_events(tiny.bags[1]) if isinstance(e, TruthEvent)]
    assert [e.stamp_ns for e in truth] == stamps.tolist()
    ours = np.array([e.T_world_base.as_array() for e in truth])
    np.testing.assert_allclose(ours[:, :2], poses[:, :2], atol=1e-6)
    start = tiny.summary["vehicles"][1]["T_map_start"]
    np.testing.assert_allclose(start, ours[0], atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("make_config", "low", "high"), [(tiny_mission_config, 0.4, 1.0), (default_config, 0.15, 0.8)]
)
def test_neighbours_see_a_good_part_of_the_same_walls(make_config, low, high, seed):
    mission = plan_mission(make_config(seed))
    spec = grid_over(mission.world, 0.5)
    walls = [
        seen_map(mission.world, spec, every_metre(run), np.radians(130.0), 30.0).values == 100
        for run in mission.runs
    ]
    for a, b in itertools.pairwise(walls):
        assert low < (a & b).sum() / min(a.sum(), b.sum()) < high


@pytest.mark.parametrize("place", ["harbour", "lake"])
@pytest.mark.parametrize("seed", range(3))
def test_vehicles_stay_clear_of_everything(place, seed):
    config = MissionConfig(seed=seed, place=place, duration_s=150.0)
    mission = plan_mission(config)
    fan = np.linspace(-np.pi, np.pi, 90)
    for run in mission.runs:
        for x, y, _ in run.motion.poses[::100]:
            nearest = mission.world.cast((x, y), fan, 50.0).range_m.min()
            assert nearest > 0.5 * config.clearance_m


def test_the_default_mission_fits_its_budget(tmp_path):
    config = MissionConfig(num_vehicles=1, duration_s=10.0)
    mission = simulate_mission(tmp_path / "m", config)
    size = sum(f.stat().st_size for f in mission.bags[0].iterdir())
    default = MissionConfig()
    assert size * default.num_vehicles * default.duration_s / config.duration_s < 200e6


def test_a_mission_is_not_overwritten(tiny):
    with pytest.raises(DataError, match="holds a mission already"):
        simulate_mission(tiny.folder, tiny_mission_config())


def test_an_interrupted_run_leaves_nothing_and_can_be_repeated(tmp_path):
    folder = tmp_path / "m"

    def stop(_done, _total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_mission(folder, SHORT, progress=stop)
    assert list(folder.iterdir()) == []
    # Killed, it cannot clean up; the next run does.
    (folder / ".partial" / "auv_1").mkdir(parents=True)
    (folder / ".partial" / "auv_1" / "auv_1.mcap").write_bytes(b"half")
    mission = simulate_mission(folder, SHORT)
    assert not (folder / ".partial").exists()
    assert all(bag.exists() for bag in mission.bags)


def test_a_folder_without_mission_is_named(tmp_path, tiny):
    with pytest.raises(DataError, match=r"mission\.json is not a mission's description"):
        read_mission(tmp_path)
    assert read_mission(tiny.folder).bags == tiny.bags
