"""Walls as lines on disk: GeoJSON for GIS programs, DXF for drawing programs."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Any

from uw_dslam_ros2.core.chart.lines import Pier, Wall

__all__ = ["dxf_bytes", "walls_geojson_bytes"]

_DIGITS = 3  # millimetres


def walls_geojson_bytes(walls: Sequence[Wall], piers: Sequence[Pier]) -> bytes:
    """A GeoJSON FeatureCollection; coordinates are metres of the map's frame.

    Walls are LineStrings of ``kind`` "wall", piers Points of ``kind`` "pier"; both have
    ``width_m`` and ``last_seen_s``, seconds since 1970 or null.
    """
    features = [
        _feature("wall", wall, "LineString", wall.points.round(_DIGITS).tolist()) for wall in walls
    ] + [
        _feature("pier", pier, "Point", [round(pier.x, _DIGITS), round(pier.y, _DIGITS)])
        for pier in piers
    ]
    return (json.dumps({"type": "FeatureCollection", "features": features}) + "\n").encode()


def _feature(kind: str, what: Wall | Pier, shape: str, coordinates: list[Any]) -> dict[str, Any]:
    seen_s = None if what.last_seen_ns is None else what.last_seen_ns / 1e9
    return {
        "type": "Feature",
        "properties": {
            "kind": kind,
            "width_m": round(what.width_m, _DIGITS),
            "last_seen_s": seen_s,
        },
        "geometry": {"type": shape, "coordinates": coordinates},
    }


def dxf_bytes(walls: Sequence[Wall], piers: Sequence[Pier]) -> bytes:
    """A DXF drawing of release 12, which every CAD program reads; units are metres.

    Walls are polylines with their width on layer WALLS, piers circles on layer PIERS. Release 12
    needs entities alone: see "DXF Reference", Autodesk, sections POLYLINE, VERTEX, CIRCLE.
    """
    groups = [*_section("HEADER", _HEADER), *_section("ENTITIES", _entities(walls, piers))]
    lines = (f"{code:>3}\n{value}\n" for code, value in [*groups, (0, "EOF")])
    return "".join(lines).encode("ascii")


Group = tuple[int, str]
_HEADER: tuple[Group, ...] = ((9, "$ACADVER"), (1, "AC1009"))


def _section(name: str, content: Iterator[Group] | Sequence[Group]) -> Iterator[Group]:
    yield from ((0, "SECTION"), (2, name), *content, (0, "ENDSEC"))


def _entities(walls: Sequence[Wall], piers: Sequence[Pier]) -> Iterator[Group]:
    for wall in walls:
        width = f"{wall.width_m:.{_DIGITS}f}"
        yield from ((0, "POLYLINE"), (8, "WALLS"), (66, "1"), (70, "0"), (40, width), (41, width))
        yield from _place(0.0, 0.0)
        for x, y in wall.points:
            yield from ((0, "VERTEX"), (8, "WALLS"), *_place(x, y))
        yield from ((0, "SEQEND"), (8, "WALLS"))
    for pier in piers:
        yield from ((0, "CIRCLE"), (8, "PIERS"), *_place(pier.x, pier.y))
        yield 40, f"{0.5 * pier.width_m:.{_DIGITS}f}"


def _place(x: float, y: float) -> Iterator[Group]:
    yield from ((10, f"{x:.{_DIGITS}f}"), (20, f"{y:.{_DIGITS}f}"), (30, "0.0"))
