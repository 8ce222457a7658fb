"""The YAML file of a map, in all the forms that map_server takes."""

from __future__ import annotations

import codecs
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from uw_dslam_ros2.core.errors import DataError
from uw_dslam_ros2.core.se2 import SE2

__all__ = ["MapHeader"]

_MODES = ("trinary", "scale", "raw")
_TRUE, _FALSE = ("1", "true", "yes", "on", "y"), ("0", "false", "no", "off", "n")
_BOMS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)


@dataclass(frozen=True, slots=True)
class MapHeader:
    """What the YAML file says, checked."""

    image_path: Path
    mode: str
    resolution_m: float
    T_frame_grid: SE2
    negate: bool
    occupied_thresh: float
    free_thresh: float

    @classmethod
    def read(cls, path: Path) -> MapHeader:
        """From a map_server YAML file.

        Raises
        ------
        DataError
            Naming file, key, value and what was expected.
        """
        keys = _Keys(path, _content(path))
        resolution_m = keys.number("resolution")
        if resolution_m <= 0.0:
            raise keys.error("resolution", "metres per cell > 0")
        occupied_thresh, free_thresh = keys.number("occupied_thresh"), keys.number("free_thresh")
        if not 0.0 <= free_thresh < occupied_thresh <= 1.0:
            raise DataError(
                f"{path}: free_thresh is {free_thresh} and occupied_thresh {occupied_thresh}, "
                "expected 0 <= free_thresh < occupied_thresh <= 1"
            )
        return cls(
            path.parent / keys.image(),
            keys.mode(),
            resolution_m,
            keys.origin(),
            keys.negate(),
            occupied_thresh,
            free_thresh,
        )


@dataclass(frozen=True, slots=True)
class _Keys:
    """The keys of one file. All values are texts: the readers' ideas of types differ.

    ``5e-2`` is a number in YAML 1.2, which map_server reads, and a text in YAML 1.1.
    """

    path: Path
    content: dict[str, Any]

    def error(self, key: str, expected: str) -> DataError:
        """What is wrong with a key."""
        if key not in self.content:
            return DataError(f"{self.path}: {key} is missing, expected {expected}")
        return DataError(f"{self.path}: {key} is {_shown(self.content[key])}, expected {expected}")

    def image(self) -> str:
        """Path of the image, relative to the YAML file's folder or absolute."""
        value = self.content.get("image")
        if not isinstance(value, str) or not value or "\0" in value:
            raise self.error("image", "the name of a file")
        return value

    def number(self, key: str) -> float:
        """A finite number."""
        value = _as_number(self.content.get(key))
        if value is None:
            raise self.error(key, "a finite number")
        return value

    def mode(self) -> str:
        """How pixels are read; in any case, trinary where nothing is said."""
        value = self.content.get("mode", "trinary")
        mode = value.lower() if isinstance(value, str) else ""
        if mode not in _MODES:
            raise self.error("mode", "trinary, scale or raw")
        return mode

    def negate(self) -> bool:
        """Whether white is occupied; not where nothing is said."""
        value = self.content.get("negate", "0")
        word = value.lower() if isinstance(value, str) else ""
        if word not in (*_TRUE, *_FALSE):
            raise self.error("negate", "0 or 1, false or true")
        return word in _TRUE

    def origin(self) -> SE2:
        """Pose of the image's lower left corner."""
        value = self.content.get("origin")
        numbers = [_as_number(v) for v in value] if isinstance(value, list) else []
        known = [number for number in numbers if number is not None]
        if len(numbers) != 3 or len(known) != 3:
            expected = "[x, y, yaw] in metres and radians"
            if isinstance(value, list) and len(known) == 2 and value[2:] in (["nan"], ["-nan"]):
                # What map_saver writes of a map whose orientation is no rotation.
                expected += "; if the map is not turned, write 0 for nan"
            raise self.error("origin", expected)
        return SE2(*known)


def _as_number(value: Any) -> float | None:
    # Python's own float() also takes 1_000, which no YAML reader does.
    if not isinstance(value, str) or "_" in value:
        return None
    try:
        number = float(value)
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def _shown(value: Any) -> str:
    """A value as the file has it; words in quotes, numbers without."""
    if isinstance(value, list):
        return f"[{', '.join(_shown(v) for v in value)}]"
    return str(value) if _as_number(value) is not None else repr(value)


def _content(path: Path) -> dict[str, Any]:
    try:
        text = _decoded(path.read_bytes())
    except OSError as error:
        raise DataError(f"cannot read {path}: {error.strerror or error}") from error
    try:
        content = _first_document(text)
    except yaml.YAMLError as error:
        raise DataError(f"{path} is not a YAML file: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict):
        kind = "nothing" if content in (None, "") else f"a {type(content).__name__}"
        raise DataError(f"{path} holds {kind}, expected keys such as image")
    return content


def _decoded(content: bytes) -> str:
    """Text in whatever encoding: outside of comments and file names it is ASCII."""
    for mark, encoding in _BOMS:
        if content.startswith(mark):
            return content[len(mark) :].decode(encoding, errors="replace")
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError:
        return content.decode("cp1252", errors="replace")


def _first_document(text: str) -> Any:
    """The first of a file's documents; the others say nothing to map_server."""
    try:
        return next(iter(yaml.load_all(text, yaml.BaseLoader)), None)
    except yaml.YAMLError:
        if "\t" not in text:
            raise
    # Readers of YAML 1.2 take tabs as white space.
    return next(iter(yaml.load_all(text.expandtabs(), yaml.BaseLoader)), None)
