"""Real sonar pings through the front end, and their speckle against the simulator's.

Pings of a Blueprint Oculus (``oculus/pings.npz`` in --data or UW_DATA_DIR) beside the detections,
and a table of the statistics of the noise: real and simulated.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.cli.studies._common import (
    COLOURS,
    data_dir,
    figure,
    print_table,
    save_figure,
    write_csv,
)
from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sonar import Detections, SonarConfig, SonarImage, detect
from uw_dslam_ros2.sim.sonars.imaging import SonarConfig as SimulatedSonar
from uw_dslam_ros2.sim.sonars.imaging import SonarSimulator
from uw_dslam_ros2.sim.sonars.speckle import speckle_of, speckle_statistics
from uw_dslam_ros2.sim.waters.world import Surface, WorldBuilder

__all__ = ["add_arguments", "run"]

FloatArray = NDArray[np.float64]

_STATISTICS = ("variation", "skewness", "next beam", "next range")
# Rows and beams that show little but an even bottom.
_EVEN = (slice(520, 700), slice(20, 236))
# For a sonar of 2 m range: its echoes lie centimetres apart.
_DETECTION = SonarConfig(
    min_range_m=0.15,
    num_train_cells=40,
    num_guard_cells=12,
    neighbor_distance_m=0.02,
    range_sigma_m=0.003,
)


@dataclass(frozen=True, slots=True, eq=False)
class _Pings:
    image: NDArray[np.uint8]
    range_m: FloatArray
    bearing_rad: FloatArray


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the study."""
    parser.add_argument("--data", type=Path, metavar="DIR", help="folder with oculus")
    parser.add_argument("--seed", type=int, default=0, help="of the simulated pings")


def run(args: argparse.Namespace) -> int:
    """Detect, compare, draw."""
    real = _read(data_dir(args.data, "oculus") / "pings.npz")
    found, rows = [], []
    for number, image in enumerate(real.image):
        ping = SonarImage(number, image, real.range_m, real.bearing_rad)
        detect(ping, _DETECTION)  # compiled before it is timed
        start = time.process_time()
        found.append(detect(ping, _DETECTION))
        seconds = time.process_time() - start
        rows.append([number, *image.shape, len(found[-1].points), f"{1e3 * seconds:.2f}"])
    print_table(["ping", "ranges", "beams", "detections", "CPU ms"], rows)
    _draw(args.out / "oculus.png", real, found)
    simulated = _simulated(real, args.seed)
    values = {
        "Oculus": speckle_statistics(real.image[:, *_EVEN]),
        "simulated": speckle_statistics(simulated[:, *_EVEN]),
    }
    table = [
        {"pings": name, **{k: f"{v:.3f}" for k, v in zip(_STATISTICS, found_, strict=True)}}
        for name, found_ in values.items()
    ]
    write_csv(args.out / "speckle.csv", table)
    print_table(list(table[0]), [list(row.values()) for row in table])
    _draw_histogram(args.out / "speckle.png", real.image, simulated)
    return 0


def _read(path: Path) -> _Pings:
    try:
        with np.load(path) as data:
            image, bearing_rad = data["image"], data["bearing_rad"]
            step_m = float(data["range_resolution_m"])
    except (OSError, KeyError, ValueError) as error:
        raise DataError(f"{path} cannot be read: {error}") from error
    range_m = (np.arange(image.shape[1]) + 0.5) * step_m
    return _Pings(image, range_m, np.asarray(bearing_rad, np.float64))


def _simulated(real: _Pings, seed: int) -> NDArray[np.uint8]:
    """As many pings of open water as there are real ones, by a sonar of that kind."""
    num_ranges, num_beams = real.image.shape[1:]
    config = SimulatedSonar(
        fov_rad=math.radians(60.0),
        num_beams=num_beams,
        num_ranges=num_ranges,
        max_range_m=float(real.range_m[-1]),
        beam_width_rad=math.radians(0.36),
        pulse_length_m=0.003,
        seabed_db=-80.0,
        reverberation_db=-90.0,
        ring_db=-90.0,
        noise_db=-20.0,
    )
    builder = WorldBuilder()
    builder.add(Surface("concrete", 0.0, 0.0), [(50.0, -50.0), (50.0, 50.0)])
    world = builder.build("open water", 0, (0.0, 0.0), 5.0)
    sonar, rng = SonarSimulator(world, config, 1.0), np.random.default_rng(seed)
    pings = [sonar.ping(0, SE2(yaw=1.5), 1.0, rng).intensity for _ in real.image]
    return np.asarray(pings, dtype=np.uint8)


def _draw(path: Path, real: _Pings, found: list[Detections]) -> None:
    made, axes = figure(1, len(found), width=4.0 * len(found), height=4.6)
    # Older releases of matplotlib do not find the edges of cells that are no rectangles.
    range_m, bearing_rad = _edges(real.range_m), _edges(real.bearing_rad)
    for axis, image, detections in zip(axes[0], real.image, found, strict=True):
        x = range_m[:, None] * np.cos(bearing_rad)
        y = range_m[:, None] * np.sin(bearing_rad)
        axis.pcolormesh(-y, x, image, cmap="gray", rasterized=True)
        axis.plot(-detections.points[:, 1], detections.points[:, 0], ".", ms=2, color=COLOURS[1])
        axis.set_title(f"{len(detections.points)} detections")
        axis.set_aspect("equal")
        axis.set_xlabel("to starboard [m]")
        axis.grid(visible=False)
    axes[0, 0].set_ylabel("ahead [m]")
    save_figure(made, path)


def _edges(centers: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where cells (K,) begin and end (K + 1,), by their centres."""
    inner = 0.5 * (centers[1:] + centers[:-1])
    return np.concatenate([[2 * centers[0] - inner[0]], inner, [2 * centers[-1] - inner[-1]]])


def _draw_histogram(path: Path, real: NDArray[np.uint8], simulated: NDArray[np.uint8]) -> None:
    made, axes = figure()
    bins = np.linspace(-1.0, 1.5, 60)
    for pings, name in ((real, "Oculus"), (simulated, "simulated")):
        values = speckle_of(pings[:, *_EVEN]).ravel()
        axes[0, 0].hist(values, bins, density=True, histtype="step", lw=1.5, label=name)
    axes[0, 0].set_xlabel("intensity over its local mean, less 1")
    axes[0, 0].set_ylabel("density")
    axes[0, 0].legend()
    save_figure(made, path)
