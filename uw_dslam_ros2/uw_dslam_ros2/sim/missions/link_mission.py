"""Vehicles that tell each other of their submaps over a shared channel, without ROS."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from uw_dslam_ros2.core.link import AcousticLink, Layer, LinkConfig, LinkCounts
from uw_dslam_ros2.core.link.transport.channel import ChannelConfig, ChannelCounts, SharedChannel
from uw_dslam_ros2.core.submap import Submap, SubmapId

__all__ = ["LinkRun", "run_link"]

_SPACING_M = 60.0


@dataclass(slots=True)
class LinkRun:
    """What came of it; times in seconds from the mission's beginning."""

    end_s: float
    """Of the last submap's last ping."""
    known: dict[str, list[tuple[float, Submap]]] = field(default_factory=dict)
    """What each vehicle knew when: its own submaps and the others', as they cross the link."""
    counts: dict[str, LinkCounts] = field(default_factory=dict)
    channel: ChannelCounts = field(default_factory=ChannelCounts)

    def complete_s(self, wanted: Mapping[SubmapId, int]) -> float | None:
        """When everybody had these submaps in these revisions at least; None if never."""
        latest = 0.0
        for events in self.known.values():
            first: dict[SubmapId, float] = {}
            for at_s, submap in events:
                if submap.revision >= wanted.get(submap.submap_id, 1 << 62):
                    first.setdefault(submap.submap_id, at_s)
            if len(first) < len(wanted):
                return None
            latest = max(latest, *first.values())
        return latest


def run_link(
    submaps: Sequence[Submap],
    channel: ChannelConfig,
    *,
    limit_s: float,
    blackouts: Sequence[tuple[float, float]] = (),
    config: LinkConfig | None = None,
) -> LinkRun:
    """Let vehicles exchange their submaps, each from the time of its last ping on.

    Parameters
    ----------
    submaps
        Of all vehicles, in their newest revision.
    channel
        What lies between them; they are 60 m apart.
    limit_s
        After the last ping: when to stop, if not everything has come before.
    blackouts
        Times (begin, end) from the mission's beginning in which nothing arrives.
    config
        Of the links; the number and the packets' size are set here.
    """
    base = config or LinkConfig()
    names = sorted({submap.vehicle_id for submap in submaps})
    links: dict[int, AcousticLink] = {}
    for number, name in enumerate(names, start=1):
        changes = {"number": number, "packet_bytes": channel.packet_bytes}
        links[number] = AcousticLink(LinkConfig.from_dict(base.to_dict() | changes), name)
    where = {number: (_SPACING_M * number, 0.0) for number in links}
    water = SharedChannel(channel, list(links), blackouts)
    begin_ns = min(int(s.trajectory_stamp_ns[0]) for s in submaps)
    pending = sorted(((s.stamp_ns - begin_ns) * 1e-9, s.submap_id, s) for s in submaps)
    run = LinkRun(pending[-1][0], {name: [] for name in names})
    wanted = {s.submap_id: 4 * s.revision + Layer.FINE for s in submaps}
    turns = {number: water.next_turn(number, 0.0) for number in links}

    def note(number: int, at_s: float, found: Sequence[Submap]) -> None:
        run.known[names[number - 1]] += [(at_s, submap) for submap in found]

    while (now_s := min(turns.values())) < run.end_s + limit_s:
        number = min(turns, key=lambda n: (turns[n], n))
        while pending and pending[0][0] <= now_s:
            closed_s, _, submap = pending.pop(0)
            owner = names.index(submap.vehicle_id) + 1
            note(owner, closed_s, links[owner].add_submap(submap))
        for at_s, receiver, data in water.arrived(now_s):
            note(receiver, at_s, links[receiver].receive(data, at_s))
        packets: list[bytes] = []
        while len(packets) < channel.packets_per_turn:
            packet = links[number].next_packet(now_s)
            if packet is None:
                break
            packets.append(packet)
        water.send(number, packets, now_s, where)
        turns[number] = water.next_turn(number, now_s)
        if not pending and not packets and run.complete_s(wanted) is not None:
            break
    run.counts = {names[number - 1]: link.counts for number, link in links.items()}
    run.channel = water.counts
    return run
