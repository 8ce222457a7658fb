"""Who saw what in a map, and where they disagree, on disk."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.grid import GridSpec
from uw_dslam_ros2.core.merging import MapProvenance
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.sparse_cells import SparseCells
from uw_dslam_ros2.core.submap import SubmapId
from uw_dslam_ros2.io.atomic import write_files
from uw_dslam_ros2.io.maps.png import png_parts

__all__ = ["contradictions_png", "read_provenance", "write_provenance"]

_NOT_SEEN, _AGREED = (209, 213, 217), (255, 255, 255)  # red, green, blue
# Agreement is white; one submap against the others is yellow, four and more are dark red.
_DISPUTED = ((255, 210, 0), (240, 140, 0), (220, 60, 20), (130, 0, 30))


def write_provenance(path_prefix: str | Path, provenance: MapProvenance) -> list[Path]:
    """Write ``PREFIX_contradictions.png`` and ``PREFIX_provenance.npz``; return the paths.

    The picture covers the same cells as the map's: white where all agree, yellow to dark red where
    one to four and more submaps say the opposite of the majority, grey where nothing was seen. The
    archive holds ``contradictions`` and ``owners`` (R, C), first row lowest, and ``header``, JSON
    in UTF-8 with ``resolution_m``, ``origin`` [x, y, yaw], and ``contributors``: the submaps of
    each number in ``owners``.

    Raises
    ------
    DataError
        With the path and the reason.
    """
    prefix = Path(path_prefix)
    header = {
        "resolution_m": provenance.spec.resolution_m,
        "origin": provenance.spec.T_frame_grid.as_array().tolist(),
        "contributors": [[_text(i) for i in ids] for ids in provenance.contributors],
    }
    return write_files(
        {
            prefix.with_name(f"{prefix.name}_contradictions.png"): _picture_parts(provenance),
            prefix.with_name(f"{prefix.name}_provenance.npz"): _archive(header, provenance),
        }
    )


def _archive(header: dict[str, Any], provenance: MapProvenance) -> bytes:
    """As `numpy.savez_compressed` writes it, of arrays that never are there whole."""
    content = io.BytesIO()
    text = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, shape, dtype, parts in (
            ("header", text.shape, text.dtype, iter([text])),
            *(
                (name, cells.shape, cells.dtype, cells.strips())
                for name, cells in (
                    ("contradictions", provenance.contradictions),
                    ("owners", provenance.owners),
                )
            ),
        ):
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                kind = {"descr": dtype.str, "fortran_order": False, "shape": shape}
                np.lib.format.write_array_header_1_0(entry, kind)
                for part in parts:
                    entry.write(np.ascontiguousarray(part).data)
    return content.getvalue()


def read_provenance(path: str | Path) -> MapProvenance:
    """Read a ``*_provenance.npz``.

    Raises
    ------
    DataError
        With the path and what is wrong.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            header = json.loads(arrays["header"].tobytes())
            contradictions, owners = arrays["contradictions"], arrays["owners"]
        contributors = tuple(
            tuple(_submap_id(text) for text in ids) for ids in header["contributors"]
        )
        rows, cols = owners.shape
        spec = GridSpec(header["resolution_m"], rows, cols, SE2(*header["origin"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path} is not a map's provenance: {error}") from error
    cells = SparseCells.of(contradictions), SparseCells.of(owners)
    return MapProvenance(spec, *cells, contributors)


def _text(submap_id: SubmapId) -> str:
    """``vehicle/sequence``, or ``vehicle#run/sequence`` where the run is known."""
    vehicle, run, sequence = submap_id
    return f"{vehicle}/{sequence}" if run == 0 else f"{vehicle}#{run}/{sequence}"


def _submap_id(text: str) -> SubmapId:
    track, _, sequence = text.rpartition("/")
    vehicle, mark, run = track.rpartition("#")
    return (
        SubmapId(vehicle, int(run), int(sequence)) if mark else SubmapId(track, 0, int(sequence))
    )


def contradictions_png(provenance: MapProvenance) -> bytes:
    """Picture of where submaps disagree, as `write_provenance` describes it."""
    return b"".join(_picture_parts(provenance))


def _picture_parts(provenance: MapProvenance) -> Iterator[bytes]:
    colors = np.array([_AGREED, *_DISPUTED, _NOT_SEEN], dtype=np.uint8)
    disputed, owners = (
        cells.strips(is_downward=True) for cells in (provenance.contradictions, provenance.owners)
    )

    def strips() -> Iterator[NDArray[np.uint8]]:
        for number, owner in zip(disputed, owners, strict=True):
            color = np.minimum(number, len(_DISPUTED)).astype(np.uint8)
            color[owner == 0] = len(colors) - 1
            yield color

    return png_parts(provenance.spec.shape, strips(), colors)
