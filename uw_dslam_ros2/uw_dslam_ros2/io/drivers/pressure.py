"""Depth: of a pressure, or as a number."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.findings import Finding
from uw_dslam_ros2.io.drivers.adapter import Adapter, key_of
from uw_dslam_ros2.io.drivers.settings import ReadSettings
from uw_dslam_ros2.io.readings import DepthEvent

__all__ = ["ADAPTERS", "depth_of_pressure", "read_number", "read_pressure"]

_ATMOSPHERE_PA = 101325.0
_GRAVITY_M_S2 = 9.80665
_LEAST_ABSOLUTE_PA = 60_000.0  # the air's at 4 km above the sea
_MBAR = (800.0, 6000.0)  # absolute, down to 50 m


def read_pressure(msg: Any, settings: ReadSettings) -> Sequence[DepthEvent]:
    """Depth of a ``FluidPressure``, which is absolute and in Pa by its definition.

    With ``pressure: auto`` a first value below that of the air on a mountain is taken for mbar
    where it would be an absolute pressure in mbar, else for gauge pressure.
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
        if pressure >= _LEAST_ABSOLUTE_PA:
            settings.memory["pressure"] = (1.0, 0.0)
        elif _MBAR[0] <= pressure <= _MBAR[1]:
            settings.memory["pressure"] = (100.0, 0.0)
            settings.tell_once(
                Finding(
                    "depth_mbar",
                    "depth",
                    f"the first pressure is {pressure:.0f}, taken for mbar; FluidPressure is in "
                    "Pa (set pressure: gauge if it is Pa above the air's)",
                    severity="info",
                )
            )
        else:
            settings.memory["pressure"] = (1.0, _ATMOSPHERE_PA)
            settings.tell_once(
                Finding(
                    "depth_gauge",
                    "depth",
                    f"the first pressure is {pressure:.0f} Pa, less than the air's: taken for "
                    "gauge pressure (set pressure: absolute if it is not)",
                    severity="info",
                )
            )
    found: tuple[float, float] = settings.memory["pressure"]
    return found


def read_number(msg: Any, settings: ReadSettings) -> Sequence[DepthEvent]:
    """Depth of a ``std_msgs/Float32`` or ``Float64``; its sign is taken for a convention."""
    value = float(msg.data)
    if math.isnan(value):
        return ()
    if math.isinf(value):
        raise InvalidInputError(f"data is {value}, expected a finite depth in metres")
    return (DepthEvent(*key_of(msg, settings), abs(value)),)


ADAPTERS = (
    Adapter("sensor_msgs/msg/FluidPressure", ("depth",), read_pressure),
    Adapter("std_msgs/msg/Float32", ("depth",), read_number),
    Adapter("std_msgs/msg/Float64", ("depth",), read_number),
)
