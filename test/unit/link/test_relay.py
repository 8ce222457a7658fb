"""Vehicles repair what others have said, in turns that would be left empty."""

import pytest
from unit.link.talk import Talk
from unit.link.test_link import fleet, own_submap, same_everywhere

from uw_dslam_ros2.core.link import AcousticLink, LinkConfig
from uw_dslam_ros2.core.link.coding.items import PeerReport
from uw_dslam_ros2.core.link.transport.erasure import restore
from uw_dslam_ros2.core.link.transport.packets import (
    FIRST_RELAYED,
    Packet,
    framed,
    read_framed,
)
from uw_dslam_ros2.core.link.transport.relay import Relays

ITEM = bytes(range(150))  # three parts of 64 bytes
HELD, LIVES = {1: {0: b"hello", 1: ITEM}}, {1: (2, 1234)}


def relayed(relays, peers=(3,), lives=LIVES, loss=0.0):
    data = relays.next_packet(HELD, lives, peers, loss, b"")
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
    assert {p.life for p in found} == {1234}
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
    ("report", "peers", "lives"),
    [
        (PeerReport(2, 2), (3,), LIVES),  # has all
        (PeerReport(2, 1, (0,)), (3,), LIVES),
        (PeerReport(2, 1, (), True), (3,), LIVES),  # had no room to say it
        (PeerReport(2, 1), (), LIVES),  # has not been heard for long
        (PeerReport(2, 1), (3,), {1: (3, 1234)}),  # what is here is of another epoch
        (PeerReport(2, 1), (3,), {}),  # of which is not known: no report has been heard
    ],
)
def test_who_lacks_nothing_that_is_here_gets_nothing(report, peers, lives):
    relays = Relays(2, 64)
    relays.hear(1, 3, report)
    assert relayed(relays, peers, lives) is None


def test_who_is_out_of_range_gets_everything_by_way_of_others():
    talk = fleet(num=4, range_m=150.0)  # each hears its neighbours, a hundred metres away
    talk.until_all_know(8, 1500.0)
    assert same_everywhere(talk)
    assert talk.links[2].counts.sent_packets["relayed"] > 0
    assert talk.links[4].name_of(1) == "auv_1"
    assert talk.links[4].age_s(1, talk.now_s) is None, "itself it was never heard"
    # But for the first one of a vehicle of which no report has come.
    assert all(set(link.counts.refused) <= {"a relayed packet"} for link in talk.links.values())
    assert all(sum(link.counts.refused.values()) <= 2 for link in talk.links.values())


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
    assert link.counts.refused == {"a relayed packet": 1}


def exchange(first, second, *, begin_s, num):
    """Each sends in turn, five seconds after the last."""
    for turn in range(num):
        now_s = begin_s + 5.0 * turn
        for sender, receiver in ((first, second), (second, first)):
            if (data := sender.next_packet(now_s)) is not None:
                receiver.receive(data, now_s)


@pytest.mark.parametrize("is_report_heard", [True, False])
def test_old_parts_of_a_link_that_began_anew_are_not_taken_for_new_ones(is_report_heard):
    """Of two lives packets tell two bits, which are alike here; who relays knows no better."""
    old, new, third = (
        AcousticLink(LinkConfig(number=number), f"auv_{number}", epoch=epoch)
        for number, epoch in ((1, 1), (1, 5), (3, 0))
    )
    link = AcousticLink(LinkConfig(number=2), "auv_2")
    for sequence in range(2):
        old.add_submap(own_submap(1, sequence))
    exchange(old, third, begin_s=0.0, num=60)
    if is_report_heard:
        exchange(new, link, begin_s=300.0, num=2)
    new.add_submap(own_submap(1, 7))
    exchange(link, third, begin_s=310.0, num=58)
    assert third.counts.sent_packets["relayed"] > 5
    assert bool(list(link.submaps())) != is_report_heard
    exchange(link, new, begin_s=600.0, num=60)
    assert 7 in {s.sequence for s in link.submaps() if s.vehicle_id == "auv_1"}
    assert link.is_complete
    assert new.num_unconfirmed(900.0) == 0
