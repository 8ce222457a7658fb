"""Fixes pull a graph as far as they are surer than it, and a wrong one pulls nothing."""

import dataclasses
import itertools
import math

import numpy as np
import pytest

from uw_dslam_ros2.core.merging.steering.georeference import Fix, pulled_by_fixes
from uw_dslam_ros2.core.merging.types import Edge
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId

NUM = 30
IDS = [SubmapId("auv_1", 1, k) for k in range(NUM)]
T_EARTH_MAP = SE2(512_345.6, 5_912_345.6, 2.5)
SIGMAS = np.array([0.15, 0.15, 0.02])  # of each step's odometry
FIX_SIGMA_M = 0.3


def true_poses():
    """A loop of 20 m steps in the first submap's frame, which turns on its way."""
    poses = [SE2()]
    for k in range(NUM - 1):
        poses.append(poses[-1] @ SE2(20.0, 0.0, 0.25 if k % 3 else -0.1))
    return dict(zip(IDS, poses, strict=True))


def graph(rng=None):
    """Odometry edges, and the poses that follow from them; exact without a generator."""
    true = true_poses()
    edges, poses = [], {IDS[0]: SE2()}
    for before, after in itertools.pairwise(IDS):
        motion = true[before].inverse() @ true[after]
        if rng is not None:
            motion = motion @ SE2.from_array(rng.normal(size=3) * SIGMAS)
        edges.append(Edge(after, before, motion, np.diag(SIGMAS**2)))
        poses[after] = poses[before] @ motion
    return edges, poses


def fix(number, rng=None, off=(0.0, 0.0), **rest):
    submap_id, point = IDS[number], (3.0, -2.0)
    pose = T_EARTH_MAP @ true_poses()[submap_id]
    x, y = pose.apply(np.array(point)) + off
    if rng is not None:
        x, y = np.array([x, y]) + rng.normal(size=2) * FIX_SIGMA_M
    values = {"sigma_m": FIX_SIGMA_M, "sigma_rad": math.inf, "earth_frame": "EPSG:32632"} | rest
    return Fix(submap_id, point, SE2(float(x), float(y), pose.yaw), **values)


def errors_m(poses, T_earth_map=T_EARTH_MAP):
    """How far each submap is off on earth."""
    true = true_poses()
    return [(T_earth_map @ poses[i]).distance_to(T_EARTH_MAP @ true[i])[0] for i in IDS]


def test_an_exact_graph_stays_as_it_is():
    edges, poses = graph()
    pulled, found = pulled_by_fixes(poses, edges, [fix(k) for k in (0, 9, 17, 29)])
    assert max(errors_m(pulled, found.T_earth_map)) < 1e-4
    assert max(fit.metres_off for fit in found.fits) < 1e-4
    assert all(fit.is_used for fit in found.fits)


def test_three_fixes_halve_the_error_of_a_graph_that_drifted(rng):
    before, after = [], []
    for _ in range(20):
        edges, poses = graph(rng)
        fixes = [fix(k, rng) for k in (0, 14, 29)]
        pulled, found = pulled_by_fixes(poses, edges, fixes)
        rigid, placed = pulled_by_fixes(poses, [], fixes)
        assert rigid == poses
        assert all(fit.is_used for fit in found.fits)
        before.append(np.mean(errors_m(poses, placed.T_earth_map)))
        after.append(np.mean(errors_m(pulled, found.T_earth_map)))
    assert np.mean(after) < 0.5 * np.mean(before)


def test_sigmas_say_how_far_a_fix_pulls(rng):
    edges, poses = graph(rng)
    fixes = [fix(k) for k in (0, 14, 29)]
    off = []
    for sigma_m in (0.01, 0.3, 10.0, 1000.0):
        said = [dataclasses.replace(one, sigma_m=sigma_m) for one in fixes]
        pulled, found = pulled_by_fixes(poses, edges, said)
        off.append(max(fit.metres_off for fit in found.fits))
        moved = max(pulled[i].distance_to(poses[i])[0] for i in IDS)
    assert off == sorted(off)
    assert off[0] < 0.01
    assert moved < 0.05, "what says nothing pulls nothing"


@pytest.mark.parametrize("num_good", [3, 5])
@pytest.mark.parametrize("off", [(0.0, 40.0), (-500.0, 90.0)])
def test_a_wrong_fix_is_set_aside_and_told(rng, num_good, off):
    for wrong in (4, 20):
        edges, poses = graph(rng)
        good = [fix(k, rng) for k in np.linspace(0, NUM - 1, num_good).astype(int).tolist()]
        without, _ = pulled_by_fixes(poses, edges, good)
        fixes = [*good, fix(wrong, off=off)]
        pulled, found = pulled_by_fixes(poses, edges, fixes)
        assert [fit.is_used for fit in found.fits] == [True] * num_good + [False]
        assert found.fits[-1].metres_off == pytest.approx(math.hypot(*off), rel=0.25)
        assert max(pulled[i].distance_to(without[i])[0] for i in IDS) < 1e-3


def test_one_fix_alone_places_and_does_not_bend(rng):
    edges, poses = graph(rng)
    pulled, found = pulled_by_fixes(poses, edges, [fix(7)])
    assert pulled == poses
    assert "one more fix" in found
    pulled, found = pulled_by_fixes(poses, edges, [fix(7, sigma_rad=0.01)])
    assert pulled == poses
    assert found.fits[0].metres_off < 1e-6
    assert found.fits[0].sigmas_off < 1e-6


def test_two_that_deny_each_other_bend_nothing_and_are_told(rng):
    edges, poses = graph(rng)
    pulled, found = pulled_by_fixes(poses, edges, [fix(2), fix(11, off=(300.0, 0.0))])
    assert pulled == poses
    assert [fit.is_used for fit in found.fits] == [False, False]
    assert min(fit.metres_off for fit in found.fits) > 10.0


def test_the_order_of_fixes_does_not_matter(rng):
    edges, poses = graph(rng)
    fixes = [fix(k, rng) for k in range(0, NUM, 2)] + [fix(5, off=(60.0, 0.0))]
    pulled, found = pulled_by_fixes(poses, edges, fixes)
    again, other = pulled_by_fixes(poses, edges, fixes[::-1])
    assert max(pulled[i].distance_to(again[i])[0] for i in IDS) < 1e-5
    assert [fit.is_used for fit in found.fits] == [fit.is_used for fit in other.fits[::-1]]


def test_fixes_elsewhere_and_in_two_frames_are_told():
    edges, poses = graph()
    stranger = dataclasses.replace(fix(0), submap_id=SubmapId("auv_9", 1, 0))
    assert pulled_by_fixes(poses, edges, [stranger]) == (
        poses,
        "no fix of a submap that is in the map",
    )
    _, found = pulled_by_fixes(poses, edges, [fix(0), fix(20, earth_frame="EPSG:32633")])
    assert "EPSG:32632 and in EPSG:32633" in found
