"""``doctor BAG...``: what a recording holds, what is wrong with it, and settings that mend it."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import yaml
from numpy.typing import NDArray

from uw_dslam_ros2.cli.common import parser_for, run_command
from uw_dslam_ros2.cli.reporting.outcome import json_bytes
from uw_dslam_ros2.cli.running.examining import ExaminedVehicle, examine_vehicle, together
from uw_dslam_ros2.cli.running.mapping import sensor_config
from uw_dslam_ros2.core.clocks import find_gaps
from uw_dslam_ros2.core.conventions import Conventions
from uw_dslam_ros2.core.doctor import Examination
from uw_dslam_ros2.core.findings import WORDS, Finding
from uw_dslam_ros2.core.health import MappedVehicle, SensorCount, sensor_findings
from uw_dslam_ros2.core.mapping.config import VehicleMapperConfig
from uw_dslam_ros2.io.atomic import write_files
from uw_dslam_ros2.io.events import VehicleReader
from uw_dslam_ros2.io.settings import SettingsFile
from uw_dslam_ros2.io.vehicles import VehicleRecording, find_recordings

__all__ = ["main"]

_FEW_MOTIONS = 15
_PIXELS = {
    "compressed": "a root of an echo's amplitude (compressed for display)",
    "amplitude": "an echo's amplitude",
    "power": "an echo's power",
    "decibel": "the logarithm of an echo",
}
_TURNING_CELL_M = 0.25
"""Beams of a sonar that turns lie a degree or two apart: finer cells hold nothing more."""


@dataclass(frozen=True, slots=True)
class Stream:
    """One sensor's messages, times in seconds from the vehicle's first message."""

    role: str
    topic: str
    num_messages: int
    rate_hz: float
    start_s: float
    end_s: float


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What one vehicle's recording is like."""

    vehicle_id: str
    streams: tuple[Stream, ...]
    findings: tuple[Finding, ...]
    conventions: Conventions
    num_ping_motions: int
    sonar_changes: Mapping[str, str | float]
    pixels: str
    num_turning_windows: int
    is_turning: bool


def main(argv: Sequence[str] | None = None) -> int:
    """Examine recordings; exit code 0 whatever is found, 2 for bad input."""
    args = _parser().parse_args(argv)
    return run_command("doctor", lambda: _run(args))


def _parser() -> argparse.ArgumentParser:
    parser = parser_for(
        "doctor",
        "Say what recordings hold and what is wrong with them: topics, rates, gaps, clocks, and\n"
        "which conventions their sensors follow, by trying them on the sonar's echoes.\n"
        "Writes doctor.html, doctor.json, and settings.yaml for 'offline --config' and the nodes.",
        "doctor recording/auv_1 recording/auv_2 --out checked",
    )
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="recordings")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="result folder")
    parser.add_argument(
        "--config", type=Path, metavar="FILE", help="settings by which to read (YAML)"
    )
    return parser


def _run(args: argparse.Namespace) -> int:
    file = SettingsFile(args.config)
    recordings, findings = find_recordings(args.bags, lambda name: sensor_config(file, name))
    examined, messages = [], []
    for recording in recordings:
        mapper = file.section(
            VehicleMapperConfig, "mapper", f"/{recording.vehicle_id}/sonar_mapper"
        )
        sensors = sensor_config(file, recording.vehicle_id)
        messages.append(_Messages())
        examined.append(examine_vehicle(recording, sensors, mapper.sonar, messages[-1].note))
    diagnoses = [
        _diagnose(*of_one) for of_one in zip(recordings, together(examined), messages, strict=True)
    ]
    for diagnosis in diagnoses:
        _print(diagnosis)
        findings += diagnosis.findings
    for finding in findings:
        print(f"{finding.severity}: {finding.sentence}")
    if not findings:
        print("nothing is wrong, as far as can be told")
    args.out.mkdir(parents=True, exist_ok=True)
    settings = _settings(diagnoses)
    write_files(
        {
            args.out / "settings.yaml": settings.encode(),
            args.out / "doctor.html": _page(diagnoses, findings, settings),
            args.out / "doctor.json": json_bytes(_report(diagnoses, findings)),
        }
    )
    print(f"results in {args.out}; map with: offline ... --config {args.out}/settings.yaml")
    return 0


def _diagnose(
    recording: VehicleRecording, vehicle: ExaminedVehicle, messages: _Messages
) -> Diagnosis:
    """All that there is to say."""
    examined, stamps = vehicle.examination, vehicle.stamps
    findings = [
        dataclasses.replace(finding, vehicle_id=recording.vehicle_id)
        for finding in vehicle.about_clocks
    ]
    findings += examined.findings
    findings += [
        dataclasses.replace(finding, vehicle_id=recording.vehicle_id)
        for finding in messages.findings
    ]
    findings += vehicle.mountings.findings(recording.vehicle_id)
    findings += sensor_findings(messages.vehicle(recording.vehicle_id, stamps, examined))
    findings += [
        Finding(
            "gap",
            gap.role,
            f"it is silent for {gap.seconds:.0f} s; check its cable, or cut the recording there",
            vehicle_id=recording.vehicle_id,
        )
        for gap in find_gaps(stamps)
    ]
    findings += [
        Finding("cannot_tell", role, detail, severity="info", vehicle_id=recording.vehicle_id)
        for role, detail in _left_open(examined, stamps)
    ]
    return Diagnosis(
        recording.vehicle_id,
        _streams(recording, stamps),
        tuple(findings),
        examined.conventions,
        examined.num_ping_motions,
        examined.sonar_changes,
        examined.pixels,
        examined.num_turning_windows,
        examined.is_turning,
    )


def _left_open(
    examined: Examination, stamps: Mapping[str, NDArray[np.int64]]
) -> Iterator[tuple[str, str]]:
    """Which sensors could not be judged, and why."""
    if "sonar" not in stamps:
        return
    if examined.num_ping_motions < _FEW_MOTIONS and not examined.num_turning_windows:
        yield (
            "sonar",
            f"only {examined.num_ping_motions} pairs of pings a second or two apart show how it "
            "moved (too few echoes, too seldom, or no imu), so the conventions of imu, dvl and "
            "sonar cannot be told from each other",
        )
    elif "velocity" in stamps and not (
        examined.is_velocity_judged or examined.num_turning_windows
    ):
        yield (
            "velocity",
            "too few of the sonar's motions lie within its messages and agree with the imu, so "
            "its axes, unit and delay cannot be told",
        )


class _Messages:
    """What reading says of the messages themselves, gathered over several passes."""

    def __init__(self) -> None:
        self.findings: list[Finding] = []
        self._counts: dict[str, SensorCount] = {}
        self._num_read: dict[str, int] = {}

    def note(self, reader: VehicleReader) -> None:
        """Take what a pass found; bad messages are counted among those that were looked at."""
        self.findings += [finding for finding in reader.findings if finding not in self.findings]
        for role, count in reader.counts.items():
            known = self._counts.get(role, SensorCount(0))
            num_bad = known.num_bad + count.num_bad
            self._num_read[role] = self._num_read.get(role, 0) + count.num_read
            self._counts[role] = SensorCount(
                self._num_read[role] if num_bad else count.num,
                num_bad,
                max(count.num_empty, known.num_empty),
                known.problem or count.problem,
                max(count.num_early, known.num_early),
            )

    def vehicle(
        self, vehicle_id: str, stamps: Mapping[str, NDArray[np.int64]], examined: Examination
    ) -> MappedVehicle:
        """The vehicle as far as it is known before it is mapped."""
        known = {role: s[s > 0] for role, s in stamps.items()}
        return MappedVehicle(
            vehicle_id,
            {r: count for r, count in self._counts.items() if count.num and r != "truth"},
            {},
            spans={r: (int(s.min()), int(s.max())) for r, s in known.items() if len(s)},
            has_yaw=examined.has_yaw,
            has_yaw_rate=examined.has_yaw_rate,
        )


def _streams(
    recording: VehicleRecording, stamps: Mapping[str, NDArray[np.int64]]
) -> tuple[Stream, ...]:
    known = {role: np.sort(s) for role, s in stamps.items() if len(s)}
    start_ns = min((int(s[0]) for s in known.values()), default=0)
    streams = []
    for role, topic in recording.topics.items():
        if role not in known:
            continue
        seconds = (known[role] - start_ns) * 1e-9
        step_s = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 0.0
        rate_hz = 1.0 / step_s if step_s > 0.0 else 0.0
        streams.append(
            Stream(role, topic, len(seconds), rate_hz, float(seconds[0]), float(seconds[-1]))
        )
    return tuple(streams)


def _print(diagnosis: Diagnosis) -> None:
    print(f"{diagnosis.vehicle_id}:")
    for s in diagnosis.streams:
        print(
            f"  {WORDS.get(s.role, s.role):9} {s.topic:30} {s.num_messages:7} messages, "
            f"{s.rate_hz:.3g} Hz, {s.start_s:.1f} to {s.end_s:.1f} s"
        )
    if diagnosis.is_turning:
        print(f"  examined by {diagnosis.num_turning_windows} spans of turns or slow pings")
    else:
        print(f"  examined by {diagnosis.num_ping_motions} motions from ping to ping")
    if diagnosis.pixels:
        print(f"  the sonar's pixels hold {_PIXELS[diagnosis.pixels]}, by their speckle")


def _settings(diagnoses: Sequence[Diagnosis]) -> str:
    content: dict[str, Any] = {}
    # Maps of one mission have cells of one size.
    is_coarse = bool(diagnoses) and all(diagnosis.is_turning for diagnosis in diagnoses)
    for diagnosis in diagnoses:
        parameters: dict[str, Any] = {}
        if changes := diagnosis.conventions.changes():
            parameters["conventions"] = changes
        mapper: dict[str, Any] = {}
        if diagnosis.sonar_changes:
            mapper["sonar"] = dict(diagnosis.sonar_changes)
        if is_coarse:
            mapper["occupancy"] = {"resolution_m": _TURNING_CELL_M}
        if mapper:
            parameters["mapper"] = mapper
        if parameters:
            content[f"/{diagnosis.vehicle_id}/sonar_mapper"] = {"ros__parameters": parameters}
    head = "# What mends this recording or suits its sonar; nothing, if this is all.\n"
    return head + (yaml.safe_dump(content, sort_keys=True) if content else "")


def _report(diagnoses: Sequence[Diagnosis], findings: Sequence[Finding]) -> dict[str, Any]:
    return {
        "findings": [finding.to_dict() for finding in findings],
        "vehicles": [
            {
                "vehicle_id": d.vehicle_id,
                "streams": [dataclasses.asdict(stream) for stream in d.streams],
                "conventions": d.conventions.to_dict(),
                "num_ping_motions": d.num_ping_motions,
                "pixels": d.pixels,
                "num_turning_windows": d.num_turning_windows,
                "is_turning": d.is_turning,
            }
            for d in diagnoses
        ],
    }


def _page(diagnoses: Sequence[Diagnosis], findings: Sequence[Finding], settings: str) -> bytes:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("uw_dslam_ros2.cli.reporting"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    template = environment.get_template("doctor.html.j2")
    page = template.render(diagnoses=diagnoses, findings=findings, settings=settings, words=WORDS)
    return page.encode()


if __name__ == "__main__":
    sys.exit(main())
