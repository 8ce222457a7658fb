"""Depth of a pressure; depth or heading as a number."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.findings import Finding
from uw_dslam_ros2.io.drivers.adapter import Adapter, key_of
from uw_dslam_ros2.io.drivers.settings import ReadSettings
from uw_dslam_ros2.io.readings import DepthEvent, ImuEvent

__all__ = ["ADAPTERS", "depth_of_pressure", "read_number", "read_pressure"]

_ATMOSPHERE_PA = 101325.0
_GRAVITY_M_S2 = 9.80665
_LEAST_ABSOLUTE_PA = 60_000.0  # the air's at 4 km above the sea
_MOST_DEGREES = 360.0
_OTHER_UNITS = (
    ("depth_mbar", "mbar", 100.0, (800.0, 6000.0)),  # down to 50 m
    ("depth_kpa", "kPa", 1000.0, (80.0, 130.0)),  # to 3 m; more may be centimetres of gauge
    ("depth_bar", "bar", 1e5, (0.8, 6.0)),
)
"""Absolute pressures in units that FluidPressure does not have."""


def read_pressure(msg: Any, settings: ReadSettings) -> Sequence[DepthEvent]:
    """Depth of a ``FluidPressure``, which is absolute and in Pa by its definition.

    With ``pressure: auto`` a first value below that of the air on a mountain is taken for mbar,
    kPa or bar where it would be an absolute pressure in these, else for gauge pressure.
    """
    pressure = float(msg.fluid_pressure)
    if not math.isfinite(pressure):
        raise InvalidInputError(f"fluid_pressure is {pressure}, expected a finite number of Pa")
    scale, offset_pa = _convention(pressure, settings)
    depth_m = depth_of_pressure(pressure * scale + offset_pa, settings.water_density_kg_m3)
    return (DepthEvent(*key_of(msg, settings), depth_m),)


def depth_of_pressure(pressure_pa: float, water_density_kg_m3: float) -> float:
    """Depth [m] under one atmosphere of an absolute pressure [Pa]."""
    return (pressure_pa - _ATMOSPHERE_PA) / (water_density_kg_m3 * _GRAVITY_M_S2)


def _convention(pressure: float, settings: ReadSettings) -> tuple[float, float]:
    """``(Pa per unit, Pa to add)`` of a topic, decided by its first message."""
    if settings.pressure != "auto":
        return 1.0, _ATMOSPHERE_PA if settings.pressure == "gauge" else 0.0
    if "pressure" not in settings.memory:
        settings.memory["pressure"] = _of_first(pressure, settings)
    found: tuple[float, float] = settings.memory["pressure"]
    return found


def _of_first(pressure: float, settings: ReadSettings) -> tuple[float, float]:
    if pressure >= _LEAST_ABSOLUTE_PA:
        return 1.0, 0.0
    for kind, unit, pa, (least, most) in _OTHER_UNITS:
        if least <= pressure <= most:
            settings.tell_once(
                Finding(
                    kind,
                    "depth",
                    f"the first pressure is {pressure:.4g}, taken for {unit}; FluidPressure is in "
                    "Pa (set pressure: gauge if it is Pa above the air's)",
                    severity="info",
                )
            )
            return pa, 0.0
    settings.tell_once(
        Finding(
            "depth_gauge",
            "depth",
            f"the first pressure is {pressure:.0f} Pa, less than the air's: taken for gauge "
            "pressure (set pressure: absolute if it is not)",
            severity="info",
        )
    )
    return 1.0, _ATMOSPHERE_PA


def read_number(msg: Any, settings: ReadSettings) -> Sequence[DepthEvent | ImuEvent]:
    """Depth or heading of a ``std_msgs/Float32`` or ``Float64``.

    A depth's sign is taken for a convention. A heading is in degrees from north, clockwise, as
    autopilots give it (``compass_hdg``).
    """
    value = float(msg.data)
    if math.isnan(value):
        return ()
    if settings.role != "imu":
        if math.isinf(value):
            raise InvalidInputError(f"data is {value}, expected a finite depth in metres")
        return (DepthEvent(*key_of(msg, settings), abs(value)),)
    if not abs(value) <= _MOST_DEGREES:
        raise InvalidInputError(f"data is {value}, expected a heading within 360 degrees")
    half_rad = 0.5 * math.radians(90.0 - value)
    orientation = np.array([0.0, 0.0, math.sin(half_rad), math.cos(half_rad)])
    return (ImuEvent(*key_of(msg, settings), orientation, None, None),)


ADAPTERS = (
    Adapter("sensor_msgs/msg/FluidPressure", ("depth",), read_pressure),
    Adapter("std_msgs/msg/Float32", ("depth", "imu"), read_number),
    Adapter("std_msgs/msg/Float64", ("depth", "imu"), read_number),
)
