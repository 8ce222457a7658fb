"""What a report says of vehicles that only acoustic modems join."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from uw_dslam_ros2.cli.reporting.map_drawing import INK, VEHICLE_COLORS, blank_figure
from uw_dslam_ros2.cli.reporting.scoring import Truth
from uw_dslam_ros2.cli.running.demo_link import LinkedMission
from uw_dslam_ros2.core.merging import MapQueueConfig
from uw_dslam_ros2.core.metrics import trajectory_error
from uw_dslam_ros2.io.sessions.session import load_session

__all__ = ["add_maps", "known_over_time"]


def add_maps(
    link: dict[str, Any],
    mission: LinkedMission,
    out: Path,
    config: MapQueueConfig,
    truth: Truth,
) -> list[str]:
    """Say of each vehicle what its own manager's map is worth, and whether all have the same.

    `link` is what `run_linked` found; of each vehicle num_vehicles_merged, rmse_m and cells_digest
    (None without a map) are added to it, and is_same_map. Returns a note where they have not.
    """
    digests: dict[str, str | None] = {}
    for vehicle in mission.vehicles:
        queue = load_session(mission.session_folder(out, vehicle), config)
        found = {
            name: path for name, path in queue.trajectories().items() if name in truth.trajectories
        }
        link["vehicles"][vehicle] |= {
            "num_vehicles_merged": len(queue.trajectories()),
            "rmse_m": trajectory_error(found, truth.trajectories).rmse_m if found else None,
        }
        drawn = queue.global_map()
        digests[vehicle] = None if drawn is None else drawn.cells_digest()
        link["vehicles"][vehicle]["cells_digest"] = digests[vehicle]
    link["is_same_map"] = len(set(digests.values())) == 1
    if link["is_same_map"]:
        return []
    told = ", ".join(f"{vehicle} {digest}" for vehicle, digest in digests.items())
    return [f"The vehicles' maps are not the same, byte for byte: {told}."]


def known_over_time(link: Mapping[str, Any]) -> Figure:
    """How many submaps each vehicle's manager knew when, and when it joined another vehicle."""
    figure = blank_figure(10.0, 3.2)
    axes = figure.add_axes((0.07, 0.17, 0.91, 0.72))
    vehicles = link["vehicles"]
    end_s = max(
        [link["last_ping_s"]]
        + [at_s for one in vehicles.values() for at_s, _ in one["num_submaps_known_s"]]
        + [at_s for one in vehicles.values() for at_s in one["joined_s"].values()]
    )
    for index, (vehicle, told) in enumerate(sorted(vehicles.items())):
        color = VEHICLE_COLORS[index % len(VEHICLE_COLORS)]
        steps = [*told["num_submaps_known_s"], [end_s, told["num_submaps_known"]]]
        times, counts = zip(*steps, strict=True)
        axes.step(times, counts, where="post", color=color, lw=1.6, label=vehicle)
        for at_s in sorted(set(told["joined_s"].values())):
            others = [name for name, since_s in told["joined_s"].items() if since_s == at_s]
            count = max(num for since_s, num in steps if since_s <= at_s)
            axes.plot(at_s, count, "o", color=color, ms=5)
            text = f"joined {', '.join(others)}  "
            axes.annotate(text, (at_s, count), ha="right", va="bottom", fontsize=7, color=color)
    axes.axvline(link["last_ping_s"], color="#888888", lw=0.8, ls="--")
    axes.set(xlabel="time [s]; dashed: the last ping", ylabel="submaps known", ylim=(0.0, None))
    axes.set_title("What each vehicle's manager knew when", loc="left", fontsize=11, color=INK)
    axes.grid(color="#e3e7ea", lw=0.8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, ncols=6, loc="lower right", bbox_to_anchor=(1.0, 0.99), fontsize=9)
    return figure
