"""Vehicles repair what others have said, in turns that would be left empty."""

import pytest
from unit.link.talk import Talk
from unit.link.test_link import fleet, own_submap, same_everywhere

from uw_dslam_ros2.core.link import AcousticLink, LinkConfig
from uw_dslam_ros2.core.link.coding.items import PeerReport
from uw_dslam_ros2.core.link.transport.erasure import restore
from uw_dslam_ros2.core.link.transport.packets import Packet, framed, read_framed
from uw_dslam_ros2.core.link.transport.relay import FIRST_RELAYED, Relays

ITEM = bytes(range(150))  # three parts of 64 bytes
HELD, EPOCHS = {1: {0: b"hello", 1: ITEM}}, {1: 2}


def relayed(relays, peers=(3,), epochs=EPOCHS, loss=0.0):
    data = relays.next_packet(HELD, epochs, peers, loss, b"")
    return None if data is None else Packet.unpack(data, b"")


def all_relayed(relays, **how):
    found = []
    while (packet := relayed(relays, **how)) is not None:
        found.append(packet)
    return found


def test_what_somebody_lacks_is_sent_as_often_as_it_is_lacking():
    relays = Relays(2, 64)
    assert relayed(relays) is None, "nobody has said that something is lacking"
    relays.hear(1, 3, PeerReport(2, 1, (2,)))
    found = all_relayed(relays)
    assert [(p.sender, p.epoch, p.number, p.num_needed) for p in found] == [(1, 2, 1, 3)] * 2
    assert min(p.index for p in found) >= FIRST_RELAYED
    data = framed(1, ITEM)
    first = data[: -(-len(data) // 3)]
    whole = restore({0: first} | {p.index: p.payload for p in found}, 3)
    assert read_framed(whole) == (1, ITEM)


@pytest.mark.parametrize(("loss", "num"), [(0.0, 3), (0.3, 4)])
def test_of_what_has_not_come_at_all_everything_is_sent(loss, num):
    relays = Relays(2, 64)
    relays.hear(1, 3, PeerReport(2, 1))
    assert [p.number for p in all_relayed(relays, loss=loss)] == [1] * num


def test_what_others_send_meanwhile_is_not_sent_too():
    relays = Relays(2, 64)
    relays.overhear(1, 1)  # before the report, which says what came of it
    relays.hear(1, 3, PeerReport(2, 1, (2,)))
    relays.overhear(1, 1)
    assert len(all_relayed(relays)) == 1
    relays.hear(1, 3, PeerReport(2, 1, (1,)))
    assert len(all_relayed(relays)) == 1


def test_two_who_help_send_different_sums():
    indices = []
    for number in (2, 4):
        relays = Relays(number, 64)
        relays.hear(1, 3, PeerReport(2, 1))
        indices += [packet.index for packet in all_relayed(relays)]
    assert len(set(indices)) == 6


@pytest.mark.parametrize(
    ("report", "peers", "epochs"),
    [
        (PeerReport(2, 2), (3,), EPOCHS),  # has all
        (PeerReport(2, 1, (0,)), (3,), EPOCHS),
        (PeerReport(2, 1, (), True), (3,), EPOCHS),  # had no room to say it
        (PeerReport(2, 1), (), EPOCHS),  # has not been heard for long
        (PeerReport(2, 1), (3,), {1: 3}),  # what is here is of another epoch
    ],
)
def test_who_lacks_nothing_that_is_here_gets_nothing(report, peers, epochs):
    relays = Relays(2, 64)
    relays.hear(1, 3, report)
    assert relayed(relays, peers, epochs) is None


def test_who_is_out_of_range_gets_everything_by_way_of_others():
    talk = fleet(num=4, range_m=150.0)  # each hears its neighbours, a hundred metres away
    talk.until_all_know(8, 1500.0)
    assert same_everywhere(talk)
    assert talk.links[2].counts.sent_packets["relayed"] > 0
    assert talk.links[4].name_of(1) == "auv_1"
    assert talk.links[4].age_s(1, talk.now_s) is None, "itself it was never heard"
    assert all(not link.counts.refused for link in talk.links.values())


def test_what_a_vehicle_said_before_it_fell_silent_comes_to_all():
    talk = Talk(num=3)
    talk.where[3] = (5000.0, 0.0)
    talk.add(own_submap(1, 0))
    talk.run(60.0)
    assert len(talk.got[2]) == 1
    talk.where[3] = (300.0, 0.0)
    gone, _ = talk.links.pop(1), talk.got.pop(1)
    talk.until_all_know(1, 300.0)
    assert same_everywhere(talk)
    assert gone.name_of(3) is None


def test_without_loss_nothing_is_relayed():
    talk = fleet()
    for sequence in (2, 3):  # reports tell that these have not come, before they are sent
        talk.run(talk.now_s + 40.0)
        for number in talk.links:
            talk.add(own_submap(number, sequence))
    talk.until_all_know(12, 300.0)
    talk.run(talk.now_s + 100.0)
    assert all("relayed" not in link.counts.sent_packets for link in talk.links.values())
    assert sum(link.counts.duplicates for link in talk.links.values()) == 0


def test_repairs_by_others_neither_begin_an_epoch_nor_count_as_heard():
    link = AcousticLink(LinkConfig(number=3), "auv_3")
    sender = AcousticLink(LinkConfig(number=1), "auv_1", epoch=1)
    link.receive(sender.next_packet(0.0), 0.0)
    old, own = (
        Packet(epoch, number, 1, 3, FIRST_RELAYED, bytes(51)).pack(b"")
        for epoch, number in ((0, 1), (0, 3))
    )
    for data in (old, own):
        assert link.receive(data, 50.0) == []
    assert link.name_of(1) == "auv_1"
    assert link.to_state().received[1].epoch == 1
    assert link.age_s(1, 60.0) == 60.0
    assert not link.counts.refused
