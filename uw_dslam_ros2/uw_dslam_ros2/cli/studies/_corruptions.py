"""What drivers and set-ups get wrong, done to readings that are right."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from uw_dslam_ros2.core.findings import Finding
from uw_dslam_ros2.io.drivers import ADAPTERS, ReadSettings
from uw_dslam_ros2.io.interfaces import make_typestore
from uw_dslam_ros2.io.outgoing import MessageFactory
from uw_dslam_ros2.io.readings import ImageEvent, ImuEvent, Reading, VelocityEvent

__all__ = ["CORRUPTIONS", "Corruption"]

FloatArray = NDArray[np.float64]
Tell = Callable[[Finding], None]
Change = Callable[[Reading, float], Reading]

_IMAGE_TYPE = "marine_acoustic_msgs/msg/ProjectedSonarImage"
_LOST_S = (40.0, 70.0)
_SLOW_S = 0.8
_FULL_SCALE = 255.0


@dataclass(frozen=True, slots=True)
class Corruption:
    """One thing that is wrong with a recording.

    Parameters
    ----------
    kinds : findings that name it; empty: it is read rightly without a word.
    mends : conventions that undo it, as far as the recording tells them.
    start : makes the change of a reading and the seconds since the start; one for each recording,
        with what is told while reading.
    delay_s : by role, how much later than true its stamps are.
    """

    kinds: tuple[str, ...]
    start: Callable[[Tell], Change]
    mends: Mapping[str, str | float | bool] = field(default_factory=dict)
    delay_s: Mapping[str, float] = field(default_factory=dict)


def _same(reading: Reading, _: float) -> Reading:
    return reading


def _imu(
    orientation: Callable[[FloatArray], FloatArray] | None = None,
    rates: Callable[[FloatArray], FloatArray] | None = None,
) -> Callable[[Tell], Change]:
    def change(reading: Reading, _: float) -> Reading:
        if not isinstance(reading, ImuEvent):
            return reading
        assert reading.orientation_xyzw is not None
        assert reading.angular_velocity_rad_s is not None
        return replace(
            reading,
            orientation_xyzw=(orientation or np.copy)(reading.orientation_xyzw),
            angular_velocity_rad_s=(rates or np.copy)(reading.angular_velocity_rad_s),
        )

    return lambda _: change


def _as_ned(orientation_xyzw: FloatArray) -> FloatArray:
    """Of a level vehicle: the heading from north, clockwise."""
    yaw = 2.0 * math.atan2(orientation_xyzw[2], orientation_xyzw[3])
    half = 0.5 * (0.5 * math.pi - yaw)
    return np.array([0.0, 0.0, math.sin(half), math.cos(half)])


def _velocity(matrix: FloatArray) -> Callable[[Tell], Change]:
    """`matrix` (2, 2) takes forward and left as they are to what is said."""
    to_port = np.array([1.0, -1.0])

    def change(reading: Reading, _: float) -> Reading:
        if not isinstance(reading, VelocityEvent):
            return reading
        said = matrix @ (reading.velocity_m_s[:2] * to_port) * to_port
        return replace(reading, velocity_m_s=np.append(said, 0.0))

    return lambda _: change


def _turn(angle_rad: float) -> FloatArray:
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[cos, -sin], [sin, cos]])


def _without_lock(_: Tell) -> Change:
    def change(reading: Reading, elapsed_s: float) -> Reading:
        if isinstance(reading, VelocityEvent) and _LOST_S[0] < elapsed_s < _LOST_S[1]:
            return replace(reading, velocity_m_s=np.zeros(3))
        return reading

    return change


def _slow_heading(_: Tell) -> Change:
    """An orientation from behind a filter, beside rates that are in time."""
    waiting: deque[tuple[float, FloatArray]] = deque()

    def change(reading: Reading, elapsed_s: float) -> Reading:
        if not isinstance(reading, ImuEvent) or reading.orientation_xyzw is None:
            return reading
        waiting.append((elapsed_s, reading.orientation_xyzw))
        while len(waiting) > 1 and waiting[1][0] <= elapsed_s - _SLOW_S:
            waiting.popleft()
        return replace(reading, orientation_xyzw=waiting[0][1])

    return change


def _image(
    *,
    bearing: Callable[[FloatArray], FloatArray] = np.copy,
    range_scale: float = 1.0,
    intensity: Callable[[NDArray[np.generic]], NDArray[np.generic]] = np.copy,
) -> Callable[[Tell], Change]:
    def change(reading: Reading, _: float) -> Reading:
        if not isinstance(reading, ImageEvent):
            return reading
        image = reading.image
        image = replace(
            image,
            bearing_rad=bearing(image.bearing_rad),
            range_m=image.range_m * range_scale,
            intensity=intensity(image.intensity),
        )
        return replace(reading, image=image)

    return lambda _: change


def _as_power(pixels: NDArray[np.generic]) -> NDArray[np.generic]:
    """The simulator's pixels are the fourth root of an echo's power."""
    return np.asarray((np.asarray(pixels, np.float32) / _FULL_SCALE) ** 4, np.float32)


def _message(
    *, data_order: str = "range_major", is_swapped: bool = False
) -> Callable[[Tell], Change]:
    """Take the image through its driver's message."""

    def start(tell: Tell) -> Change:
        make = MessageFactory(make_typestore())
        settings = ReadSettings(role="sonar", tell=tell)

        def change(reading: Reading, _: float) -> Reading:
            if not isinstance(reading, ImageEvent):
                return reading
            image = reading.image
            if is_swapped:
                deep = np.asarray(image.intensity, np.uint16) * np.uint16(256) + np.uint16(17)
                image = replace(image, intensity=deep.byteswap())
            msg = make.sonar_image(reading.frame_id, image, data_order=data_order)
            (read,) = ADAPTERS[_IMAGE_TYPE].read(msg, settings)
            return replace(read, vehicle_id=reading.vehicle_id)

        return change

    return start


def _late(role: str, seconds: float, mend: str) -> Corruption:
    kinds = {"imu": ("imu_delay",), "velocity": ("velocity_delay",), "sonar": ("sonar_delay",)}
    return Corruption(kinds[role], lambda _: _same, {mend: seconds}, {role: seconds})


CORRUPTIONS: dict[str, Corruption] = {
    "none": Corruption((), lambda _: _same),
    "imu speaks NED": Corruption(
        ("imu_ned",),
        _imu(_as_ned, lambda rates: rates * [1.0, -1.0, -1.0]),
        {"imu_orientation": "ned", "imu_rates": "frd"},
    ),
    "only its orientation is NED": Corruption(
        ("imu_ned",), _imu(_as_ned), {"imu_orientation": "ned"}
    ),
    "rates in degrees": Corruption(
        ("imu_rates_in_degrees",), _imu(rates=np.degrees), {"imu_rates_in_degrees": True}
    ),
    "rates never filled": Corruption(
        ("imu_no_rates",), _imu(rates=np.zeros_like), {"imu_rates": "none"}
    ),
    "default quaternion": Corruption(
        ("imu_no_orientation",),
        _imu(lambda _: np.array([0.0, 0.0, 0.0, 1.0])),
        {"imu_orientation": "none"},
    ),
    "heading 0.8 s behind the rates": Corruption(
        ("heading_delay",), _slow_heading, {"imu_rates": "none", "imu_delay_s": _SLOW_S}
    ),
    "dvl's sign": Corruption(
        ("dvl_sign",), _velocity(-np.eye(2)), {"velocity_yaw_offset_rad": math.pi}
    ),
    "dvl's y to the other side": Corruption(
        ("dvl_mirrored",), _velocity(np.diag([1.0, -1.0])), {"velocity_is_mirrored": True}
    ),
    "dvl turned by 45 degrees": Corruption(
        ("dvl_turned",),
        _velocity(_turn(math.radians(-45.0))),
        {"velocity_yaw_offset_rad": math.radians(45.0)},
    ),
    "dvl in mm/s": Corruption(
        ("dvl_unit",), _velocity(1000.0 * np.eye(2)), {"velocity_scale": 0.001}
    ),
    "dvl 4 % long": Corruption(
        ("dvl_scale",), _velocity(1.04 * np.eye(2)), {"velocity_scale": 1.0 / 1.04}
    ),
    "zeros without lock": Corruption(
        ("dvl_zero_without_lock",), _without_lock, {"velocity_zero_is_invalid": True}
    ),
    "sonar mirrored": Corruption(
        ("sonar_mirrored",), _image(bearing=np.negative), {"sonar_is_mirrored": True}
    ),
    "beams in reverse order": Corruption(
        ("sonar_mirrored",),
        _image(intensity=lambda pixels: pixels[:, ::-1]),
        {"sonar_is_mirrored": True},
    ),
    "sonar turned by 30 degrees": Corruption(
        ("sonar_turned",),
        _image(bearing=lambda bearing: bearing + math.radians(30.0)),
        {"sonar_yaw_offset_rad": math.radians(-30.0)},
    ),
    "bytes beam by beam": Corruption((), _message(data_order="beam_major")),
    "bytes swapped": Corruption(("sonar_byte_order",), _message(is_swapped=True)),
    "power for amplitude": Corruption(("sonar_power",), _image(intensity=_as_power)),
    "speed of sound 4 % off": Corruption(
        ("sound_speed",), _image(range_scale=1.04), {"sonar_range_scale": 1.0 / 1.04}
    ),
    "imu 0.8 s late": _late("imu", 0.8, "imu_delay_s"),
    "dvl 0.8 s late": _late("velocity", 0.8, "velocity_delay_s"),
    "sonar 0.4 s late": _late("sonar", 0.4, "sonar_delay_s"),
}  # fmt: skip
