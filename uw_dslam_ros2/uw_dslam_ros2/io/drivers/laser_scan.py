"""``sensor_msgs/LaserScan``: a fan of one moment, a turn of a sonar, or one of its beams."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.findings import Finding
from uw_dslam_ros2.io.drivers.adapter import Adapter, key_of, stamp_of
from uw_dslam_ros2.io.drivers.settings import ReadSettings
from uw_dslam_ros2.io.readings import BeamsEvent, ScanEvent

__all__ = ["ADAPTERS", "ONE_MOMENT_S", "read_scan"]

FloatArray = NDArray[np.float64]

ONE_MOMENT_S = 0.1
"""What takes less is taken for one moment: a vehicle moves centimetres meanwhile."""
_MIN_PROFILE = 8
_LONG_TURN_S = 3.0
"""Whole turns that come as seldom are of a sonar that turns; a ring of beams pings more often."""


def read_scan(msg: Any, settings: ReadSettings) -> Sequence[ScanEvent | BeamsEvent]:
    """Ranges over angles; with a time for each ray where the scan takes longer than a moment.

    Inf, or beyond the maximum, is no echo; NaN, or below ``range_min`` (made NaN), is invalid. The
    stamp is the first ray's by the message's definition. Some drivers of turning sonars send each
    beam by itself, with the echo's profile in ``intensities``.
    """
    ranges = np.array(msg.ranges, dtype=np.float64)
    values = (float(msg.angle_min), float(msg.angle_increment), float(msg.range_max))
    profile = np.asarray(msg.intensities, dtype=np.float64)
    if not np.isfinite(values).all():
        raise InvalidInputError(
            f"angle_min, angle_increment, range_max are {values}, expected finite numbers"
        )
    if len(ranges) <= 1 and len(profile) >= _MIN_PROFILE:
        return (_profile(msg, settings, profile),)
    if len(ranges) == 0:
        return ()
    ranges[ranges < float(msg.range_min)] = np.nan
    range_max_m = values[2] if values[2] > 0.0 else _farthest(ranges, settings)
    if range_max_m == 0.0:
        return ()
    angles = values[0] + values[1] * np.arange(len(ranges), dtype=np.float64)
    offset_s = _offsets(msg, settings, len(ranges))
    if len(ranges) > 1 and abs(offset_s[-1] - offset_s[0]) < ONE_MOMENT_S:
        return (ScanEvent(*key_of(msg, settings), angles, ranges, range_max_m),)
    stamps = stamp_of(msg) + np.round(offset_s * 1e9).astype(np.int64)
    order = np.argsort(stamps, kind="stable")
    vehicle_id, _, frame_id = key_of(msg, settings)
    return (
        BeamsEvent(
            vehicle_id,
            int(stamps[order[0]]),
            frame_id,
            stamps[order],
            angles[order],
            ranges[order],
            range_max_m,
        ),
    )


def _farthest(ranges: FloatArray, settings: ReadSettings) -> float:
    """The longest range [m] that this topic has had, where its messages say no maximum."""
    # At the maximum itself there is no echo.
    own = 1.001 * np.max(ranges, where=np.isfinite(ranges), initial=0.0)
    found = max(settings.memory.get("farthest", 0.0), float(own))
    settings.memory["farthest"] = found
    settings.tell_once(
        Finding(
            "scan_range_max",
            "sonar",
            "its scans have no range_max: the longest range that it had so far is taken",
            severity="info",
        )
    )
    return found


def _offsets(msg: Any, settings: ReadSettings, num_rays: int) -> FloatArray:
    """Time of each ray after the stamp [s]."""
    increment_s, period_s = float(msg.time_increment), float(msg.scan_time)
    if not np.isfinite((increment_s, period_s)).all():
        raise InvalidInputError(
            f"time_increment, scan_time are {(increment_s, period_s)}, expected finite numbers"
        )
    if settings.scan_period_s > 0.0:
        increment_s = settings.scan_period_s / num_rays
    elif increment_s == 0.0 and _is_turn(msg, num_rays):
        # A fan of one moment also has a scan_time, the time to the next one: only a turn is
        # spread over it.
        if period_s == 0.0:
            between_s = _time_between(msg, settings)
            period_s = between_s if between_s > _LONG_TURN_S else 0.0
        increment_s = period_s / num_rays
    offsets = increment_s * np.arange(num_rays, dtype=np.float64)
    return offsets - offsets[-1] if settings.scan_stamp == "last" else offsets


def _time_between(msg: Any, settings: ReadSettings) -> float:
    """The least time [s] from one message of this topic to the next so far; 0 of the first.

    So the first turn is taken for one moment: nobody knows yet whether the sonar turns.
    """
    stamp_ns = stamp_of(msg)
    last_ns = settings.memory.get("turn_ns")
    settings.memory["turn_ns"] = stamp_ns
    if last_ns is None:
        return 0.0
    least_s = float(settings.memory.get("turn_s", np.inf))
    if stamp_ns > last_ns:
        least_s = settings.memory["turn_s"] = min(least_s, (stamp_ns - last_ns) * 1e-9)
    if not np.isfinite(least_s):
        return 0.0  # of a clock that stands still
    if least_s > _LONG_TURN_S:
        settings.tell_once(
            Finding(
                "scan_times",
                "sonar",
                "its turns do not say when each beam was heard (time_increment and scan_time are "
                f"0): the time from one to the next, {least_s:.1f} s, is taken for that of a turn "
                "(scan_period_s)",
            )
        )
    return least_s


def _is_turn(msg: Any, num_rays: int) -> bool:
    return abs(float(msg.angle_increment)) * num_rays > 1.9 * np.pi


def _profile(msg: Any, settings: ReadSettings, profile: FloatArray) -> BeamsEvent:
    near_m, far_m = float(msg.range_min), float(msg.range_max)
    if not (np.isfinite(near_m) and far_m > near_m >= 0.0):
        raise InvalidInputError(
            f"range_min, range_max are {near_m}, {far_m}, expected 0 <= range_min < range_max"
        )
    bin_m = (far_m - near_m) / len(profile)
    return BeamsEvent(
        *key_of(msg, settings),
        beam_stamp_ns=np.array([stamp_of(msg)], np.int64),
        bearing_rad=np.array([float(msg.angle_min)]),
        range_m=near_m + (np.arange(len(profile), dtype=np.float64) + 0.5) * bin_m,
        range_max_m=far_m,
        intensity=_scaled(profile).reshape(-1, 1),
    )


def _scaled(profile: FloatArray) -> NDArray[np.generic]:
    """Counts of 8 bits that were sent as reals become counts again; shares of 1 stay."""
    is_count = profile.max() > 1.0 and (profile >= 0.0).all() and (profile <= 255.0).all()
    return np.round(profile).astype(np.uint8) if is_count else profile.astype(np.float32)


ADAPTERS = (Adapter("sensor_msgs/msg/LaserScan", ("sonar",), read_scan),)
