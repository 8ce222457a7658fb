"""A small place, vehicles with known poses in it, and matchers that know or refuse to know."""

import math
from dataclasses import dataclass, field

import numpy as np

from uw_dslam_ros2.core.grid import GridSpec, OccupancyMap
from uw_dslam_ros2.core.mapping.submap import Submap, SubmapId
from uw_dslam_ros2.core.merging import MapQueue, MatchRequest
from uw_dslam_ros2.core.registration.result import RegistrationResult, Verdict
from uw_dslam_ros2.core.se2 import SE2

RESOLUTION_M = 0.5
RADIUS_M = 12.0


def place(seed: int = 0, size_m: float = 120.0) -> OccupancyMap:
    """Free water with a few dozen walls, in the world frame."""
    rng = np.random.default_rng(seed)
    num_cells = int(size_m / RESOLUTION_M)
    values = np.zeros((num_cells, num_cells), dtype=np.int8)
    for _ in range(int(size_m)):
        start, yaw = rng.uniform(0.0, size_m, 2), rng.uniform(-math.pi, math.pi)
        steps = np.arange(0.0, rng.uniform(3.0, 15.0), 0.5 * RESOLUTION_M)
        ends = start + steps[:, None] * (math.cos(yaw), math.sin(yaw))
        cells = np.floor(ends / RESOLUTION_M).astype(int)
        cells = cells[((cells >= 0) & (cells < num_cells)).all(axis=1)]
        values[cells[:, 1], cells[:, 0]] = 100
    return OccupancyMap(GridSpec(RESOLUTION_M, num_cells, num_cells), values)


def view_of(world: OccupancyMap, T_world_submap: SE2, radius_m: float = RADIUS_M) -> OccupancyMap:
    """What a submap at a pose holds: all within a circle."""
    num_cells = math.ceil(2 * radius_m / RESOLUTION_M)
    spec = GridSpec(RESOLUTION_M, num_cells, num_cells, SE2(-radius_m, -radius_m))
    cells = np.argwhere(np.ones(spec.shape, dtype=bool))
    centers = spec.centers_of(cells)
    seen = world.spec.cells_of(T_world_submap.apply(centers))
    is_known = world.spec.contains(seen) & (np.hypot(*centers.T) < radius_m)
    values = np.full(spec.shape, -1, dtype=np.int8)
    known = cells[is_known]
    values[known[:, 0], known[:, 1]] = world.values[seen[is_known, 0], seen[is_known, 1]]
    return OccupancyMap(spec, values)


@dataclass
class Fleet:
    """Submaps of several vehicles, with the truth."""

    world: OccupancyMap
    T_world_submap: dict[SubmapId, SE2] = field(default_factory=dict)
    submaps: dict[SubmapId, Submap] = field(default_factory=dict)
    sigma_m: float = 0.05
    sigma_rad: float = 0.005

    def add_vehicle(self, name: str, poses: list[SE2], seed: int = 0) -> None:
        """Drive through poses in the world, from an odom frame somewhere else, with noise."""
        rng = np.random.default_rng(seed)
        T_odom = SE2(*rng.uniform(-50, 50, 2), rng.uniform(-math.pi, math.pi))
        sigmas = np.array([self.sigma_m, self.sigma_m, self.sigma_rad])
        for sequence, T_world in enumerate(poses):
            if sequence:
                step = poses[sequence - 1].inverse() @ T_world
                noise = SE2.from_array(rng.normal(size=3) * sigmas)
                T_odom = T_odom @ step @ noise
            submap_id = name, sequence
            self.T_world_submap[submap_id] = T_world
            self.submaps[submap_id] = Submap(
                name,
                sequence,
                0,
                True,
                1_000_000_000 * (10 * sequence + 1),
                T_odom,
                np.diag(sigmas**2) if sequence else np.zeros((3, 3)),
                view_of(self.world, T_world),
                trajectory=np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.1]]),
                trajectory_stamp_ns=np.array([10, 15]) * 1_000_000_000 + 10**10 * sequence,
            )

    def position_error_m(self, queue: MapQueue) -> float:
        """RMSE of the merged submaps' positions after the best rigid alignment to the truth."""
        records = [r for r in queue.submaps() if r.component == 0]
        found = np.array([r.T_component_submap.as_array()[:2] for r in records])
        truth = np.array([self.T_world_submap[r.submap.submap_id].as_array()[:2] for r in records])
        found, truth = found - found.mean(axis=0), truth - truth.mean(axis=0)
        u, _, vt = np.linalg.svd(found.T @ truth)
        u[:, -1] *= np.sign(np.linalg.det(u @ vt))
        return float(np.sqrt(np.mean(np.sum((found @ u @ vt - truth) ** 2, axis=1))))


def line(start: SE2, num_submaps: int, step_m: float = 8.0, turn: float = 0.0) -> list[SE2]:
    """Poses one after the other."""
    poses = [start]
    for _ in range(num_submaps - 1):
        poses.append(poses[-1] @ SE2(step_m, 0.0, turn))
    return poses


def three_vehicles(seed: int = 0, num_submaps: int = 4) -> Fleet:
    """Three parallel lines, overlapping with their neighbours."""
    fleet = Fleet(place(seed))
    fleet.add_vehicle("auv_1", line(SE2(30.0, 40.0, 0.0), num_submaps), seed + 1)
    fleet.add_vehicle("auv_2", line(SE2(62.0, 52.0, math.pi), num_submaps), seed + 2)
    fleet.add_vehicle("auv_3", line(SE2(30.0, 64.0, 0.1), num_submaps), seed + 3)
    return fleet


def result_of(
    verdict: Verdict,
    T_target_source: SE2,
    sigma_m: float = 0.05,
    sigma_rad: float = 0.005,
    reason: str = "",
) -> RegistrationResult:
    """A registration's answer with the numbers that the queue does not read left plain."""
    return RegistrationResult(
        verdict,
        reason or verdict.name,
        T_target_source,
        np.diag([sigma_m**2, sigma_m**2, sigma_rad**2]),
        0.99,
        0.8,
        0.8,
        0.8,
        True,
        1,
        math.nan,
        0.5,
        0.0,
        0.9,
        100,
        100,
    )


@dataclass
class Oracle:
    """Answers from the truth with noise, and refuses where the two maps share too little.

    Noise and mistakes depend on the question alone, not on when it is asked.
    """

    fleet: Fleet
    sigma_m: float = 0.05
    sigma_rad: float = 0.005
    min_overlap: float = 0.2
    wrong_share: float = 0.0
    seed: int = 0
    num_asked: int = 0

    def __call__(self, request: MatchRequest) -> RegistrationResult:
        """Answer one request."""
        self.num_asked += 1
        prior = request.prior.T_target_source.as_array() if request.prior else np.zeros(3)
        question = repr((request.source_ids, request.target_ids)).encode()
        rng = np.random.default_rng([self.seed, *question, *np.abs(prior * 1e3).astype(int)])
        truth = self.fleet.T_world_submap
        T_true = truth[request.target_reference].inverse() @ truth[request.source_reference]
        if rng.random() < self.wrong_share:
            centre = request.prior.T_target_source if request.prior else SE2()
            reach = request.prior.half_width_m if request.prior else 40.0
            turn = request.prior.half_width_rad if request.prior else math.pi
            lie = SE2.from_array(rng.uniform(-1, 1, 3) * (reach, reach, turn) + centre.as_array())
            return result_of(Verdict.ACCEPTED, lie)
        if overlap_of(request.source, request.target, T_true) < self.min_overlap:
            return result_of(Verdict.NOT_ENOUGH_OVERLAP, SE2())
        noise = rng.normal(size=3) * (self.sigma_m, self.sigma_m, self.sigma_rad)
        return result_of(Verdict.ACCEPTED, T_true @ SE2.from_array(noise))


def refuse(_request: MatchRequest) -> RegistrationResult:
    """Find nothing."""
    return result_of(Verdict.NOT_ENOUGH_OVERLAP, SE2(), reason="nothing in common")


def overlap_of(source: OccupancyMap, target: OccupancyMap, T_target_source: SE2) -> float:
    """Area that both have seen over the smaller one's."""
    centers = source.spec.centers_of(np.argwhere(source.known))
    cells = target.spec.cells_of(T_target_source.apply(centers))
    cells = cells[target.spec.contains(cells)]
    shared = np.count_nonzero(target.known[cells[:, 0], cells[:, 1]])
    return shared / min(np.count_nonzero(source.known), np.count_nonzero(target.known))


def run(queue: MapQueue, matcher, batch: int = 3) -> None:
    """Answer everything that the queue asks."""
    for _ in range(10_000):
        requests = queue.next_requests(batch)
        if not requests:
            return
        for request in requests:
            queue.add_result(request.request_id, matcher(request))
    raise AssertionError("the queue never comes to rest")


def map_bytes(queue: MapQueue) -> bytes:
    """Everything that the global map is, as bytes."""
    evidence = queue.global_map()
    if evidence is None:
        return b""
    return repr(evidence.spec).encode() + evidence.log_odds.tobytes() + evidence.observed.tobytes()
