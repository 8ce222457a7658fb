"""Quality of service, as other packages expect it; docs/interfaces.md says what uses which."""

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

__all__ = [
    "ANSWERS",
    "CLOCK",
    "DEFAULT",
    "LATCHED",
    "MODEM",
    "PLAYBACK",
    "SERVICES",
    "STATIC_TF",
    "SUBMAPS",
    "TF",
    "sensor_qos",
]

LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""Maps, paths, status: whoever comes late gets the newest."""

SUBMAPS = QoSProfile(
    depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""Submaps: a manager that starts late gets the last hundred."""

STATIC_TF = QoSProfile(
    depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
TF = QoSProfile(depth=100)
DEFAULT = QoSProfile(depth=10)
CLOCK = QoSProfile(depth=10)

SERVICES = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
"""Requests and answers: of the usual ten, a burst loses those that come while none is taken."""

MODEM = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
"""Packets between a link and its modem: what is lost on the way is lost in the water."""

ANSWERS = QoSProfile(
    depth=1000,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""Shared answers of registrations: who starts again gets those from before."""

PLAYBACK = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
"""What a bag player offers: reliable, so that large images arrive; best effort matches it too."""


def sensor_qos(depth: int, *, is_reliable: bool) -> QoSProfile:
    """Sensor subscription: best effort matches every driver, reliable loses nothing in replays."""
    reliability = ReliabilityPolicy.RELIABLE if is_reliable else ReliabilityPolicy.BEST_EFFORT
    return QoSProfile(depth=depth, history=HistoryPolicy.KEEP_LAST, reliability=reliability)
