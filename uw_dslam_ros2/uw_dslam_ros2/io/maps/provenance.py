"""Who saw what in a map, and where they disagree, on disk."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np

from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.grid import GridSpec
from uw_dslam_ros2.core.merging import MapProvenance
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.core.submap import SubmapId
from uw_dslam_ros2.io.atomic import write_files

__all__ = ["contradictions_png", "read_provenance", "write_provenance"]

_NOT_SEEN, _AGREED = (217, 213, 209), (255, 255, 255)  # blue, green, red
# Agreement is white; one submap against the others is yellow, four and more are dark red.
_DISPUTED = ((0, 210, 255), (0, 140, 240), (20, 60, 220), (30, 0, 130))


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
    archive = io.BytesIO()
    np.savez_compressed(
        archive,
        header=np.frombuffer(json.dumps(header).encode(), dtype=np.uint8),
        contradictions=provenance.contradictions,
        owners=provenance.owners,
    )
    return write_files(
        {
            prefix.with_name(f"{prefix.name}_contradictions.png"): contradictions_png(provenance),
            prefix.with_name(f"{prefix.name}_provenance.npz"): archive.getvalue(),
        }
    )


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
    return MapProvenance(spec, contradictions, owners, contributors)


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
    import cv2  # large, and not every program has pictures

    colors = np.array([_AGREED, *_DISPUTED, _NOT_SEEN], dtype=np.uint8)
    # Which colour first: three bytes a cell are needed once, and upside down.
    which = np.minimum(provenance.contradictions, len(_DISPUTED)).astype(np.uint8)
    which[provenance.owners == 0] = len(colors) - 1
    is_done, content = cv2.imencode(".png", colors[np.flipud(which)])
    assert is_done
    return content.tobytes()
