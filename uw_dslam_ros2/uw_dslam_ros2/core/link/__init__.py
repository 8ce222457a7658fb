"""What crosses an acoustic link: submaps in a few hundred bytes."""

from uw_dslam_ros2.core.link.coding.codec import (
    CODEC_VERSION,
    CellLayer,
    Layer,
    LayeredSubmap,
    encode_submap,
    read_outline,
)
from uw_dslam_ros2.core.link.coding.items import LayerKey
from uw_dslam_ros2.core.link.coding.outline import Outline
from uw_dslam_ros2.core.link.link import NUM_EPOCHS, AcousticLink
from uw_dslam_ros2.core.link.types import LinkConfig, LinkCounts, LinkState, ReceivedState

__all__ = [
    "CODEC_VERSION",
    "NUM_EPOCHS",
    "AcousticLink",
    "CellLayer",
    "Layer",
    "LayerKey",
    "LayeredSubmap",
    "LinkConfig",
    "LinkCounts",
    "LinkState",
    "Outline",
    "ReceivedState",
    "encode_submap",
    "read_outline",
]
