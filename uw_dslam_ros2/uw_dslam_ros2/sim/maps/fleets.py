"""Fleets of submaps with known poses, and matchers that know the truth.

Without sonar and navigation: for tests, studies and benchmarks of the merging alone. What depends
on chance depends on the seed and on the question alone, not on when it is asked.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field

import numpy as np

from uw_dslam_ros2.core.grid import FREE, OCCUPIED, UNKNOWN, GridSpec, OccupancyMap
from uw_dslam_ros2.core.merging import MapQueue, MatchRequest
from uw_dslam_ros2.core.metrics import align_points
from uw_dslam_ros2.core.registration.result import RegistrationResult, Verdict
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import Submap, SubmapId

__all__ = [
    "Fleet",
    "KnowingMatcher",
    "answer_all",
    "known_overlap",
    "lawnmower_fleet",
    "line_of_poses",
    "make_result",
    "make_walls",
    "refuse",
    "view_from",
]

_NS = 1_000_000_000


def make_walls(size_m: float, resolution_m: float, seed: int) -> OccupancyMap:
    """Free water with straight walls here and there, about one for each metre of its side."""
    rng = np.random.default_rng([seed, 1])
    num_cells = int(size_m / resolution_m)
    values = np.full((num_cells, num_cells), FREE, dtype=np.int8)
    for _ in range(int(size_m)):
        start, yaw = rng.uniform(0.0, size_m, 2), rng.uniform(-math.pi, math.pi)
        steps = np.arange(0.0, rng.uniform(3.0, 15.0), 0.5 * resolution_m)
        ends = start + steps[:, None] * (math.cos(yaw), math.sin(yaw))
        cells = np.floor(ends / resolution_m).astype(int)
        cells = cells[((cells >= 0) & (cells < num_cells)).all(axis=1)]
        values[cells[:, 1], cells[:, 0]] = OCCUPIED
    return OccupancyMap(GridSpec(resolution_m, num_cells, num_cells), values)


def view_from(world: OccupancyMap, T_world_submap: SE2, radius_m: float) -> OccupancyMap:
    """All of the world within a circle around a pose, in that pose's frame."""
    resolution_m = world.spec.resolution_m
    num_cells = math.ceil(2.0 * radius_m / resolution_m)
    spec = GridSpec(resolution_m, num_cells, num_cells, SE2(-radius_m, -radius_m))
    cells = np.argwhere(np.ones(spec.shape, dtype=np.bool_))
    centers = spec.centers_of(cells)
    seen = world.spec.cells_of(T_world_submap.apply(centers))
    is_known = world.spec.contains(seen) & (np.hypot(*centers.T) < radius_m)
    values = np.full(spec.shape, UNKNOWN, dtype=np.int8)
    known = cells[is_known]
    values[known[:, 0], known[:, 1]] = world.values[seen[is_known, 0], seen[is_known, 1]]
    return OccupancyMap(spec, values)


@dataclass
class Fleet:
    """Submaps of several vehicles in one world, with the truth."""

    world: OccupancyMap
    radius_m: float = 12.0
    sigma_m: float = 0.05
    sigma_rad: float = 0.005
    T_world_submap: dict[SubmapId, SE2] = field(default_factory=dict)
    submaps: dict[SubmapId, Submap] = field(default_factory=dict)

    def add_vehicle(self, name: str, poses: list[SE2], seed: int, run_id: int = 0) -> None:
        """Drive through poses in the world; odometry errs by the fleet's sigmas at each step.

        Each run of a vehicle has an odom frame of its own.
        """
        rng = np.random.default_rng([seed, 2])
        T_odom_submap = SE2.from_array(rng.uniform(-1.0, 1.0, 3) * (50.0, 50.0, math.pi))
        sigmas = np.array([self.sigma_m, self.sigma_m, self.sigma_rad])
        for sequence, T_world_submap in enumerate(poses):
            turn = np.eye(3)
            if sequence:
                step = poses[sequence - 1].inverse() @ T_world_submap
                error = SE2.from_array(rng.normal(size=3) * sigmas)
                T_odom_submap = T_odom_submap @ step @ error
                turn[:2, :2] = T_odom_submap.rotation()
            covariance = turn @ np.diag(sigmas**2) @ turn.T if sequence else np.zeros((3, 3))
            submap_id = SubmapId(name, run_id, sequence)
            self.T_world_submap[submap_id] = T_world_submap
            self.submaps[submap_id] = Submap(
                vehicle_id=name,
                sequence=sequence,
                revision=0,
                is_final=True,
                stamp_ns=(10 * sequence + 1) * _NS,
                T_odom_submap=T_odom_submap,
                covariance=covariance,
                grid=view_from(self.world, T_world_submap, self.radius_m),
                trajectory=np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.1]]),
                trajectory_stamp_ns=np.array([10 * sequence, 10 * sequence + 5]) * _NS + 10 * _NS,
                run_id=run_id,
            )

    def position_rmse_m(self, queue: MapQueue, component: int = 0) -> float:
        """RMSE of a component's submap positions after one rigid alignment with the truth [m]."""
        records = [r for r in queue.submaps() if r.component == component]
        found = np.array([r.T_component_submap.as_array()[:2] for r in records])
        truth = np.array([self.T_world_submap[r.submap.submap_id].as_array()[:2] for r in records])
        error = align_points(found, truth).apply(found) - truth
        return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def line_of_poses(start: SE2, num_poses: int, step_m: float, turn_rad: float = 0.0) -> list[SE2]:
    """Poses one after the other."""
    poses = [start]
    for _ in range(num_poses - 1):
        poses.append(poses[-1] @ SE2(step_m, 0.0, turn_rad))
    return poses


def lawnmower_fleet(
    num_vehicles: int, num_submaps: int, seed: int, *, step_m: float = 8.0, lane_m: float = 12.0
) -> Fleet:
    """Vehicles on parallel lanes, to and fro; each overlaps with its neighbours."""
    length_m = step_m * num_submaps
    size_m = max(length_m, lane_m * num_vehicles) + 60.0
    fleet = Fleet(make_walls(size_m, 0.5, seed))
    for index in range(num_vehicles):
        is_back = index % 2 == 1
        x_m = 30.0 + (length_m - step_m if is_back else 0.0)
        start = SE2(x_m, 30.0 + lane_m * index, math.pi if is_back else 0.0)
        poses = line_of_poses(start, num_submaps, step_m)
        fleet.add_vehicle(f"auv_{index + 1:02d}", poses, seed * 1000 + index)
    return fleet


def make_result(
    T_target_source: SE2, sigma_m: float = 0.05, sigma_rad: float = 0.005
) -> RegistrationResult:
    """Accept a transform with its errors; what the queue does not read is left plain."""
    return RegistrationResult(
        verdict=Verdict.ACCEPTED,
        reason="",
        T_target_source=T_target_source,
        covariance=np.diag([sigma_m**2, sigma_m**2, sigma_rad**2]),
        probability=0.99,
        score=0.8,
        lower_bound=0.8,
        upper_bound=0.8,
        is_certified=True,
        num_boxes=1,
        seconds=math.nan,
        overlap=0.5,
        conflict_ratio=0.0,
        inlier_ratio=0.9,
        num_source_points=100,
        num_target_points=100,
    )


def refuse(_request: MatchRequest) -> RegistrationResult:
    """Find nothing."""
    return RegistrationResult.refused(Verdict.NOT_ENOUGH_OVERLAP, "not enough overlap")


@dataclass
class KnowingMatcher:
    """Answers from the truth with noise, and refuses where the two maps share too little.

    A share of the answers is wrong: accepted, somewhere within the prior or anywhere.
    """

    fleet: Fleet
    seed: int = 0
    sigma_m: float = 0.05
    sigma_rad: float = 0.005
    min_overlap: float = 0.2
    wrong_share: float = 0.0
    num_asked: int = 0

    def __call__(self, request: MatchRequest) -> RegistrationResult:
        """Answer one request."""
        self.num_asked += 1
        sides = [
            f"({', '.join(i.stable_name for i in ids)}{',' * (len(ids) == 1)})"
            for ids in (request.source_ids, request.target_ids)
        ]
        question = f"({sides[0]}, {sides[1]}, {request.prior!r})".encode()
        digest = hashlib.blake2b(question, digest_size=8).digest()
        rng = np.random.default_rng([self.seed, int.from_bytes(digest)])
        if rng.random() < self.wrong_share:
            return make_result(self._lie(request, rng))
        truth = self.fleet.T_world_submap
        T_true = truth[request.target_reference].inverse() @ truth[request.source_reference]
        if known_overlap(request.source, request.target, T_true) < self.min_overlap:
            return refuse(request)
        noise = rng.normal(size=3) * (self.sigma_m, self.sigma_m, self.sigma_rad)
        return make_result(T_true @ SE2.from_array(noise), self.sigma_m, self.sigma_rad)

    def _lie(self, request: MatchRequest, rng: np.random.Generator) -> SE2:
        middle, reach = np.zeros(3), np.array([40.0, 40.0, math.pi])
        if (prior := request.prior) is not None:
            middle = prior.T_target_source.as_array()
            reach = np.array([prior.half_width_m, prior.half_width_m, prior.half_width_rad])
        return SE2.from_array(middle + rng.uniform(-1.0, 1.0, 3) * reach)


def known_overlap(source: OccupancyMap, target: OccupancyMap, T_target_source: SE2) -> float:
    """Area that both maps know, over that of the smaller one, in [0, 1]."""
    centers = source.spec.centers_of(np.argwhere(source.known))
    cells = target.spec.cells_of(T_target_source.apply(centers))
    cells = cells[target.spec.contains(cells)]
    shared = np.count_nonzero(target.known[cells[:, 0], cells[:, 1]])
    return shared / min(np.count_nonzero(source.known), np.count_nonzero(target.known))


def answer_all(queue: MapQueue, matcher, batch: int = 3) -> int:  # type: ignore[no-untyped-def]
    """Answer everything that the queue asks, until it comes to rest; return how much that was."""
    count = 0
    while requests := queue.next_requests(batch):
        for request in requests:
            queue.add_result(request.request_id, matcher(request))
            count += 1
    return count
