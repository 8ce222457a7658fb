"""Vehicles that send no submaps, but any program's ``nav_msgs/OccupancyGrid``, which grows."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from nav_msgs.msg import OccupancyGrid
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from uw_dslam_ros2.core.errors import ConfigError, InvalidInputError
from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.merging import GrowingMap, GrowingMapConfig, MapChange
from uw_dslam_ros2.core.submap import Submap
from uw_dslam_ros2.ros.convert.core_types import occupancy_from_msg, stamp_ns_from_msg

__all__ = ["MapInputs", "vehicle_of"]

_MAP_TYPE = "nav_msgs/msg/OccupancyGrid"
_MAP_NAME = "map"
_QUEUE_DEPTH = 2  # a map replaces the one before it


@dataclass(slots=True, eq=False)
class _Input:
    topic: str
    vehicle_id: str
    subscription: Subscription | None = None
    frame_id: str = ""
    growing: GrowingMap | None = None
    num_known: int = -1
    is_rested: bool = True


class MapInputs:
    """Takes maps from topics and tells what of them is new; all methods belong to one thread.

    Parameters
    ----------
    node
        Whose subscriptions they are.
    topics
        Each is one vehicle's; its name is what stands before the last part.
    is_discovering
        Take every topic called ``map`` on the graph, but the node's own and those of vehicles
        that send submaps.
    config
        How maps are cut.
    post
        Hands a function to the thread that owns this object.
    on_change
        Called with topic, vehicle and what is new.
    on_growth
        Called when a map has grown, be it told already or not.
    complain
        Called with what is wrong with a message.
    submaps_of
        What is held of a vehicle from before.

    Raises
    ------
    ConfigError
        If a topic is the node's own map, or two topics are of one vehicle.
    """

    def __init__(
        self,
        node: Node,
        topics: Sequence[str],
        *,
        is_discovering: bool,
        config: GrowingMapConfig,
        post: Callable[[Callable[[], None]], None],
        on_change: Callable[[str, str, MapChange], None],
        on_growth: Callable[[], None],
        complain: Callable[[str], None],
        submaps_of: Callable[[str], Iterable[Submap]],
    ) -> None:
        self._node, self._config, self._is_discovering = node, config, is_discovering
        self._post, self._on_change, self._on_growth = post, on_change, on_growth
        self._complain, self._submaps_of = complain, submaps_of
        self._group = ReentrantCallbackGroup()
        self._own = node.resolve_topic_name(_MAP_NAME)
        self._inputs: dict[str, _Input] = {}
        for topic in topics:
            self._add(f"/{topic.strip('/')}")

    def _add(self, topic: str) -> None:
        if topic == self._own:
            raise ConfigError(
                f"parameter map_topics names {topic}, the map that is published here"
            )
        new = _Input(topic, vehicle_of(topic))
        for old in self._inputs.values():
            if old.vehicle_id == new.vehicle_id:
                raise ConfigError(
                    f"parameter map_topics names {old.topic} and {topic}, both of vehicle "
                    f"{new.vehicle_id!r}; expected one of each"
                )
        self._inputs[topic] = new

    def look(self) -> None:
        """Find maps, and listen to those that are sent."""
        if self._is_discovering:
            self._discover()
        for one in self._inputs.values():
            if one.subscription is None:
                self._subscribe(one)

    def _discover(self) -> None:
        table = dict(self._node.get_topic_names_and_types())
        for topic, types in table.items():
            head, _, name = topic.rpartition("/")
            names = {one.vehicle_id for one in self._inputs.values()}
            is_ours = topic == self._own or f"{head}/submap" in table
            is_taken = is_ours or vehicle_of(topic) in names
            if name == _MAP_NAME and _MAP_TYPE in types and not is_taken:
                self._add(topic)

    def _subscribe(self, one: _Input) -> None:
        infos = self._node.get_publishers_info_by_topic(one.topic)
        if not infos:
            return
        # Latched where the sender is, else nothing would be heard of one that is not.
        is_latched = all(
            info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for info in infos
        )
        qos = QoSProfile(
            depth=_QUEUE_DEPTH,
            reliability=ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.TRANSIENT_LOCAL
            if is_latched
            else DurabilityPolicy.VOLATILE,
        )
        one.subscription = self._node.create_subscription(
            OccupancyGrid,
            one.topic,
            functools.partial(self._on_map, one),
            qos,
            callback_group=self._group,
        )
        self._node.get_logger().info(f"taking the map of {one.vehicle_id} from {one.topic}")

    def _on_map(self, one: _Input, msg: OccupancyGrid) -> None:
        try:
            occupancy = occupancy_from_msg(msg, "map")
        except InvalidInputError as error:
            self._complain(f"bad map on {one.topic}: {error}")
            return
        stamp_ns = stamp_ns_from_msg(msg.header.stamp)
        self._post(lambda: self._take(one, occupancy, stamp_ns, msg.header.frame_id))

    def _take(self, one: _Input, occupancy: OccupancyMap, stamp_ns: int, frame_id: str) -> None:
        if one.growing is None:
            submaps = self._submaps_of(one.vehicle_id)
            one.growing = GrowingMap(one.vehicle_id, self._config, submaps)
        one.frame_id = frame_id.strip("/")
        try:
            change = one.growing.update(occupancy, stamp_ns)
        except InvalidInputError as error:
            self._complain(f"map refused on {one.topic}: {error}")
            return
        num_known = int(occupancy.known.sum())
        if num_known != one.num_known:
            one.num_known = num_known
            self._on_growth()
        one.is_rested = False
        self._on_change(one.topic, one.vehicle_id, change)

    def stop(self) -> None:
        """Listen no more, until `look` is called again."""
        for one in self._inputs.values():
            if one.subscription is not None:
                self._node.destroy_subscription(one.subscription)
                one.subscription = None

    def rest(self) -> None:
        """Tell what was held back because it was little."""
        for one in self._inputs.values():
            if one.growing is not None and not one.is_rested:
                one.is_rested = True
                self._on_change(one.topic, one.vehicle_id, one.growing.rest())

    def forget(self) -> None:
        """What is held has changed: look at it anew with the next map of each vehicle."""
        for one in self._inputs.values():
            one.growing = None

    def frame_of(self, vehicle_id: str, map_frame: str) -> str:
        """Frame of a vehicle's own map: as it names it, unless that names something else."""
        usual = f"{vehicle_id}/{_MAP_NAME}"
        frames = {one.vehicle_id: one.frame_id for one in self._inputs.values()}
        own = frames.pop(vehicle_id, "")
        return usual if own in ("", map_frame, *frames.values()) else own


def vehicle_of(topic: str) -> str:
    """Name of the vehicle whose map a topic is: ``/robot1/map`` is of ``robot1``."""
    head, _, tail = topic.strip("/").rpartition("/")
    return head or tail
