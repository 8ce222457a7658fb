import pytest

from uw_dslam_ros2.core.errors import ConfigError
from uw_dslam_ros2.core.link.transport.channel import CHANNEL_PRESETS, ChannelConfig, SharedChannel

NEAR = {1: (0.0, 0.0), 2: (150.0, 0.0), 3: (0.0, 300.0)}


def test_a_packet_comes_when_it_was_sent_and_sound_has_travelled():
    channel = SharedChannel(ChannelConfig(bit_rate=800.0), (1, 2, 3))
    assert channel.send(1, [b"x" * 50], 10.0, NEAR) == pytest.approx(10.5)
    assert channel.arrived(10.5) == []
    found = channel.arrived(11.0)
    assert [(receiver, data) for _, receiver, data in found] == [(2, b"x" * 50), (3, b"x" * 50)]
    assert [at_s for at_s, _, _ in found] == pytest.approx([10.6, 10.7])


def test_two_at_a_time_spoil_each_other_only_where_they_meet():
    channel = SharedChannel(ChannelConfig(bit_rate=800.0), (1, 2, 3))
    channel.send(1, [b"a" * 50], 0.0, NEAR)
    channel.send(2, [b"b" * 50], 0.55, NEAR)
    found = {(receiver, data[:1]) for _, receiver, data in channel.arrived(5.0)}
    assert found == {(1, b"b"), (3, b"a"), (3, b"b")}  # 2 spoke before it had heard all of 1
    channel = SharedChannel(ChannelConfig(bit_rate=800.0), (1, 2, 3))
    channel.send(1, [b"a" * 50], 0.0, NEAR)
    channel.send(2, [b"b" * 50], 0.3, NEAR)
    assert channel.arrived(5.0) == []  # half duplex between the two, and a collision at 3
    assert channel.counts.collided == 4


def test_turns_are_one_after_the_other():
    config = ChannelConfig(bit_rate=512.0, packet_bytes=64, guard_s=0.5)
    channel = SharedChannel(config, (4, 7))
    assert config.turn_s == pytest.approx(1.5)
    turns = [channel.next_turn(4, 0.0), channel.next_turn(7, 0.0), channel.next_turn(7, 1.5)]
    assert turns == pytest.approx([3.0, 1.5, 4.5])


def test_losses_are_independent_and_as_many_as_told():
    channel = SharedChannel(ChannelConfig(loss=0.3, bit_rate=1e6), (1, 2, 3))
    for k in range(2000):
        channel.send(1, [b"x"], float(k), NEAR)
    found = channel.arrived(1e9)
    both = {(round(at_s), receiver) for at_s, receiver, _ in found}
    share = len(found) / 4000
    assert share == pytest.approx(0.7, abs=0.025)
    num_both = sum((k, 2) in both and (k, 3) in both for k in range(2000))
    assert num_both / 2000 == pytest.approx(0.49, abs=0.035)
    assert channel.counts.lost + channel.counts.delivered == 4000


def test_range_and_blackouts():
    channel = SharedChannel(ChannelConfig(range_m=200.0), (1, 2, 3), [(5.0, 6.0)])
    channel.send(1, [b"x"], 0.0, NEAR)
    channel.send(1, [b"y"], 5.5, NEAR)
    assert [(receiver, data) for _, receiver, data in channel.arrived(9.0)] == [(2, b"x")]
    assert (channel.counts.out_of_range, channel.counts.blacked_out) == (2, 1)


@pytest.mark.parametrize(
    ("name", "bits_per_s", "tolerance"), [("nano", 463.0, 2.0), ("rate0", 80.0, 5.0)]
)
def test_presets_have_the_rate_that_their_makers_state(name, bits_per_s, tolerance):
    config = CHANNEL_PRESETS[name]
    net = 8 * config.packet_bytes * config.packets_per_turn / config.turn_s
    assert net == pytest.approx(bits_per_s, abs=tolerance)


def test_a_loss_beyond_all_is_refused_by_name():
    with pytest.raises(ConfigError, match=r"ChannelConfig\.loss is 1\.5"):
        ChannelConfig(loss=1.5)
