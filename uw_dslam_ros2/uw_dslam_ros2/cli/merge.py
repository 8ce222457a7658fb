"""``merge A.yaml B.yaml C.yaml...``: any number of map_server maps into one."""

from __future__ import annotations

import argparse
import contextlib
import csv
import dataclasses
import io
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from uw_dslam_ros2.cli.common import (
    EXIT_BAD_INPUT,
    parser_for,
    progress_bar,
    run_command,
    versions,
    warn,
)
from uw_dslam_ros2.cli.reporting.outcome import json_bytes
from uw_dslam_ros2.cli.running.map_merging import (
    MapFile,
    MergedMaps,
    Placement,
    VerdictRow,
    merge_maps,
)
from uw_dslam_ros2.cli.running.mapping import OfflineConfig
from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.io.atomic import write_files
from uw_dslam_ros2.io.maps.files import read_map, write_map
from uw_dslam_ros2.io.maps.provenance import write_provenance

__all__ = [
    "EXIT_APART",
    "EXIT_UNREADABLE",
    "main",
    "names_of",
    "read_maps",
    "summary",
    "write_merged",
]

EXIT_APART = 3
"""Exit code where at least one map is not joined with the others."""
EXIT_UNREADABLE = 1
"""Exit code for files and settings that cannot be used; wrong usage is 2, as argparse has it."""

_MAP, _PICTURE, _VERDICTS, _SUMMARY = "merged", "picture.png", "verdicts.csv", "merge.json"


def main(argv: Sequence[str] | None = None) -> int:
    """Merge and print; the exit code tells whether all maps are joined."""
    args = _parser().parse_args(argv)
    code = run_command("merge", lambda: _run(args))
    return EXIT_UNREADABLE if code == EXIT_BAD_INPUT else code


def _parser() -> argparse.ArgumentParser:
    parser = parser_for(
        "merge",
        "Merge two or more map_server maps of one place, without any guess how they lie.\n"
        "Every pair is matched by itself; what is accepted makes a graph, and what that joins\n"
        "becomes one map, in the frame of the first map that is joined. What cannot be joined\n"
        "stays out, and is named with the reasons. Writes into DIR: merged.yaml with .pgm and\n"
        ".png, picture.png (each map alone, and the merged one), verdicts.csv, merge.json,\n"
        "merged_provenance.npz (which cell is from which maps), merged_contradictions.png.\n"
        "The same maps give the same bytes.\n"
        f"Exit code: 0 all are joined, {EXIT_APART} some or all stay apart, {EXIT_UNREADABLE} "
        "a file or setting cannot be used, 2 wrong usage.",
        "merge ground_floor.yaml hall.yaml lab.yaml --out merged",
    )
    parser.add_argument("maps", nargs="+", type=Path, metavar="MAP.yaml", help="two and more")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="result folder")
    parser.add_argument(
        "--resolution",
        type=float,
        metavar="M",
        help="cell size of the merged map [m] (default: the finest of the maps that are joined)",
    )
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings (YAML)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    return parser


def _run(args: argparse.Namespace) -> int:
    if len(args.maps) < 2:
        _parser().error("one map alone cannot be merged, expected two and more")
    config = OfflineConfig.read(args.config, [])
    if args.resolution is not None:
        if not (math.isfinite(args.resolution) and args.resolution > 0.0):
            _parser().error(f"--resolution is {args.resolution}, expected metres > 0")
        queue = dataclasses.replace(config.queue, resolution_m=args.resolution)
        config = dataclasses.replace(config, queue=queue)
    maps = read_maps(args.maps)
    say(f"matching {len(maps)} maps")
    with progress_bar("matching", " pairs") as progress:
        result = merge_maps(maps, config, progress=progress)
    say("drawing and writing")
    write_merged(args.out, result, config)
    if args.json:
        sys.stdout.write(json_bytes(summary(result, config)).decode())
    else:
        print("\n".join([*_lines(result), f"results in {args.out}"]))
    return EXIT_APART if result.apart else 0


def read_maps(paths: Sequence[Path]) -> list[MapFile]:
    """Read maps and give each a name; what is odd about one goes to stderr."""
    names = names_of(paths)
    return [
        MapFile(name, path, read_map(path, warn)) for name, path in zip(names, paths, strict=True)
    ]


def say(text: str) -> None:
    """One line of progress."""
    print(f"merge: {text}", file=sys.stderr, flush=True)


def names_of(paths: Sequence[Path]) -> list[str]:
    """File names without their endings; with folders where they are alike."""
    places = [path.resolve() for path in paths]
    for place, path in zip(places, paths, strict=True):
        if places.count(place) > 1:
            raise InvalidInputError(f"{path} is given twice, expected different maps")
    names = [place.stem for place in places]
    for depth in range(max(len(place.parts) for place in places)):
        alike = [names.count(name) > 1 for name in names]
        if not any(alike):
            break
        for index, place in enumerate(places):
            if alike[index]:
                names[index] = "/".join([*place.parts[-2 - depth : -1], place.stem])
    return names


def write_merged(folder: Path, result: MergedMaps, config: OfflineConfig) -> None:
    """Write all files; what an earlier run left of a merged map goes, where there is none now."""
    # Drawing takes longer to import than reading maps does.
    from uw_dslam_ros2.cli.reporting.pictures import before_after, png_bytes

    prefix = folder / _MAP
    if result.merged is not None and result.provenance is not None:
        write_map(prefix, result.merged)
        write_provenance(prefix, result.provenance)
    else:
        ends = (".yaml", ".pgm", ".png", "_provenance.npz", "_contradictions.png")
        for end in ends:
            with contextlib.suppress(OSError):
                prefix.with_name(_MAP + end).unlink()
    title = f"{len(result.joined)} of {len(result.maps)} maps joined"
    picture = before_after(result.outcome, title, members="maps")
    write_files(
        {
            folder / _PICTURE: png_bytes(picture),
            folder / _VERDICTS: _csv_bytes(result.rows),
            folder / _SUMMARY: json_bytes(summary(result, config)),
        }
    )


def summary(result: MergedMaps, config: OfflineConfig) -> dict[str, Any]:
    """Plain values: where each map lies, all verdicts, cycles, and what they were made with."""
    files = {one.name: one for one in result.maps}
    merged = result.merged
    return {
        "joined": [placement.name for placement in result.joined],
        "apart": [placement.name for placement in result.apart],
        "frame": None if merged is None else result.frame,
        "resolution_m": None if merged is None else merged.spec.resolution_m,
        "maps": [
            {
                "name": placement.name,
                "file": str(files[placement.name].path),
                "resolution_m": files[placement.name].occupancy.spec.resolution_m,
                "group": placement.group,
                "T_group_map": placement.T_group_map.as_array().tolist(),
                "reason": placement.reason,
            }
            for placement in result.placements
        ],
        "verdicts": [dataclasses.asdict(row) for row in result.rows],
        "cycles": [
            {
                "maps": [submap_id.vehicle_id for submap_id in loop.submaps],
                "error_m": loop.error_m,
                "error_rad": loop.error_rad,
            }
            for loop in result.outcome.loops
        ],
        "settings": {
            "registration": config.registration.to_dict(),
            "queue": config.queue.to_dict(),
        },
        "versions": versions(),
    }


def _csv_bytes(rows: Sequence[VerdictRow]) -> bytes:
    text = io.StringIO()
    names = [field.name for field in dataclasses.fields(VerdictRow)]
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    for row in rows:
        values = [getattr(row, name) for name in names]
        writer.writerow("" if isinstance(v, float) and math.isnan(v) else v for v in values)
    return text.getvalue().encode()


def _lines(result: MergedMaps) -> list[str]:
    lines = [f"{row.source} in {row.target}: {_verdict(row)}" for row in result.rows]
    if result.merged is None:
        lines.append("no two maps are joined, so there is no merged map")
    else:
        spec = result.merged.spec
        names = ", ".join(placement.name for placement in result.joined)
        lines.append(
            f"joined: {names}: {spec.num_cols} x {spec.num_rows} cells of {spec.resolution_m:g} m "
            f"in the frame of {result.frame}"
        )
        lines += [f"  {_place(p)}, {p.reason}" for p in result.joined if p.name != result.frame]
    for loop in result.outcome.loops:
        names = " - ".join(submap_id.vehicle_id for submap_id in loop.submaps)
        degrees = math.degrees(loop.error_rad)
        lines.append(f"cycle {names} closes to {loop.error_m:.3f} m, {degrees:.2f} degrees")
    groups: dict[int, list[Placement]] = {}
    for placement in result.apart:
        groups.setdefault(placement.group, []).append(placement)
    for members in groups.values():
        lines.append(f"apart: {members[0].name}: {members[0].reason}")
        lines += [f"  joined with it, but not with the others: {_place(p)}" for p in members[1:]]
    return lines


def _verdict(row: VerdictRow) -> str:
    used = "" if row.is_used or row.verdict != "ACCEPTED" else " but not used"
    near = " (searched near the graph's pose)" if row.has_prior else ""
    pose = ""
    if math.isfinite(row.x):
        pose = (
            f" x {row.x:.3f} m, y {row.y:.3f} m, yaw {math.degrees(row.yaw):.2f} degrees, "
            f"probability {row.probability:.3f};"
        )
    return f"{row.verdict}{used}{near},{pose} {row.reason}"


def _place(placement: Placement) -> str:
    motion = placement.T_group_map
    return (
        f"{placement.name}: x {motion.x:.3f} m, y {motion.y:.3f} m, "
        f"yaw {math.degrees(motion.yaw):.2f} degrees"
    )


if __name__ == "__main__":
    sys.exit(main())
