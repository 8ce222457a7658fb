"""A stretch of water that several acoustic modems share."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from uw_dslam_ros2.core.config import Config, setting

__all__ = ["CHANNEL_PRESETS", "ChannelConfig", "ChannelCounts", "SharedChannel"]

Position = tuple[float, float]


@dataclass(frozen=True, slots=True)
class ChannelConfig(Config):
    """What the water and the modems do to packets."""

    bit_rate: float = setting(1500.0, 1.0, 1e7, "bits a second while a modem sends")
    packet_bytes: int = setting(64, 32, 2048, "largest packet [bytes]")
    packets_per_turn: int = setting(1, 1, 100, "packets that a modem sends in one go")
    guard_s: float = setting(
        0.17, 0.0, 60.0, "silence after each turn [s]: as long as sound takes to the farthest"
    )
    loss: float = setting(0.0, 0.0, 0.99, "share of packets that one receiver does not get")
    sound_speed_m_s: float = setting(1500.0, 100.0, 1e4, "speed of sound [m/s]")
    range_m: float = setting(2000.0, 1.0, 1e6, "nobody is heard from farther away [m]")
    access: str = setting(
        "tdma",
        choices=("tdma", "aloha"),
        doc="tdma: modems take turns; aloha: each sends when it likes, and packets collide",
    )
    aloha_load: float = setting(
        0.4, 0.01, 1.0, "aloha: share of the time in which, on the whole, somebody sends"
    )
    seed: int = setting(0, 0, 2**31 - 1, "of losses and of aloha's waiting times")

    @property
    def turn_s(self) -> float:
        """Time of one turn with packets of full size [s]."""
        sent_bits = 8 * self.packet_bytes * self.packets_per_turn
        return sent_bits / self.bit_rate + self.guard_s


CHANNEL_PRESETS: Mapping[str, ChannelConfig] = {
    # Newcastle University's Nanomodem V3: 640 bit/s on the water, packets of at most 64 bytes, 463
    # bit/s with all pauses; range over 2 km (research.ncl.ac.uk/usmart, October 2018).
    "nano": ChannelConfig(bit_rate=640.0, packet_bytes=64, guard_s=0.306),
    # WHOI Micro-Modem, FSK rate 0: one frame of 32 bytes, 80 bit/s (acomms.whoi.edu/micro-modem;
    # Freitag et al., OCEANS 2005). The pause is for vehicles within 300 m.
    "rate0": ChannelConfig(bit_rate=80.0, packet_bytes=32, guard_s=0.2, range_m=3000.0),
    # The same modem, PSK rate 5: eight frames of 256 bytes in a burst of about 5000 bit/s, between
    # which the receivers take a while to decode.
    "psk5": ChannelConfig(
        bit_rate=5000.0, packet_bytes=256, packets_per_turn=8, guard_s=3.0, range_m=3000.0
    ),
}
"""Modems that are documented."""


@dataclass(slots=True)
class ChannelCounts:
    """What became of packets, counted at each receiver."""

    sent: int = 0
    delivered: int = 0
    lost: int = 0
    collided: int = 0
    out_of_range: int = 0
    blacked_out: int = 0


@dataclass(slots=True)
class _Arrival:
    begin_s: float
    end_s: float
    receiver: int
    data: bytes
    is_spoilt: bool = False


class SharedChannel:
    """Carries packets between modems; the caller has the time, which must not go back.

    Parameters
    ----------
    config
        Settings.
    modems
        Their numbers; in this order they take turns.
    blackouts
        Times (begin, end) [s] in which nothing arrives.
    """

    def __init__(
        self,
        config: ChannelConfig,
        modems: Sequence[int],
        blackouts: Sequence[tuple[float, float]] = (),
    ) -> None:
        self._config, self._modems, self._blackouts = config, tuple(modems), tuple(blackouts)
        self._rng = np.random.default_rng([config.seed, 15])
        self._order = itertools.count()
        self._coming: list[tuple[float, int, _Arrival]] = []
        self._sending: dict[int, list[tuple[float, float]]] = {modem: [] for modem in modems}
        self.counts = ChannelCounts()

    def next_turn(self, modem: int, after_s: float) -> float:
        """When a modem may send next, after a time [s]."""
        turn_s = self._config.turn_s
        if self._config.access == "tdma":
            cycle_s = turn_s * len(self._modems)
            first_s = turn_s * self._modems.index(modem)
            return first_s + cycle_s * float(np.floor((after_s - first_s) / cycle_s + 1.0 + 1e-9))
        mean_s = turn_s * len(self._modems) / self._config.aloha_load
        busy_s = max((end for _, end in self._sending[modem]), default=-1e9)
        return max(after_s, busy_s) + float(self._rng.exponential(mean_s - turn_s))

    def send(
        self, modem: int, packets: Sequence[bytes], now_s: float, where: Mapping[int, Position]
    ) -> float:
        """Send packets one after the other; returns when the last one has left [s].

        Parameters
        ----------
        modem
            Whose they are.
        packets
            At most ``packets_per_turn``.
        now_s
            Now.
        where
            Place [m] of each modem.
        """
        config, begin_s = self._config, now_s
        for data in packets:
            end_s = begin_s + 8 * len(data) / config.bit_rate
            self._sending[modem].append((begin_s, end_s))
            self.counts.sent += 1
            for receiver in self._modems:
                if receiver != modem:
                    self._carry(data, (begin_s, end_s), where[modem], where[receiver], receiver)
            begin_s = end_s
        self._sending[modem] = self._sending[modem][-4 * config.packets_per_turn :]
        return begin_s

    def _carry(
        self,
        data: bytes,
        span: tuple[float, float],
        source: Position,
        target: Position,
        receiver: int,
    ) -> None:
        config, counts = self._config, self.counts
        is_lost = self._rng.random() < config.loss
        away_m = float(np.hypot(source[0] - target[0], source[1] - target[1]))
        if away_m > config.range_m:
            counts.out_of_range += 1
            return
        late_s = away_m / config.sound_speed_m_s
        arrival = _Arrival(span[0] + late_s, span[1] + late_s, receiver, data)
        if any(begin < arrival.end_s and arrival.begin_s < end for begin, end in self._blackouts):
            counts.blacked_out += 1
            return
        # Two at a time spoil each other, also where one of them would have been lost anyway.
        for _, _, other in self._coming:
            overlaps = other.begin_s < arrival.end_s - 1e-9 and (
                arrival.begin_s < other.end_s - 1e-9
            )
            if other.receiver == receiver and overlaps:
                arrival.is_spoilt = other.is_spoilt = True
        if is_lost:
            counts.lost += 1
            arrival.data = b""
        heapq.heappush(self._coming, (arrival.end_s, next(self._order), arrival))

    def arrived(self, until_s: float) -> list[tuple[float, int, bytes]]:
        """Packets that have come by a time: when [s], to whom, and the bytes."""
        found = []
        while self._coming and self._coming[0][0] <= until_s:
            end_s, _, arrival = heapq.heappop(self._coming)
            is_deaf = any(  # who speaks hears nothing
                begin < arrival.end_s - 1e-9 and arrival.begin_s < end - 1e-9
                for begin, end in self._sending[arrival.receiver]
            )
            if not arrival.data:
                continue
            if arrival.is_spoilt or is_deaf:
                self.counts.collided += 1
                continue
            self.counts.delivered += 1
            found.append((end_s, arrival.receiver, arrival.data))
        return found
