"""Pairs of maps of a real marina (Aracati 2017), placed by their references: for scoring only."""

from __future__ import annotations

import itertools
import math
import os
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.cli.studies._common import data_dir
from uw_dslam_ros2.core.grid import FREE, OCCUPIED, UNKNOWN, GridSpec, OccupancyMap
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.io.datasets.aracati2017 import AracatiRecording, read_aracati2017
from uw_dslam_ros2.sim.maps.pairs import MapPair

__all__ = ["has_recording", "real_pairs"]

_RESOLUTION_M = 0.5
_FREE_RANGE_M = 30.0
_HALF_FAN_RAD = math.radians(62.0)
_BEAM_RAD = math.radians(2.0)
_MARGIN_M = 2.0


def has_recording() -> bool:
    """Whether the environment names recordings."""
    return bool(os.environ.get("UW_DATA_DIR"))


def real_pairs(folder: Path | None = None, num_pings: int = 55, seed: int = 0) -> list[MapPair]:
    """All pairs of submaps of so many key pings each, in frames of their own.

    ``MapPair.overlap`` is the share of the smaller seen area that both have seen; below 2 % there
    is no answer. Poses are those of the references (DGPS and compass), as good as a metre.
    """
    recording = read_aracati2017(data_dir(folder, "aracati2017"))
    truth = recording.truth_at(recording.keyframe_stamp_ns)
    rng = np.random.default_rng(seed)
    submaps = []
    for first in range(0, recording.num_keyframes - num_pings + 1, num_pings):
        T_world_map = SE2.from_array(rng.uniform(-1.0, 1.0, 3) * (40.0, 40.0, math.pi))
        T_world_map = SE2.from_array(truth[first]) @ T_world_map
        poses = [T_world_map.inverse() @ SE2.from_array(p) for p in truth[first:][:num_pings]]
        submaps.append((_map(recording, first, poses), T_world_map))
    pairs = []
    for (source, T_world_source), (target, T_world_target) in itertools.combinations(submaps, 2):
        T_target_source = T_world_target.inverse() @ T_world_source
        overlap = _overlap(source, target, T_target_source)
        answer = T_target_source if overlap > 0.02 else None
        pairs.append(MapPair("aracati", "real", overlap, source, target, answer))
    return pairs


def _map(recording: AracatiRecording, first: int, poses: list[SE2]) -> OccupancyMap:
    """Free where a fan looked, occupied where at least two echoes fell."""
    fans, echoes = [], []
    for offset, T_map_sonar in enumerate(poses):
        points = recording.points[first + offset]
        fans.append(T_map_sonar.apply(_fan(points)))
        echoes.append(T_map_sonar.apply(points))
    everything = np.concatenate([*fans, *echoes])
    low, high = everything.min(axis=0) - _MARGIN_M, everything.max(axis=0) + _MARGIN_M
    num_cols, num_rows = np.ceil((high - low) / _RESOLUTION_M).astype(int)
    spec = GridSpec(_RESOLUTION_M, int(num_rows), int(num_cols), SE2(float(low[0]), float(low[1])))
    seen = np.zeros(spec.shape, np.uint8)
    for fan in fans:
        corners = np.floor((fan - low) / _RESOLUTION_M).astype(np.int32)
        cv2.fillPoly(seen, [corners], 1)
    cells = spec.cells_of(np.concatenate(echoes))
    count = np.zeros(spec.shape, np.int64)
    np.add.at(count, (cells[:, 0], cells[:, 1]), 1)
    values = np.where(seen > 0, FREE, UNKNOWN).astype(np.int8)
    values[count >= 2] = OCCUPIED
    return OccupancyMap(spec, values)


def _fan(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Outline (N, 2) of what a ping saw: each beam up to its first echo."""
    beams = np.arange(-_HALF_FAN_RAD, _HALF_FAN_RAD, _BEAM_RAD)
    bearing, ranges = np.arctan2(points[:, 1], points[:, 0]), np.hypot(*points.T)
    reach = np.full(len(beams), _FREE_RANGE_M)
    beam = np.clip(np.floor((bearing + _HALF_FAN_RAD) / _BEAM_RAD), 0, len(beams) - 1)
    np.minimum.at(reach, beam.astype(int), ranges)
    outline = reach[:, None] * np.column_stack([np.cos(beams), np.sin(beams)])
    return np.concatenate([np.zeros((1, 2)), outline])


def _overlap(source: OccupancyMap, target: OccupancyMap, T_target_source: SE2) -> float:
    centers = source.spec.centers_of(np.argwhere(source.known))
    cells = target.spec.cells_of(T_target_source.apply(centers))
    cells = cells[target.spec.contains(cells)]
    both = int(np.count_nonzero(target.known[cells[:, 0], cells[:, 1]]))
    smaller = min(int(source.known.sum()), int(target.known.sum()))
    return both / max(smaller, 1)
