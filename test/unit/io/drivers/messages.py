"""Messages made by hand, field for field as their definitions have them."""

from types import SimpleNamespace as Msg

import numpy as np

STAMP_NS = 12_000_000_345


def header(frame_id="sonar"):
    return Msg(stamp=Msg(sec=12, nanosec=345), frame_id=frame_id)


def vector(x, y, z):
    return Msg(x=float(x), y=float(y), z=float(z))


def quaternion(x, y, z, w):
    return Msg(x=float(x), y=float(y), z=float(z), w=float(w))


def image_data(pixels, beam_count, dtype=0, is_bigendian=False):
    """``marine_acoustic_msgs/SonarImageData`` of an array, whose bytes are taken as they lie."""
    data = np.ascontiguousarray(pixels).reshape(-1).view(np.uint8)
    return Msg(is_bigendian=is_bigendian, dtype=dtype, beam_count=beam_count, data=data)


def target_at(bearing_deg, range_m, event):
    """Assert that an image's brightest pixel lies there, left being positive."""
    image = event.image
    row, column = np.unravel_index(np.argmax(image.intensity), image.intensity.shape)
    np.testing.assert_allclose(np.degrees(image.bearing_rad[column]), bearing_deg, atol=1e-3)
    np.testing.assert_allclose(image.range_m[row], range_m, atol=1e-6)


def pose(x=0.0, y=0.0, z=0.0, yaw=0.0):
    return Msg(
        position=vector(x, y, z), orientation=quaternion(0, 0, np.sin(yaw / 2), np.cos(yaw / 2))
    )
