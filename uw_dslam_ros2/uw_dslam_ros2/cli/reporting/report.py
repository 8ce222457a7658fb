"""The report of a run: one HTML file with its pictures, and the same numbers as JSON."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import jinja2
from matplotlib.figure import Figure

from uw_dslam_ros2.cli.reporting import pictures
from uw_dslam_ros2.cli.reporting.link_report import known_over_time
from uw_dslam_ros2.cli.reporting.outcome import Outcome, json_bytes, write_outcome
from uw_dslam_ros2.cli.reporting.scoring import Scores, Truth, score
from uw_dslam_ros2.cli.reporting.wall_lines import walls_of, walls_picture
from uw_dslam_ros2.core.merging import Georeference
from uw_dslam_ros2.core.registration.result import Verdict
from uw_dslam_ros2.io.atomic import write_files
from uw_dslam_ros2.io.heap import give_back, trim
from uw_dslam_ros2.io.maps.provenance import contradictions_png
from uw_dslam_ros2.io.maps.walls import dxf_bytes, walls_geojson_bytes
from uw_dslam_ros2.view.pairs import KEY

__all__ = ["RunFacts", "headline", "whose_error", "write_report"]

_LOOK_PIXELS = 420
_MEANING = {
    Verdict.ACCEPTED: "the transform may be used",
    Verdict.TOO_FEW_FEATURES: "too little to match in one of the maps",
    Verdict.NOT_ENOUGH_OVERLAP: "the maps share too small an area",
    Verdict.AMBIGUOUS: "several poses explain the maps about equally well",
    Verdict.CONTRADICTED: "free space of one map lies on walls of the other",
    Verdict.BUDGET_EXHAUSTED: "stopped before the proof was complete",
    Verdict.IMPROBABLE: "not probable enough, or no better than chance",
}


@dataclass(frozen=True, slots=True, eq=False)
class RunFacts:
    """What was run, on what, with which settings; ``times_s`` only where they were measured."""

    title: str
    source: list[str]
    command: str
    settings: dict[str, Any]
    seeds: dict[str, int]
    versions: dict[str, str]
    diagnostics: Mapping[str, Mapping[str, float | int | str]] = field(default_factory=dict)
    times_s: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    findings: list[dict[str, Any]] = field(default_factory=list)
    link: dict[str, Any] = field(default_factory=dict)


def write_report(
    folder: Path,
    outcome: Outcome,
    facts: RunFacts,
    truth: Truth | None,
    *,
    has_pictures: bool = True,
) -> Scores:
    """Write the result folder: all of `write_outcome`, walls as lines, report and pictures.

    ``walls.geojson`` and ``walls.dxf``, ``report.json``, ``*.png``, ``report.html``.
    """
    scores = score(
        outcome.global_map,
        outcome.trajectories(),
        {v.vehicle_id: v.own_trajectory for v in outcome.vehicles},
        truth,
    )
    write_outcome(folder, outcome)
    walls, piers = walls_of(outcome)
    write_files(
        {
            folder / "walls.geojson": walls_geojson_bytes(walls, piers),
            folder / "walls.dxf": dxf_bytes(walls, piers),
            folder / "report.json": json_bytes(report_dict(outcome, facts, scores)),
        }
    )
    if has_pictures:
        trim()  # scores and walls have left holes
        images = _draw(outcome, facts, truth, scores)
        if outcome.global_map is not None:
            figure = walls_picture(outcome.global_map, walls, piers)
            images["walls"] = pictures.png_bytes(figure)
        shown = images
        if outcome.provenance is not None:
            shown = images | {"global_map_contradictions": contradictions_png(outcome.provenance)}
        html = render_html(outcome, facts, scores, shown).encode()
        files = {folder / f"{name}.png": content for name, content in images.items()}
        write_files({**files, folder / "report.html": html})
    return scores


def report_dict(outcome: Outcome, facts: RunFacts, scores: Scores) -> dict[str, Any]:
    """Everything in numbers; lengths in metres, angles in radians."""
    result: dict[str, Any] = {
        "title": facts.title,
        "command": facts.command,
        "source": facts.source,
        "num_vehicles": outcome.num_vehicles,
        "num_vehicles_merged": outcome.num_merged_vehicles,
        "vehicles": [
            {
                "vehicle_id": v.vehicle_id,
                "is_merged": v.is_merged,
                "num_submaps": v.num_submaps,
                "num_submaps_merged": v.num_merged,
                "path_length_m": v.path_length_m(),
                "reason": v.reason,
            }
            for v in outcome.vehicles
        ],
        "vehicles_not_mapped": list(outcome.unmapped),
        "num_registrations": len(outcome.registrations),
        "georeference": _georeference_dict(outcome.georeference),
        "decisions": [asdict(row) for row in outcome.decisions],
        "verdicts": outcome.verdict_counts(),
        "scores": scores.to_dict(),
        "notes": facts.notes,
        "findings": facts.findings,
        "seeds": facts.seeds,
        "versions": facts.versions,
        "settings": facts.settings,
        "diagnostics": {name: dict(values) for name, values in facts.diagnostics.items()},
    }
    if facts.times_s:
        result["times_s"] = facts.times_s
    if facts.link:
        result["link"] = facts.link
    return result


def _georeference_dict(found: Georeference | None) -> dict[str, Any] | None:
    if found is None:
        return None
    used = [fit.metres_off for fit in found.fits if fit.is_used]
    return {
        "earth_frame": found.earth_frame,
        "T_earth_map": found.T_earth_map.as_array().tolist(),
        "num_fixes": len(found.fits),
        "num_used": len(used),
        "rms_m": math.sqrt(sum(m * m for m in used) / len(used)) if used else None,
    }


def headline(outcome: Outcome, scores: Scores) -> str:
    """How good it is, in one sentence or two."""
    num, merged = outcome.num_vehicles, outcome.num_merged_vehicles
    left = [v.vehicle_id for v in outcome.vehicles if not v.is_merged]
    text = f"{merged} of {num} vehicles merged"
    if left:
        text += f" (NOT merged: {', '.join(left)})"
    if outcome.unmapped:
        text += f" (NOT mapped: {', '.join(outcome.unmapped)})"
    if scores.trajectory is not None:
        text += (
            f"; trajectory error {scores.trajectory.rmse_m:.2f} m RMSE, "
            f"{math.degrees(scores.trajectory.rmse_rad):.1f} degrees, "
            + whose_error(list(scores.trajectory.per_vehicle_rmse_m), num)
        )
    if scores.map is not None:
        text += (
            f"; map against the true one: MSE {scores.map.mse:.4f}, SSIM {scores.map.ssim:.3f}, "
            f"wall IoU {scores.map.wall_iou_tolerant:.2f} (within 0.25 m)"
        )
    if scores.trajectory is None:
        text += "; no truth to compare with"
    return text


def whose_error(scored: Sequence[str], num_vehicles: int) -> str:
    """Say whose an error is: it is not that of vehicles which are in no common frame."""
    if len(scored) == num_vehicles:
        return "in one frame" if num_vehicles > 1 else f"of {scored[0]}"
    return f"of {', '.join(scored)} alone ({len(scored)} of {num_vehicles} vehicles)"


def _draw(
    outcome: Outcome, facts: RunFacts, truth: Truth | None, scores: Scores
) -> dict[str, bytes]:
    images: dict[str, bytes] = {}
    for name, figure in _figures(outcome, facts, truth, scores):
        if figure is not None:
            images[name] = pictures.png_bytes(figure)
    for index, look in outcome.looks:
        images[f"match_{index}"] = look.picture("agreement", _LOOK_PIXELS)
    return images


def _figures(
    outcome: Outcome, facts: RunFacts, truth: Truth | None, scores: Scores
) -> Iterator[tuple[str, Figure | None]]:
    """One after the other, for each holds its maps as pictures."""
    num = len(outcome.vehicles)
    number = {1: "One map", 2: "Two maps", 3: "Three maps", 4: "Four maps"}.get(num, f"{num} maps")
    yield "before_after", pictures.before_after(outcome, f"{number} before, one map after")
    if truth is not None:
        give_back()
        yield "map_against_truth", pictures.truth_comparison(outcome, truth, scores)
        yield "trajectory_error", pictures.error_plot(outcome, truth, scores)
    if facts.link:
        yield "link", known_over_time(facts.link)


def render_html(
    outcome: Outcome, facts: RunFacts, scores: Scores, images: Mapping[str, bytes]
) -> str:
    """Fill the template; pictures become data URIs, so that the file stands alone."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("uw_dslam_ros2.cli.reporting"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = _number
    environment.filters["degrees"] = math.degrees
    colors = pictures.vehicle_colors([v.vehicle_id for v in outcome.vehicles])
    return environment.get_template("report.html.j2").render(
        outcome=outcome,
        facts=facts,
        scores=scores,
        headline=headline(outcome, scores),
        whose=""
        if scores.trajectory is None
        else whose_error(list(scores.trajectory.per_vehicle_rmse_m), outcome.num_vehicles),
        colors=colors,
        images={
            name: "data:image/png;base64," + base64.b64encode(content).decode()
            for name, content in images.items()
        },
        key={name: f"#{bytes(colour[:3]).hex()}" for name, colour in KEY.items()},
        meaning={verdict.name: text for verdict, text in _MEANING.items()},
        settings=sorted(_flat(facts.settings)),
    )


def _number(value: float | int | None, digits: int = 2) -> str:
    """Show a number, or a dash where there is none."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "–"
    return f"{value:,}" if isinstance(value, int) else f"{value:.{digits}f}"


def _flat(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    for name, value in values.items():
        if isinstance(value, Mapping):
            rows += _flat(value, f"{prefix}{name}.")
        else:
            rows.append((f"{prefix}{name}", str(value)))
    return rows
