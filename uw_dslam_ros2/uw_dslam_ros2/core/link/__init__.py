"""What crosses an acoustic link: submaps in a few hundred bytes."""

from uw_dslam_ros2.core.link.codec import (
    CODEC_VERSION,
    CellLayer,
    Layer,
    LayeredSubmap,
    encode_submap,
    read_outline,
)
from uw_dslam_ros2.core.link.outline import Outline

__all__ = [
    "CODEC_VERSION",
    "CellLayer",
    "Layer",
    "LayeredSubmap",
    "Outline",
    "encode_submap",
    "read_outline",
]
