"""Every vehicle has the map, over a few hundred bits a second: bytes, losses and time.

The default demo's missions, mapped once for each seed. Their submaps go over a simulated channel
that all vehicles share, from the moment on in which each is closed. Merging works on what was
sent, at both ends alike, so that whoever has received the same has the same map; the tables show
when everybody had everything, when the first vehicle could first join another, and what the merged
map is worth beside one of full grids: with everything, and with what all have a minute (1000
bit/s), five (nano) or twenty (rate0) after the last ping. For comparison the bits that descriptors
of 16 bytes and a cloud of 9 kbit for each submap that is matched (DRACo-SLAM's budget) would take.

A study that was stopped goes on where it was: what is done of each mission is kept in ``cache``.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from uw_dslam_ros2.cli.studies._common import (
    COLOURS,
    figure,
    print_table,
    progress,
    save_figure,
    write_csv,
)
from uw_dslam_ros2.cli.studies._finished import FinishedParts
from uw_dslam_ros2.cli.studies._fleet_missions import FleetMission, code_digest, demo_mission
from uw_dslam_ros2.cli.studies._link_joining import Joining, known_by
from uw_dslam_ros2.core.link import Layer, LayeredSubmap, encode_submap
from uw_dslam_ros2.core.link.transport.channel import CHANNEL_PRESETS, ChannelConfig
from uw_dslam_ros2.core.submap import Submap
from uw_dslam_ros2.sim.missions.link_mission import LinkRun, run_link

__all__ = ["add_arguments", "run"]

_LIMIT_S = 3600.0
_CELLS = Layer.COARSE, Layer.FINE
_WAYS = {
    "full grids": None,
    "0.3 m": Layer.COARSE,
    "0.3 m, walls of 0.1 m": Layer.FINE,
}
_CLOUD_BYTES, _DESCRIPTOR_BYTES = 9000 // 8, 16
_DUE_S = {"1000 bit/s": 60.0, "nano": 300.0, "rate0": 1200.0}
"""After the last ping: what is joined by then, of channels by the beginning of their names."""
_SHARED_RATE = 1500.0  # while a modem sends; 1000 bit/s with the pauses of 64-byte packets


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the study."""
    parser.add_argument("--seeds", type=int, default=5, help="simulated missions")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--loss", type=float, default=0.3, help="share of lost packets")
    parser.add_argument("--no-merging", action="store_true", help="only what crosses the link")


def run(args: argparse.Namespace) -> int:
    """Write ``link.csv``, ``link.png`` and tables."""
    rows: list[dict[str, Any]] = []
    shown: dict[str, LinkRun] = {}  # of the first mission
    sizes: list[dict[str, Any]] = []
    merged: list[dict[str, Any]] = []
    code = code_digest(repr((args.loss, args.no_merging)), "core", "sim", "cli/studies")
    parts = FinishedParts(args.out / "cache", code)
    for seed in progress(range(args.first_seed, args.first_seed + args.seeds), text="missions"):
        mission = demo_mission(seed, args.out / "cache")
        joining = None if args.no_merging else Joining(mission)
        sizes += [_sizes(mission.name, submap) for submap in mission.submaps]
        if joining is not None:
            merged += parts.get(f"{mission.name} layers", functools.partial(_merged_rows, joining))
        for name, (channel, blackouts) in _channels(args.loss, mission.submaps).items():
            play = functools.partial(
                run_link,
                mission.submaps,
                dataclasses.replace(channel, seed=seed),
                limit_s=_LIMIT_S,
                blackouts=blackouts,
            )
            if seed == args.first_seed:
                shown[name] = play()
            is_joined = not blackouts and channel.access == "tdma"
            make = functools.partial(_channel, mission, joining if is_joined else None, name, play)
            found = parts.get(f"{mission.name} {name}", make)
            rows.append(found["row"])
            merged += found["due"]
    write_csv(args.out / "link.csv", rows)
    write_csv(args.out / "sizes.csv", sizes)
    _draw_known(shown, args.out / "link.png")
    _report_sizes(sizes)
    _report(rows)
    if merged:
        write_csv(args.out / "merged.csv", merged)
        print_table(list(merged[0]), [list(row.values()) for row in merged])
    return 0


def _channel(
    mission: FleetMission, joining: Joining | None, name: str, play: Callable[[], LinkRun]
) -> dict[str, Any]:
    """What one mission's exchange over one channel took, and what could be merged when."""
    played = play()
    due = [] if joining is None else _due_rows(joining, name, played)
    return {"row": _row(mission, name, played), "due": due}


def _channels(
    loss: float, submaps: Sequence[Submap]
) -> dict[str, tuple[ChannelConfig, tuple[tuple[float, float], ...]]]:
    stamps = [int(s.stamp_ns) for s in submaps], [int(s.trajectory_stamp_ns[0]) for s in submaps]
    length_s = (max(stamps[0]) - min(stamps[1])) * 1e-9
    shared = ChannelConfig(bit_rate=_SHARED_RATE, loss=loss)
    half = ((0.25 * length_s, 0.75 * length_s),)
    text = f"{loss:.0%} lost"
    return {
        "1000 bit/s": (dataclasses.replace(shared, loss=0.0), ()),
        f"1000 bit/s, {text}": (shared, ()),
        f"1000 bit/s, {text}, half in blackout": (shared, half),
        f"1000 bit/s, {text}, ALOHA": (dataclasses.replace(shared, access="aloha"), ()),
        f"nano, {text}": (dataclasses.replace(CHANNEL_PRESETS["nano"], loss=loss), ()),
        "rate0": (CHANNEL_PRESETS["rate0"], ()),
        f"psk5, {text}": (dataclasses.replace(CHANNEL_PRESETS["psk5"], loss=loss), ()),
    }


def _sizes(mission: str, submap: Submap) -> dict[str, Any]:
    layers = encode_submap(submap)
    return {"mission": mission, "submap": str(submap.submap_id)} | {
        layer.name.lower(): len(data) for layer, data in layers.items()
    }


def _after_s(played: LinkRun, submaps: Sequence[Submap], layer: Layer) -> float | str:
    """How long after the last ping everybody had all submaps down to a layer; "": never."""
    done_s = played.complete_s({s.submap_id: 4 * s.revision + layer for s in submaps})
    return "" if done_s is None else round(done_s - played.end_s, 1)


def _row(mission: FleetMission, name: str, played: LinkRun) -> dict[str, Any]:
    after_s = {layer: _after_s(played, mission.submaps, layer) for layer in _CELLS}
    sent: dict[str, int] = {}
    for counts in played.counts.values():
        for label, num in counts.sent_bytes.items():
            sent[label] = sent.get(label, 0) + num
    return {
        "mission": mission.name,
        "channel": name,
        "submaps": len(mission.submaps),
        **{f"{layer.name.lower()}_s": at_s for layer, at_s in after_s.items()},
        "kB": round(sum(sent.values()) / 1000, 2),
        "status_kB": round(sent.get("status", 0) / 1000, 2),
        "packets": played.channel.sent,
        "repairs": sum(counts.repairs for counts in played.counts.values()),
        "duplicates": sum(counts.duplicates for counts in played.counts.values()),
        "lost": played.channel.lost,
        "collided": played.channel.collided,
        "refused": sum(sum(counts.refused.values()) for counts in played.counts.values()),
    }


def _merged_rows(joining: Joining) -> list[dict[str, Any]]:
    """The map of full grids beside that of each layer, for everybody who has it all."""
    mission, found = joining.mission, []
    for name, layer in _WAYS.items():
        crossed = [
            (submap, 0) if layer is None else _crossed(submap, layer) for submap in mission.submaps
        ]
        num_bytes = sum(pair[1] for pair in crossed)
        row = _merged_row(joining, name, [pair[0] for pair in crossed])
        found.append(row | {"kB": round(num_bytes / 1000, 1) if num_bytes else ""})
    return found


def _due_rows(joining: Joining, name: str, played: LinkRun) -> list[dict[str, Any]]:
    """What all could merge when they should be done, and when the first one joined another."""
    for channel, due_s in _DUE_S.items():
        if name.startswith(channel):
            vehicles = sorted(played.known)
            known = known_by(played, vehicles, played.end_s + due_s)
            first_s = joining.first_join_s(played, vehicles[0])
            row = _merged_row(joining, f"{name}: {due_s:g} s after the last ping", known)
            return [row | {"first_join_s": "" if first_s is None else round(first_s, 1)}]
    return []


def _merged_row(joining: Joining, name: str, submaps: Sequence[Submap]) -> dict[str, Any]:
    merged = joining.merged(submaps)
    return {
        "mission": joining.mission.name,
        "sent": name,
        "kB": "",
        "submaps": len(submaps),
        "vehicles": merged.num_vehicles,
        "rmse_m": round(merged.rmse_m, 3),
        "first_join_s": "",
    }


def _crossed(submap: Submap, finest: Layer) -> tuple[Submap, int]:
    """A submap as it is after crossing the link, and the bytes of its layers."""
    held, num_bytes = LayeredSubmap(), 0
    for data in encode_submap(submap, finest=finest).values():
        held.add(data)
        num_bytes += len(data)
    got = held.submap(submap.vehicle_id)
    assert got is not None, "outline and cells have come"
    return got, num_bytes


# --- pictures and tables -----------------------------------------------------------------------


def _draw_known(runs: Mapping[str, LinkRun], path: Path) -> None:
    """How many submaps each vehicle knew when, one panel a channel."""
    rows = -(-len(runs) // 2)
    made, axes = figure(rows, 2, width=9.0, height=2.2 * rows)
    for axis, (name, played) in zip(axes.flat, runs.items(), strict=False):
        for colour, (vehicle, events) in zip(COLOURS, played.known.items(), strict=False):
            first: dict[Any, float] = {}
            for at_s, submap in events:
                first.setdefault(submap.submap_id, at_s)
            times = np.sort(list(first.values()))
            axis.step(
                times, np.arange(1, len(times) + 1), where="post", color=colour, label=vehicle
            )
        axis.axvline(played.end_s, color="#999999", lw=0.8)
        axis.set_title(name, fontsize=8)
        axis.set_xlabel("time [s]")
        axis.set_ylabel("submaps known")
    axes.flat[0].legend(fontsize=7)
    save_figure(made, path)


def _report_sizes(sizes: Sequence[Mapping[str, Any]]) -> None:
    names = [layer.name.lower() for layer in Layer]
    table = np.array([[row[name] for name in names] for row in sizes])
    sums = np.cumsum(table, axis=1)
    rows = [
        [name, f"{np.median(table[:, k]):.0f}", f"{np.median(sums[:, k]):.0f}", sums[:, k].max()]
        for k, name in enumerate(names)
    ]
    print_table(["layer", "bytes, median", "with those before", "most"], rows)


def _report(rows: Sequence[Mapping[str, Any]]) -> None:
    table = []
    for name in dict.fromkeys(row["channel"] for row in rows):
        own = [row for row in rows if row["channel"] == name]
        times = [
            [row[f"{layer.name.lower()}_s"] for row in own if row[f"{layer.name.lower()}_s"] != ""]
            for layer in _CELLS
        ]
        table.append(
            [
                name,
                *(
                    f"{np.median(done):.0f}, {max(done):.0f} ({len(done)} of {len(own)})"
                    if done
                    else ""
                    for done in times
                ),
                f"{np.median([row['kB'] for row in own]):.1f}",
                f"{np.median([row['packets'] for row in own]):.0f}",
                f"{np.median([row['repairs'] for row in own]):.0f}",
                f"{np.median([row['duplicates'] for row in own]):.0f}",
            ]
        )
    num = np.median([row["submaps"] for row in rows])
    print_table(
        [
            "channel", "cells of 0.3 m: s after the last ping, median, most", "walls of 0.1 m",
            "kB", "packets", "repairs", "duplicates",
        ],
        table,
    )  # fmt: skip
    draco = num * (_DESCRIPTOR_BYTES + _CLOUD_BYTES) / 1000
    print(f"descriptors, and a cloud of each submap: {draco:.1f} kB without headers and losses")
