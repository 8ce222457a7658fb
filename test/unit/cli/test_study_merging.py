"""The study of the merging scores what it is given: truth is without error, a shift is not."""

import re
from dataclasses import replace

import numpy as np
import pytest

from uw_dslam_ros2.cli.reporting.scoring import Truth
from uw_dslam_ros2.cli.studies import merging
from uw_dslam_ros2.cli.studies._fleet_missions import FleetMission
from uw_dslam_ros2.core.merging import MatchRequest
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.maps.fleets import KnowingMatcher, known_overlap, lawnmower_fleet, view_from


@pytest.fixture(scope="module")
def fleet():
    return lawnmower_fleet(3, 3, 0)


@pytest.fixture(scope="module")
def mission(fleet):
    """A fleet as a mission, with the true trajectories and the world as the true map."""
    true: dict[str, dict[int, np.ndarray]] = {}
    for submap_id, submap in fleet.submaps.items():
        for stamp_ns, pose in zip(submap.trajectory_stamp_ns, submap.trajectory, strict=True):
            motion = fleet.T_world_submap[submap_id] @ SE2.from_array(pose)
            true.setdefault(submap_id[0], {})[int(stamp_ns)] = motion.as_array()
    trajectories = {
        name: (np.array(sorted(poses)), np.array([poses[s] for s in sorted(poses)]))
        for name, poses in true.items()
    }
    return FleetMission("fleet", tuple(fleet.submaps.values()), Truth(trajectories, fleet.world))


def test_true_poses_have_no_error(mission):
    placing = merging._true_placing(mission)
    row = merging._row(mission, "true poses", placing, 0, 0.0)
    assert row["rmse_m"] == pytest.approx(0.0, abs=1e-6)
    assert row["vehicles"] == row["of"] == 3


def test_a_vehicle_in_a_wrong_place_counts(mission):
    placing = merging._true_placing(mission)
    shifted = {i: SE2(3.0, 0.0) @ T if i[0] == "auv_02" else T for i, T in placing.items()}
    row = merging._row(mission, "shifted", shifted, 0, 0.0)
    # One third is off by 3 m; the best common motion leaves sqrt(2)/3 of that.
    assert row["rmse_m"] == pytest.approx(3.0 * np.sqrt(2.0) / 3.0, rel=0.05)
    good = merging._row(mission, "true poses", placing, 0, 0.0)
    assert row["ssim"] < good["ssim"]
    assert row["mse"] > good["mse"]
    assert row["iou"] < good["iou"]


def test_who_stayed_apart_is_named_with_what_was_in_common(mission, fleet):
    placing = merging._true_placing(mission)
    assert merging._row(mission, "all", placing, 0, 0.0)["apart"] == ""
    without = {submap_id: T for submap_id, T in placing.items() if submap_id[0] != "auv_02"}
    told = merging._row(mission, "two", without, 0, 0.0)["apart"]
    found = re.fullmatch(
        r"auv_02 has (\d+)% of the area and (\d+)% of its walls in common, "
        r"asked near the truth ACCEPTED at (\S+)",
        told,
    )
    assert found
    area, walls, probability = map(float, found.groups())
    # Lanes side by side: the largest share of one submap in another is less than of all in all.
    largest = max(
        known_overlap(fleet.submaps[a].grid, fleet.submaps[b].grid,
                      placing[b].inverse() @ placing[a])
        for a in placing if a[0] == "auv_02" for b in without
    )  # fmt: skip
    assert 100.0 * largest <= area <= 100.0
    assert 0.0 < walls <= 100.0
    assert probability >= 0.75


def test_who_shares_water_and_no_wall_is_told_so(mission):
    """One vehicle's map without its walls: all of the area is in common, and nothing else."""
    placing = merging._true_placing(mission)
    without = {submap_id: T for submap_id, T in placing.items() if submap_id[0] != "auv_02"}
    blind = tuple(
        replace(s, grid=replace(s.grid, values=np.where(s.grid.values > 50, 0, s.grid.values)))
        if s.vehicle_id == "auv_02" else s
        for s in mission.submaps
    )  # fmt: skip
    told = merging._row(replace(mission, submaps=blind), "two", without, 0, 0.0)["apart"]
    assert "ACCEPTED" not in told
    assert told.startswith("auv_02 has ")


def test_methods_share_the_queue_and_differ_in_what_answers(mission, fleet):
    matcher = KnowingMatcher(fleet)
    ours = merging._merged(mission, merging._Method("graph", matcher))
    paper = merging._merged(mission, merging._Method("pairwise", matcher))
    assert len(ours[0]) == len(paper[0]) == 9
    assert paper[1] == 2
    assert ours[1] > 2


@pytest.mark.parametrize("matcher", [merging._icp, merging._ndt])
def test_baselines_find_a_small_motion(matcher, fleet):
    """Two views of one place, a metre and a few degrees apart: any method should manage."""
    ids = (("auv_01", 0),)
    T_world_target = SE2(38.0, 35.0, 0.2)
    T_world_source = T_world_target @ SE2(1.0, -0.5, 0.05)
    source, target = (view_from(fleet.world, T, 12.0) for T in (T_world_source, T_world_target))
    found = matcher(
        MatchRequest(1, source, target, None, ids, ids, ids[0], ids[0], (b"", b"", ()))
    )
    error_m, error_rad = found.T_target_source.distance_to(SE2(1.0, -0.5, 0.05))
    assert error_m < 0.5
    assert error_rad < 0.05
