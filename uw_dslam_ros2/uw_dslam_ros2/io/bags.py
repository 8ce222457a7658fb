"""Bags under one name: `recordings` reads and writes files, `events` gives them a meaning."""

from uw_dslam_ros2.io.events import (
    DepthEvent,
    Event,
    ImageEvent,
    ImuEvent,
    PointsEvent,
    ScanEvent,
    TransformEvent,
    TruthEvent,
    VelocityEvent,
    read_events,
)
from uw_dslam_ros2.io.recordings import (
    BagReader,
    BagWriter,
    Message,
    RawMessage,
    merged,
    open_bag,
    open_bags,
)

__all__ = [
    "BagReader",
    "BagWriter",
    "DepthEvent",
    "Event",
    "ImageEvent",
    "ImuEvent",
    "Message",
    "PointsEvent",
    "RawMessage",
    "ScanEvent",
    "TransformEvent",
    "TruthEvent",
    "VelocityEvent",
    "merged",
    "open_bag",
    "open_bags",
    "read_events",
]
