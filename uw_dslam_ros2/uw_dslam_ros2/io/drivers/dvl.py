"""Velocity over ground of Doppler logs, and what each driver says when it has none."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.io.drivers.adapter import Adapter, covariance_or_none, key_of, vector_of
from uw_dslam_ros2.io.drivers.settings import ReadSettings
from uw_dslam_ros2.io.readings import VelocityEvent

__all__ = ["ADAPTERS", "read_dvl", "read_nucleus", "read_simulated", "read_waterlinked"]

FloatArray = NDArray[np.float64]

_MODE_WATER = 2
_MIN_BEAMS = 3
_NO_NUMBER = -32.0  # Nortek's -32.768 means that a velocity is invalid


def read_dvl(msg: Any, settings: ReadSettings) -> Sequence[VelocityEvent]:
    """Velocity of a ``marine_acoustic_msgs/Dvl``: x forward, y to starboard, z down.

    Nothing where it was measured against the water, or bottom lock is lost. Drivers say the
    latter by too few good beams, NaN, or zeros beside an altitude or covariances of -1;
    ``waterlinked_dvl`` by ``beam_velocities_valid``. Where no beam has a velocity, that flag only
    means that the driver does not send them. Where there are beams only, theirs is used.
    """
    if int(msg.velocity_mode) == _MODE_WATER:
        return ()
    velocity = vector_of(msg.velocity)
    num_beams = int(msg.num_good_beams)
    has_beams = bool(np.any(np.nan_to_num(np.asarray(msg.beam_velocity, np.float64))))
    if 0 < num_beams < _MIN_BEAMS:
        return ()
    says_invalid = not msg.beam_velocities_valid and (has_beams or msg.beam_ranges_valid)
    if says_invalid and (has_beams or num_beams == 0):
        return ()
    covariance = covariance_or_none(msg.velocity_covar)
    if not np.isfinite(velocity[:2]).all() or not np.nan_to_num(velocity).any():
        solved = _of_beams(msg) if msg.beam_velocities_valid else None
        if solved is not None:
            velocity, covariance = solved, None
        elif not np.isfinite(velocity[:2]).all() or num_beams == 0 or _is_denied(msg):
            return ()
    return (_event(msg, settings, velocity, covariance),)


def _is_denied(msg: Any) -> bool:
    """Whether what stands beside a velocity of zeros says that it is none."""
    variances = np.asarray(msg.velocity_covar, np.float64).reshape(3, 3).diagonal()
    altitude = float(msg.altitude)
    return altitude < 0.0 or not np.isfinite(altitude) or bool((variances < 0.0).all())


def _of_beams(msg: Any) -> FloatArray | None:
    """Velocity whose projections on the beams' directions are the beams' velocities."""
    directions = np.array([(v.x, v.y, v.z) for v in msg.beam_unit_vec], dtype=np.float64)
    speeds = np.asarray(msg.beam_velocity, dtype=np.float64)
    is_used = np.isfinite(speeds) & np.isfinite(directions).all(axis=1)
    is_used &= np.abs(np.linalg.norm(directions, axis=1) - 1.0) < 0.05
    directions, speeds = directions[is_used], speeds[is_used]
    if not speeds.any() or np.linalg.matrix_rank(directions, tol=0.1) < 3:
        return None
    return np.asarray(np.linalg.lstsq(directions, speeds, rcond=None)[0], np.float64)


def read_waterlinked(msg: Any, settings: ReadSettings) -> Sequence[VelocityEvent]:
    """Velocity of a ``dvl_msgs/DVL`` (Water Linked A50, A125): x forward, z down.

    ``fom`` is the standard deviation that the instrument expects [m/s].
    """
    velocity, fom = vector_of(msg.velocity), float(msg.fom)
    if not msg.velocity_valid or not np.isfinite(velocity[:2]).all():
        return ()
    is_known = np.isfinite(fom) and fom > 0.0
    return (_event(msg, settings, velocity, np.eye(3) * fom**2 if is_known else None),)


def read_simulated(msg: Any, settings: ReadSettings) -> Sequence[VelocityEvent]:
    """Velocity of a ``DVL`` of uuv_simulator, Stonefish, COLA2: a covariance of -1 means none."""
    velocity = vector_of(msg.velocity)
    covariance = np.asarray(msg.velocity_covariance, dtype=np.float64)
    is_invalid = covariance[0] < 0.0 or not np.isfinite(velocity[:2]).all()
    if is_invalid or (not velocity.any() and float(msg.altitude) < 0.0):
        return ()
    return (_event(msg, settings, velocity, covariance_or_none(covariance)),)


def read_nucleus(msg: Any, settings: ReadSettings) -> Sequence[VelocityEvent]:
    """Velocity of Nortek Nucleus' ``interfaces/BottomTrack``, which has no header."""
    velocity = np.array([msg.velocity_x, msg.velocity_y, msg.velocity_z], dtype=np.float64)
    is_valid = msg.x_velocity_valid and msg.y_velocity_valid
    if not is_valid or not (velocity[:2] > _NO_NUMBER).all():
        return ()
    if not msg.z_velocity_valid:
        velocity[2] = 0.0
    fom = np.array([msg.fom_x, msg.fom_y, msg.fom_z], dtype=np.float64)
    covariance = covariance_or_none(np.diag(fom**2)) if msg.x_fom_valid else None
    return (_event(msg, settings, velocity, covariance),)


def _event(
    msg: Any, settings: ReadSettings, velocity: FloatArray, covariance: FloatArray | None
) -> VelocityEvent:
    velocity = np.nan_to_num(velocity)
    return VelocityEvent(*key_of(msg, settings), velocity, covariance, is_z_down=True)


_ROLES = ("velocity",)
ADAPTERS = (
    Adapter("marine_acoustic_msgs/msg/Dvl", _ROLES, read_dvl),
    Adapter("acoustic_msgs/msg/Dvl", _ROLES, read_dvl),
    Adapter("dvl_msgs/msg/DVL", _ROLES, read_waterlinked),
    Adapter("waterlinked_a50_ros_driver/msg/DVL", _ROLES, read_waterlinked),
    Adapter("cola2_msgs/msg/DVL", _ROLES, read_simulated),
    Adapter("stonefish_ros/msg/DVL", _ROLES, read_simulated),
    Adapter("stonefish_ros2/msg/DVL", _ROLES, read_simulated),
    Adapter("interfaces/msg/BottomTrack", _ROLES, read_nucleus),
)
