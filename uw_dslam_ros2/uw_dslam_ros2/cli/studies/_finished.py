"""Parts of a long study that are done, kept so that it can be stopped and gone on with."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from uw_dslam_ros2.io.atomic import write_files

__all__ = ["FinishedParts"]


class FinishedParts:
    """Results by name, each in a file of its own.

    Parameters
    ----------
    folder
        Where they are.
    digest
        Of all that a result hangs on; what was made with another one is made anew.
    """

    def __init__(self, folder: Path, digest: str) -> None:
        self._folder, self._digest = folder, digest

    def get(self, name: str, make: Callable[[], Any]) -> Any:
        """The result of that name, made now if it is not there; as JSON gives it back."""
        plain = "".join(c if c.isalnum() else "_" for c in name)
        path = self._folder / f"{plain}_{self._digest}.json"
        if not path.exists():
            write_files({path: json.dumps(make()).encode()})
        return json.loads(path.read_bytes())
