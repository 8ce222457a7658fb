"""The covariance of a match of maps, against gradients, scatter and straight walls."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from uw_dslam_ros2.core.features.grid_filter import clean_cells
from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.registration.grids.judging.agreement import WallMap
from uw_dslam_ros2.core.registration.grids.judging.covariance import (
    curvature,
    pose_spread,
)
from uw_dslam_ros2.core.registration.grids.problem import GridProblem, build_problem
from uw_dslam_ros2.core.se2 import SE2, wrap_angle
from uw_dslam_ros2.sim.maps.pairs import MapPair, make_pair

_SIGMA_CELLS = 2.0
_NUM_DEGREES = 3.0  # of freedom: the expectation of a NEES


_PAIR = MapPair("corridor", "clean", 1.0, None, None, SE2())


def _problem(pair: MapPair) -> GridProblem:
    return build_problem(
        clean_cells(pair.source), clean_cells(pair.target),
        stride=1, sigma_cells=_SIGMA_CELLS, free_penalty=0.7, max_points=1200,
    )  # fmt: skip


def _seen(pair: MapPair) -> tuple[np.ndarray, np.ndarray]:
    source, target = (WallMap(clean_cells(m)) for m in (pair.source, pair.target))
    return source.seen, target.seen


def _truth(pair: MapPair, problem: GridProblem) -> np.ndarray:
    target, source = pair.target.spec.T_frame_grid, pair.source.spec.T_frame_grid
    return problem.pose_of(target.inverse() @ pair.T_target_source @ source)


@pytest.fixture(scope="module")
def pair() -> MapPair:
    return make_pair("harbour", 0.7, "noisy", 4, size_cells=160)


def test_the_points_gradients_add_up_to_that_of_the_objective(pair):
    problem = _problem(pair)
    pose = _truth(pair, problem) + np.array([0.01, 0.7, -0.4])
    gradients, places = problem.point_gradients(pose)
    assert gradients.sum(axis=0) == pytest.approx(problem.gradient(pose), abs=1e-12)
    turned = SE2(*pose[1:], pose[0]).apply(problem.source_points)
    assert places[: len(turned)] == pytest.approx(turned)
    assert np.array_equal(places[len(turned) :], problem.target_points)


def test_the_curvature_is_that_of_finite_differences_of_the_value(pair):
    problem = _problem(pair)
    pose, value = problem.ascend(_truth(pair, problem))
    hessian = curvature(problem, pose)
    assert np.array_equal(hessian, hessian.T)
    for axis, scale in enumerate((1.0 / problem.radius, 1.0, 1.0)):
        step = np.zeros(3)
        step[axis] = 0.5 * scale
        ahead, behind = problem.value(pose + step), problem.value(pose - step)
        assert (2.0 * value - ahead - behind) / 0.25 == pytest.approx(hessian[axis, axis], rel=0.2)


@pytest.mark.parametrize(("noise", "most"), [("clean", 2.0), ("noisy", 2.0), ("hard", 3.0)])
def test_errors_of_other_places_are_about_as_large_as_stated(noise, most):
    """Squared errors over covariance, on average over places: neither proud nor timid."""
    nees = []
    for kind in ("harbour", "office", "lake"):
        for seed in range(40, 46):
            pair = make_pair(kind, 0.7, noise, seed, size_cells=200)
            problem = _problem(pair)
            pose, _ = problem.ascend(_truth(pair, problem))
            error = pose - _truth(pair, problem)
            error[0] = wrap_angle(error[0])
            covariance = pose_spread(problem, pose, _SIGMA_CELLS, _seen(pair)).covariance
            nees.append(float(error @ np.linalg.solve(covariance, error)))
    assert 0.2 * _NUM_DEGREES < np.mean(nees) < most * _NUM_DEGREES
    assert np.mean(np.array(nees) > 7.81) <= 0.25  # 95 % quantile of three degrees of freedom


@pytest.mark.kernels
def test_a_covariance_is_symmetric_and_positive(pair):
    problem = _problem(pair)
    pose, _ = problem.ascend(_truth(pair, problem))
    covariance = pose_spread(problem, pose, _SIGMA_CELLS, _seen(pair)).covariance
    assert covariance == pytest.approx(covariance.T)
    assert np.linalg.eigvalsh(covariance).min() > 0.0


def _corridor(bays: list[int], thickness: int = 2) -> OccupancyMap:
    """A corridor of 240 cells with bays of ten cells in one of its walls."""
    values = np.full((60, 240), -1, np.int8)
    values[20:40] = 0
    for start in bays:
        values[40:50, start : start + 10] = 0
    walls = cv2.dilate((values == 0).astype(np.uint8), np.ones((2 * thickness + 1,) * 2)) > 0
    values[walls & (values < 0)] = 100
    values[:, :2] = values[:, -2:] = -1
    return OccupancyMap(GridSpec(0.05, *values.shape), values)


@pytest.mark.parametrize(("bays", "least", "most"), [
    ([], 30.0, math.inf), ([50, 110, 190], 0.0, 30.0), ([20, 60, 110, 150, 200], 0.0, 2.0),
])  # fmt: skip
@pytest.mark.parametrize("thickness", [1, 4])
def test_a_corridor_is_fixed_along_as_well_as_its_bays_fix_it(bays, least, most, thickness):
    """However thick its walls are, and across in any case."""
    corridor = _corridor(bays, thickness)
    pair = replace(_PAIR, source=corridor, target=corridor)
    problem = _problem(pair)
    pose = problem.pose_of(SE2())
    spread = pose_spread(problem, pose, _SIGMA_CELLS, _seen(pair))
    assert least <= spread.weakest_cells <= most
    assert np.sqrt(spread.covariance[2, 2]) < 1.0
    along = np.sqrt(spread.covariance[1, 1])
    assert along == pytest.approx(spread.weakest_cells, rel=0.2)
