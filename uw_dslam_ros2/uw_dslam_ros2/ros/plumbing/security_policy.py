"""Writes a SROS2 policy: what each node may send and hear, and nothing else.

::

    ./uw python -m uw_dslam_ros2.ros.plumbing.security_policy auv_1 auv_2 > policy.xml
    ros2 security create_keystore keys
    ros2 security create_enclave keys /auv_1/sonar_mapper       # and so on
    ros2 security create_permission keys /auv_1/sonar_mapper policy.xml
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree import ElementTree as ET

__all__ = ["Rights", "policy_of", "rights_of"]

_EVERY_NODE = ("/rosout", "/parameter_events")
_PARAMETERS = (
    *("~/describe_parameters", "~/get_parameter_types", "~/get_parameters", "~/list_parameters"),
    *("~/set_parameters", "~/set_parameters_atomically", "~/get_type_description"),
)
_LIFE_CYCLE = (
    *("~/change_state", "~/get_state", "~/get_available_states"),
    *("~/get_available_transitions", "~/get_transition_graph"),
)
_SENSORS = ("sonar", "scan", "points", "dvl", "imu", "depth")
_QUEUE_SERVICES = (
    *("save_map", "list_submaps", "get_submap", "list_registrations", "withdraw_submap"),
    *("restore_submap", "decide", "list_decisions", "save_session", "load_session", "settle"),
)


@dataclass(frozen=True, slots=True)
class Rights:
    """What one node may do; names as ROS resolves them (``~/finish``, ``map``, ``/tf``)."""

    namespace: str
    node: str
    publish: tuple[str, ...] = ()
    subscribe: tuple[str, ...] = ()
    reply: tuple[str, ...] = ()
    request: tuple[str, ...] = ()
    execute: tuple[str, ...] = ()

    @property
    def enclave(self) -> str:
        """Name of the node with its namespace, under which it has its keys."""
        return f"{self.namespace.rstrip('/')}/{self.node}"


def rights_of(vehicles: Sequence[str]) -> list[Rights]:
    """Rights of a mapper for each vehicle, of a server, the manager, and a player of bags.

    Sensors have their usual names; what was told to listen to other topics needs those, too.
    """
    return [*(_mapper(vehicle) for vehicle in vehicles), _server(), _manager(vehicles),
            _player(vehicles)]  # fmt: skip


def _managed(*publish: str) -> tuple[str, ...]:
    return (*_EVERY_NODE, "/diagnostics", "~/transition_event", *publish)


def _mapper(vehicle: str) -> Rights:
    return Rights(
        f"/{vehicle}",
        "sonar_mapper",
        publish=_managed("map", "odom", "path", "submap", "/tf"),
        subscribe=(*_SENSORS, "tf_static", "/tf_static", "/tf", "/clock"),
        reply=(
            *(*_PARAMETERS, *_LIFE_CYCLE),
            *("~/finish", "~/reset", "~/pause", "~/get_submap"),
        ),
    )


def _server() -> Rights:
    return Rights(
        "/",
        "registration_server",
        publish=_managed(),
        subscribe=("/clock",),
        reply=(*_PARAMETERS, *_LIFE_CYCLE, "~/register_maps", "~/register_point_sets"),
        execute=("~/register_maps",),
    )


def _manager(vehicles: Sequence[str]) -> Rights:
    return Rights(
        "/",
        "map_queue_manager",
        # The maps of groups that are not joined are named after their first vehicle and run.
        publish=_managed("map", "map_updates", "map_*", "merge_status", "pose_graph", "/tf"),
        subscribe=("/diagnostics", "/clock", *(f"/{vehicle}/submap" for vehicle in vehicles)),
        reply=(*_PARAMETERS, *_LIFE_CYCLE, *(f"~/{name}" for name in _QUEUE_SERVICES)),
        request=(
            "/registration_server/register_maps",
            *(f"/{vehicle}/sonar_mapper/get_submap" for vehicle in vehicles),
        ),
    )


def _player(vehicles: Sequence[str]) -> Rights:
    return Rights(
        "/",
        "bag_player",
        publish=(
            *(*_EVERY_NODE, "/clock", "/tf_static"),
            *(f"/{vehicle}/{sensor}" for vehicle in vehicles for sensor in _SENSORS),
        ),
        subscribe=tuple(f"/{vehicle}/odom" for vehicle in vehicles),
        reply=(*_PARAMETERS, "~/pause"),
    )


def policy_of(vehicles: Sequence[str]) -> str:
    """The policy as XML, with an enclave for each node."""
    policy = ET.Element("policy", version="0.2.0")
    enclaves = ET.SubElement(policy, "enclaves")
    for rights in rights_of(vehicles):
        enclave = ET.SubElement(enclaves, "enclave", path=rights.enclave)
        profiles = ET.SubElement(enclave, "profiles")
        profile = ET.SubElement(profiles, "profile", ns=rights.namespace, node=rights.node)
        for kind, act in (
            ("topic", "publish"),
            ("topic", "subscribe"),
            ("service", "reply"),
            ("service", "request"),
            ("action", "execute"),
        ):
            if names := getattr(rights, act):
                group = ET.SubElement(profile, f"{kind}s", {act: "ALLOW"})
                for name in names:
                    ET.SubElement(group, kind).text = name
    ET.indent(policy)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ET.tostring(policy, encoding="unicode")}\n'


def main(argv: Sequence[str] | None = None) -> int:
    """Print the policy for the vehicles that are named."""
    vehicles = sys.argv[1:] if argv is None else argv
    sys.stdout.write(policy_of(vehicles))
    return 0


if __name__ == "__main__":
    sys.exit(main())
