"""Settings of the nodes as nodes; those of what they drive are in the core."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from uw_dslam_ros2.core.config import Config, setting
from uw_dslam_ros2.io.sensor_settings import SensorConfig

__all__ = [
    "NODE_CONFIGS",
    "AcousticLinkConfig",
    "BagPlayerConfig",
    "ChannelNodeConfig",
    "MapQueueManagerConfig",
    "RegistrationServerConfig",
    "SonarMapperConfig",
    "ViewConfig",
    "names_of_all_nodes",
]


def _autostart() -> Any:
    return setting(
        True,
        doc="configure and activate at the start; else wait for the services of the life cycle",
    )


@dataclass(frozen=True, slots=True)
class SonarMapperConfig(SensorConfig):
    """Settings of the sonar mapper as a node; `mapper` holds those of the mapping itself."""

    autostart: bool = _autostart()
    vehicle_id: str = setting("", doc="the vehicle's name; empty: the node's namespace")
    is_reliable: bool = setting(
        False,
        doc="subscribe to sensors reliably: for replays, where nothing may be lost",
        is_basic=True,
    )
    reorder_s: float = setting(
        0.0,
        0.0,
        600.0,
        "a sensor is waited for this long, to use all in order [s]; 0: 1, or 60 if reliable",
    )
    session: str = setting(
        "",
        doc="folder in which it keeps what it maps, so that it goes on with its run when it is "
        "started again after it was killed; one for each vehicle and mission; empty: none",
    )
    map_period_s: float = setting(
        2.0, 0.1, 3600.0, "between two maps, by the pings' stamps and by a steady clock [s]"
    )
    map_frame: str = setting(
        "", doc="frame of the vehicle's map, which loop closures correct; empty: <vehicle>/map"
    )
    odom_frame: str = setting("", doc="frame in which odometry never jumps; empty: <vehicle>/odom")
    publishes_tf: bool = setting(
        True, doc="send the vehicle's map -> odom -> base_link on /tf; else only the topics"
    )


@dataclass(frozen=True, slots=True)
class RegistrationServerConfig(Config):
    """Settings of the registration server."""

    autostart: bool = _autostart()
    max_parallel: int = setting(
        0, 0, 256, "searches at a time; 0: as many as cores", is_basic=True
    )
    max_waiting: int = setting(4, 0, 1000, "requests that wait for their turn; more get BUSY")
    max_cells: int = setting(
        36_000_000, 1, 1_000_000_000, "largest map that is accepted, in cells (6000 x 6000)"
    )
    max_points: int = setting(100_000, 1, 10_000_000, "largest point set that is accepted")


@dataclass(frozen=True, slots=True)
class MapQueueManagerConfig(Config):
    """Settings of the manager as a node; `queue` holds those of the map queue itself."""

    autostart: bool = _autostart()
    vehicles: tuple[str, ...] = setting(
        (),
        doc="vehicles whose submaps are taken; empty: every topic of type Submap on the graph",
        is_basic=True,
    )
    map_topics: tuple[str, ...] = setting(
        (),
        doc="maps that grow (nav_msgs/OccupancyGrid), one for each vehicle: [/robot1/map, ...]",
        is_basic=True,
    )
    is_discovering_maps: bool = setting(
        False,
        doc="take every topic <vehicle>/map of a vehicle that sends no submaps, too",
    )
    start_poses: tuple[str, ...] = setting(
        (),
        doc='poses of own map frames in a shared frame, where known: ["robot1 x y yaw", ...] '
        "[m, rad]; their maps are matched near there and nowhere else",
        is_basic=True,
    )
    start_error_m: float = setting(5.0, 0.01, 1000.0, "how far each start pose may be wrong [m]")
    start_error_rad: float = setting(
        0.3, 0.001, 3.2, "how far each start pose may be turned [rad]"
    )
    fix_topics: tuple[str, ...] = setting(
        (),
        doc="position fixes (GNSS, USBL) that pull the map, below the names of their vehicles: "
        "[/auv_1/usbl, ...]; empty: none",
    )
    fix_sigma_m: float = setting(
        0.0,
        0.0,
        1000.0,
        "how far off fixes are that agree with each other [m]; none is taken for surer",
    )
    servers: tuple[str, ...] = setting(
        (),
        doc="registration servers (node names) that are asked; empty: all on the graph",
        is_basic=True,
    )
    map_frame: str = setting("map", doc="frame of the global map", is_basic=True)
    publishes_tf: bool = setting(
        True, doc="send map -> <vehicle>/map on /tf; else only in merge_status"
    )
    requests_per_server: int = setting(2, 1, 1000, "registrations asked of one server at a time")
    request_timeout_s: float = setting(
        180.0, 0.1, 86400.0, "a registration not answered by then is asked again [s]"
    )
    quiet_s: float = setting(
        0.0,
        0.0,
        3600.0,
        "without a new submap for this long, all that is left is asked [s]; 0: twice the longest "
        "time between two so far, 3 to 120 s",
    )
    publish_period_s: float = setting(
        1.0, 0.0, 3600.0, "least time between two global maps, by a steady clock [s]"
    )
    full_map_period_s: float = setting(
        5.0, 0.0, 3600.0, "between two whole maps while only parts change: those go as updates [s]"
    )
    link: str = setting(
        "",
        doc="namespace of this vehicle's acoustic link: what others have answered is not searched "
        "again; empty: none",
    )
    session: str = setting(
        "",
        doc="folder: read at the start where it exists, written after every change; empty: none",
        is_basic=True,
    )


@dataclass(frozen=True, slots=True)
class BagPlayerConfig(Config):
    """Settings of the bag player."""

    bags: tuple[str, ...] = setting(
        (), doc="rosbag2 folders, .mcap or .db3 files; several play on one clock", is_basic=True
    )
    rate: float = setting(1.0, 0.01, 10000.0, "recorded seconds played per second", is_basic=True)
    start_s: float = setting(
        0.0, 0.0, 1e7, "begin this long after the first message [s]", is_basic=True
    )
    duration_s: float = setting(0.0, 0.0, 1e7, "play this much [s]; 0: to the end", is_basic=True)
    is_looping: bool = setting(False, doc="begin again at the end; /clock jumps back then")
    is_paused: bool = setting(False, doc="wait for ~/pause (data: false) before playing")
    clock_hz: float = setting(
        40.0, 1.0, 10000.0, "at most this rate of /clock, in recorded time [Hz]"
    )
    topics: tuple[str, ...] = setting((), doc="only these topics (and /tf_static); empty: all")
    wait_s: float = setting(
        30.0, 0.0, 3600.0, "longest wait for readers of every bag before the first message [s]"
    )
    wait_for: tuple[str, ...] = setting(
        (), doc="topics that must have a reader before the first message"
    )
    max_lag_s: float = setting(
        0.0,
        0.0,
        1000.0,
        "hold while a vehicle's odom is this far behind its bag [s]; 0: never",
    )


@dataclass(frozen=True, slots=True)
class ViewConfig(Config):
    """Settings of the view of a running graph."""

    manager: str = setting("/map_queue_manager", doc="the manager's node name, with its namespace")
    address: str = setting(
        "127.0.0.1",
        doc="where the page is served; another than this machine's own asks for a token",
    )
    port: int = setting(8080, 0, 65535, "of the page; 0: any that is free", is_basic=True)
    token: str = setting("", doc="what a browser must know; empty: drawn where one is needed")


@dataclass(frozen=True, slots=True)
class AcousticLinkConfig(Config):
    """Settings of an acoustic link as a node; `link` holds those of the link itself."""

    vehicle_id: str = setting("", doc="the vehicle's name; empty: the node's namespace")
    state: str = setting(
        "",
        doc="file that outlives a restart with all that was received; empty: none",
    )
    time_scale: float = setting(
        1.0, 0.01, 1000.0, "seconds that pass in a second: as that of the simulated channel"
    )


@dataclass(frozen=True, slots=True)
class ChannelNodeConfig(Config):
    """Settings of the simulated water as a node; `channel` holds those of the water itself."""

    vehicles: tuple[str, ...] = setting(
        (),
        doc="namespaces of the vehicles whose modems it joins, in the order of turns",
    )
    domains: tuple[str, ...] = setting(
        (), doc="ROS domain of each vehicle; empty: all in the node's own"
    )
    preset: str = setting(
        "",
        doc="a documented modem: nano, rate0 or psk5; empty: by the settings of channel",
    )
    spacing_m: float = setting(60.0, 0.0, 1e5, "between one vehicle and the next [m]")
    blackouts_s: tuple[float, ...] = setting(
        (),
        doc="when nothing arrives: begin and end, begin and end, ... [s since the start]",
    )
    time_scale: float = setting(1.0, 0.01, 1000.0, "seconds that pass in a second")


NODE_CONFIGS: dict[str, type[Config]] = {
    "sonar_mapper": SonarMapperConfig,
    "registration_server": RegistrationServerConfig,
    "map_queue_manager": MapQueueManagerConfig,
    "bag_player": BagPlayerConfig,
    "view": ViewConfig,
    "acoustic_link": AcousticLinkConfig,
    "channel": ChannelNodeConfig,
}


def names_of_all_nodes() -> frozenset[str]:
    """Parameters that some node of ours has: one file under ``/**`` may serve all of them."""
    return frozenset(
        field.name for config in NODE_CONFIGS.values() for field in dataclasses.fields(config)
    )
