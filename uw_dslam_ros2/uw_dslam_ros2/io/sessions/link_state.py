"""What an acoustic link must not forget, in one file."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.link import LinkState, ReceivedState
from uw_dslam_ros2.io.atomic import write_files

__all__ = ["load_link_state", "save_link_state"]

_FORMAT = 2


def save_link_state(path: str | Path, state: LinkState) -> None:
    """Write a state, whole or not at all; `DataError` where that is not possible."""
    content = {
        "format": _FORMAT,
        "epoch": state.epoch,
        "own": [[content.hex(), *rest] for content, *rest in state.own],
        "received": {
            str(sender): {
                "epoch": received.epoch,
                "life": received.life,
                "items": [[number, item.hex()] for number, item in received.items],
                "fragments": [[*name, data.hex()] for *name, data in received.fragments],
            }
            for sender, received in state.received.items()
        },
    }
    text = json.dumps(content, separators=(",", ":"))
    write_files({Path(path): f"{_digest(text)}\n{text}\n".encode()})


def load_link_state(path: str | Path) -> LinkState | None:
    """Read a state; None where there is no file, `DataError` where it is not what was written."""
    try:
        digest, text = Path(path).read_text(encoding="ascii").split("\n")[:2]
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise DataError(f"cannot read the link's state {path}: {error}") from error
    if digest != _digest(text):
        raise DataError(
            f"the link's state {path} is damaged: its checksum is not {digest[:16]}; remove it "
            "to begin anew"
        )
    content = json.loads(text)
    if content["format"] != _FORMAT:
        raise DataError(
            f"{path} has format {content['format']}, expected {_FORMAT}; remove it to begin anew"
        )
    return LinkState(
        content["epoch"],
        tuple(
            (bytes.fromhex(item), rank, label, parts, num_sent, is_void)
            for item, rank, label, parts, num_sent, is_void in content["own"]
        ),
        {
            int(sender): ReceivedState(
                received["epoch"],
                tuple((number, bytes.fromhex(item)) for number, item in received["items"]),
                tuple(
                    (number, needed, index, bytes.fromhex(data))
                    for number, needed, index, data in received["fragments"]
                ),
                received.get("life"),
            )
            for sender, received in content["received"].items()
        },
    )


def _digest(text: str) -> str:
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()
