"""Links that talk over a simulated channel, for tests."""

from uw_dslam_ros2.core.link import AcousticLink, Layer, LinkConfig
from uw_dslam_ros2.core.link.transport.channel import ChannelConfig, SharedChannel


class Talk:
    """Vehicles 1, 2, ... a hundred metres apart; `run` lets time pass.

    `clocks` says by how much some are ahead [s].
    """

    def __init__(self, num=3, packet_bytes=64, blackouts=(), clocks=None, **channel):
        config = ChannelConfig(packet_bytes=packet_bytes, **channel)
        self.channel = SharedChannel(config, range(1, num + 1), blackouts)
        self.links = {
            n: AcousticLink(LinkConfig(number=n, packet_bytes=packet_bytes), f"auv_{n}")
            for n in range(1, num + 1)
        }
        self.where = {n: (100.0 * n, 0.0) for n in self.links}
        self.clocks = dict.fromkeys(self.links, 0.0) | (clocks or {})
        self.now_s = 0.0
        self.got = {n: {} for n in self.links}
        self.packets = []

    def add(self, submap):
        number = int(submap.vehicle_id.removeprefix("auv_"))
        self._note(number, self.links[number].add_submap(submap))

    def _note(self, number, submaps):
        for submap in submaps:
            self.got[number][submap.submap_id] = submap

    def _hear(self, number, data, at_s):
        return self.links[number].receive(data, at_s + self.clocks[number])

    def run(self, until_s):
        turns = {n: self.channel.next_turn(n, self.now_s) for n in self.links}
        while (now_s := min(turns.values())) < until_s:
            number = min(turns, key=lambda n: (turns[n], n))
            for at_s, receiver, data in self.channel.arrived(now_s):
                if receiver in self.links:
                    self._note(receiver, self._hear(receiver, data, at_s))
            packet = self.links[number].next_packet(now_s + self.clocks[number])
            if packet is not None:
                self.packets.append((now_s, number, packet))
                self.channel.send(number, [packet], now_s, self.where)
            turns[number] = self.channel.next_turn(number, now_s)
        self.now_s = until_s

    def until_all_know(self, num_submaps, limit_s):
        """Run until everybody has so many submaps; when that was [s]."""
        while not self.all_know(num_submaps):
            assert self.now_s < limit_s, {n: len(got) for n, got in self.got.items()}
            self.run(self.now_s + 5.0)
        return self.now_s

    def all_know(self, num_submaps):
        """Whether everybody has so many submaps, in all layers."""
        return all(
            len(got) == num_submaps and all(s.revision % 4 >= Layer.FINE for s in got.values())
            for got in self.got.values()
        )
