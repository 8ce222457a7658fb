"""Several links over a channel that loses packets."""

import dataclasses

import numpy as np
import places
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from unit.link.talk import Talk

from uw_dslam_ros2.core.errors import InvalidInputError
from uw_dslam_ros2.core.grid import OccupancyMap
from uw_dslam_ros2.core.link import AcousticLink, Layer, LinkConfig
from uw_dslam_ros2.core.link.coding.answers import encode_answer
from uw_dslam_ros2.core.link.coding.fields import digest_of
from uw_dslam_ros2.core.link.coding.items import ItemKind, read_item, read_layer
from uw_dslam_ros2.core.link.coding.moves import Move
from uw_dslam_ros2.core.link.held import HeldSubmaps
from uw_dslam_ros2.core.link.transport.packets import OVERHEAD_BYTES
from uw_dslam_ros2.core.se2 import SE2
from uw_dslam_ros2.sim.maps.fleets import make_result


def own_submap(number, sequence, revision=0, run_id=77, seed=None):
    whole = places.room_submap(
        f"auv_{number}", sequence, revision, T_odom_submap=SE2(3.0 * sequence, number, 0.1)
    )
    values = np.array(whole.grid.values)
    rng = np.random.default_rng([number, sequence] if seed is None else seed)
    for row, col in rng.integers(10, 80, (12, 2)):
        values[row : row + 4, col : col + 4] = 100
    return dataclasses.replace(whole, grid=OccupancyMap(whole.grid.spec, values), run_id=run_id)


def content(submap):
    return (
        submap.submap_id, submap.revision, submap.T_odom_submap, submap.grid.spec,
        submap.grid.values.tobytes(), submap.trajectory.tobytes(), submap.covariance.tobytes(),
    )  # fmt: skip


def same_everywhere(talk):
    everything = [
        {key: content(submap) for key, submap in sorted(got.items())} for got in talk.got.values()
    ]
    return all(one == everything[0] for one in everything)


def fleet(num_submaps=2, **options):
    talk = Talk(**options)
    for number in talk.links:
        for sequence in range(num_submaps):
            talk.add(own_submap(number, sequence))
    return talk


@pytest.mark.parametrize("packet_bytes", [32, 64, 256, 2048])
def test_everybody_gets_everything(packet_bytes):
    talk = fleet(packet_bytes=packet_bytes)
    talk.until_all_know(6, 400.0)
    assert same_everywhere(talk)
    assert talk.links[2].name_of(3) == "auv_3"


def test_without_loss_nothing_is_sent_twice():
    talk = fleet()
    talk.until_all_know(6, 100.0)
    talk.run(talk.now_s + 300.0)
    for link in talk.links.values():
        assert link.counts.duplicates == 0
        assert link.counts.repairs == 0
        assert link.num_open(talk.now_s) == 0


def test_who_has_nothing_to_say_is_nearly_silent():
    talk = fleet()
    talk.until_all_know(6, 100.0)
    talk.run(talk.now_s + 30.0)
    before = len(talk.packets)
    talk.run(talk.now_s + 600.0)
    assert len(talk.packets) - before <= 3 * 11  # a sign of life each minute


@pytest.mark.parametrize("seed", range(4))
def test_losses_are_repaired_and_cost_little_more_than_they_must(seed):
    talk = fleet(loss=0.3, seed=seed)
    talk.until_all_know(6, 400.0)
    assert same_everywhere(talk)
    talk.run(talk.now_s + 200.0)
    assert all(link.num_open(talk.now_s) == 0 for link in talk.links.values())
    parts = [item.parts for link in talk.links.values() for item in link._outbox.items]
    sent = [item.num_sent for link in talk.links.values() for item in link._outbox.items]
    # Until two receivers who miss 30 % each have all of one fragment takes 1.76 on average.
    assert sum(sent) < 2.2 * sum(parts)


def test_clocks_that_disagree_change_no_packet_and_no_submap():
    talks = []
    for clocks in (None, {1: 5.0, 3: -4000.0}):
        talk = Talk(clocks=clocks, loss=0.3)
        for number in talk.links:
            for sequence in range(2):
                submap, shift_ns = own_submap(number, sequence), int(1e9 * talk.clocks[number])
                stamps_ns = submap.trajectory_stamp_ns + shift_ns + 5000 * 10**9
                talk.add(
                    dataclasses.replace(
                        submap, stamp_ns=int(stamps_ns[-1]), trajectory_stamp_ns=stamps_ns
                    )
                )
        talk.until_all_know(6, 400.0)
        assert same_everywhere(talk)
        talks.append(talk)
    first, second = (
        [(now_s, number, len(data)) for now_s, number, data in talk.packets] for talk in talks
    )
    assert first == second
    assert {content(s) for s in talks[0].got[2].values()} == {
        content(s) for s in talks[1].got[2].values()
    }


def test_aloha_collides_and_arrives_all_the_same():
    talk = fleet(access="aloha")
    talk.until_all_know(6, 900.0)
    assert talk.channel.counts.collided > 0
    assert same_everywhere(talk)


def test_a_blackout_of_half_the_time_changes_nothing_in_the_end():
    talk = Talk(blackouts=[(20.0, 120.0)], loss=0.2)
    for sequence in range(4):
        for number in talk.links:
            talk.add(own_submap(number, sequence))
        talk.run(talk.now_s + 40.0)
    talk.until_all_know(12, 900.0)
    assert same_everywhere(talk)


def test_a_latecomer_gets_all():
    talk = fleet(num=3)
    late, got = talk.links.pop(3), talk.got.pop(3)
    talk.until_all_know(4, 200.0)
    talk.run(600.0)
    talk.links[3], talk.got[3] = late, got
    talk.until_all_know(6, 1200.0)
    assert same_everywhere(talk)


def test_a_pose_that_moves_goes_out_without_its_cells():
    talk = fleet()
    talk.until_all_know(6, 100.0)
    before = talk.links[1].counts.sent_bytes["coarse"]
    moved = dataclasses.replace(own_submap(1, 0, revision=5), T_odom_submap=SE2(1.0, 2.0, 3.0))
    talk.add(moved)
    talk.run(talk.now_s + 30.0)
    assert talk.got[2][moved.submap_id].T_odom_submap.y == pytest.approx(2.0)
    assert talk.links[1].counts.sent_bytes["coarse"] == before


def test_a_pose_can_move_without_the_grid_at_hand():
    talk = Talk(num=2)
    talk.add(own_submap(1, 0))
    talk.run(20.0)
    state = talk.links[1].to_state()
    link = talk.links[1] = AcousticLink.from_state(LinkConfig(number=1), "auv_1", state)
    held = link.own_submap(own_submap(1, 0).submap_id)
    moved = dataclasses.replace(held, revision=7, T_odom_submap=SE2(9.0, 8.0, 0.7))
    talk._note(1, link.move_submap(moved))
    talk.run(60.0)
    assert content(talk.got[2][moved.submap_id]) == content(talk.got[1][moved.submap_id])
    assert talk.got[2][moved.submap_id].T_odom_submap.x == pytest.approx(9.0)
    with pytest.raises(InvalidInputError, match="moves before it has come"):
        link.move_submap(own_submap(1, 5))


def test_a_move_of_what_all_have_takes_little_and_outlives_restarts_and_losses():
    talk = fleet(loss=0.3)
    talk.until_all_know(6, 300.0)
    talk.run(talk.now_s + 100.0)  # all is confirmed
    for x_m in (1.0, 2.0):
        for sequence in range(2):
            moved = dataclasses.replace(
                own_submap(1, sequence, revision=int(x_m)), T_odom_submap=SE2(x_m, 2.0, 3.0)
            )
            talk._note(1, talk.links[1].move_submap(moved))
        talk.run(talk.now_s + 3.0)
    for number in (1, 2):
        state = talk.links[number].to_state()
        talk.links[number] = AcousticLink.from_state(
            LinkConfig(number=number), f"auv_{number}", state
        )
    talk.run(talk.now_s + 300.0)
    assert same_everywhere(talk)
    assert {s.T_odom_submap.x for s in talk.got[3].values() if s.vehicle_id == "auv_1"} == {2.0}
    items = [item for item in talk.links[1]._outbox.items if item.label == "moved"]
    assert all(len(item.content) <= 24 for item in items)
    assert sum(not item.is_void for item in items) == 2


def test_a_move_waits_for_the_outline_that_it_moves():
    """Cells were drawn anew, and the move of the new ones comes before these."""
    first, second = Talk(num=2), own_submap(1, 0, revision=1, seed=5)
    link, other = first.links[1], first.links[2]
    first.add(own_submap(1, 0))
    first.until_all_know(1, 100.0)
    first.run(200.0)
    first.add(second)
    first.until_all_know(1, 300.0)
    moved = dataclasses.replace(second, revision=2, T_odom_submap=SE2(1.0, 2.0, 3.0))
    first.run(400.0)
    link.move_submap(moved)
    item = next(item for item in link._outbox.items if item.label == "moved")
    held = HeldSubmaps(2, "auv_2", b"")
    layers = [i.content for i in link._outbox.items if i.label in ("outline", "coarse", "fine")]
    for content_bytes in [*layers[:3], item.content, *layers[3:]]:
        kind, body = read_item(content_bytes)
        if kind is ItemKind.MOVED:
            held.take_move(1, Move.read(body))
            assert held.submaps[1, 77, 0].outline.revision == 0
        else:
            held.take_layer(1, *read_layer(body))
    assert held.submaps[1, 77, 0].outline.revision == 2
    first.run(500.0)
    outline = other.outlines()[1, 77, 0].outline
    assert outline.T_odom_submap.y == held.submaps[1, 77, 0].outline.T_odom_submap.y == 2.0


def test_what_was_overtaken_need_not_arrive():
    """Outlines that were lost and replaced are not sent again."""
    talk = Talk(num=2, blackouts=[(0.0, 30.0)])
    for revision in range(5):
        talk.add(own_submap(1, 0, revision=revision))
        talk.run(talk.now_s + 6.0)
    talk.until_all_know(1, 300.0)
    talk.run(talk.now_s + 200.0)
    assert talk.got[2][own_submap(1, 0).submap_id].revision == 4 * 4 + Layer.FINE
    assert talk.links[2].is_complete
    assert talk.links[1].num_open(talk.now_s) == 0


def test_a_restarted_link_has_lost_nothing_and_sends_nothing_again():
    talk = fleet()
    talk.run(6.0)  # some have come
    for number in (1, 2, 3):
        old = talk.links[number]
        new = AcousticLink.from_state(LinkConfig(number=number), f"auv_{number}", old.to_state())
        assert [content(s) for s in new.submaps()] == [content(s) for s in old.submaps()]
        talk.links[number] = new
    talk.until_all_know(6, 200.0)
    assert same_everywhere(talk)
    assert sum(link.counts.repairs for link in talk.links.values()) <= 6


def test_a_restarted_link_has_parts_of_what_was_coming():
    talk = Talk(num=2)
    talk.add(own_submap(1, 0))
    while not talk.links[2].to_state().received.get(1) or not (
        parts := talk.links[2].to_state().received[1].fragments
    ):
        talk.run(talk.now_s + 0.5)
    new = AcousticLink.from_state(LinkConfig(number=2), "auv_2", talk.links[2].to_state())
    assert new.to_state().received[1].fragments == parts
    talk.links[2] = new
    talk.until_all_know(1, 100.0)
    assert talk.links[1].counts.repairs == 0
    assert new.counts.duplicates == 0


@pytest.mark.parametrize("epoch", [1, 4])
def test_a_link_that_forgot_everything_begins_a_new_epoch(epoch):
    """Of the epoch, packets tell only two bits: those of 4 are as before."""
    talk = fleet()
    talk.until_all_know(6, 200.0)
    talk.links[1] = AcousticLink(LinkConfig(number=1), "auv_1", epoch=epoch)
    talk.got[1] = {}
    talk.add(own_submap(1, 2))
    talk.run(400.0)
    assert len(talk.got[1]) == 5  # its own new one and the four of the others
    assert len(talk.got[2]) == 7


def test_two_runs_of_a_vehicle_are_two():
    talk = Talk(num=2)
    talk.add(own_submap(1, 0, run_id=70_001, seed=1))
    talk.add(own_submap(1, 0, run_id=5, seed=2))
    talk.run(60.0)
    assert {i.run_id for i in talk.got[2]} == {70_001, 5}


# --- what is not as it should be ---------------------------------------------------------------


@given(st.randoms(use_true_random=False))
@settings(max_examples=25)
def test_damage_is_counted_and_never_makes_a_wrong_submap(chance):
    talk = fleet(num_submaps=1, num=2)
    talk.until_all_know(2, 100.0)
    wanted = content(talk.got[1][own_submap(1, 0).submap_id])
    packets = [data for _, number, data in talk.packets if number == 1]
    link = AcousticLink(LinkConfig(number=2), "auv_2")
    found, num_damaged = [], 0
    for data in packets:
        damaged = bytearray(data)
        way = chance.randrange(4)
        if way == 0:
            damaged[chance.randrange(len(damaged))] ^= 1 << chance.randrange(8)
        elif way == 1:
            del damaged[chance.randrange(len(damaged)) :]
        elif way == 2:
            damaged += bytes(chance.randrange(1, 9))
        num_damaged += way != 3
        for one in (bytes(damaged), data, data):
            found += link.receive(one, 1.0)
    clean = AcousticLink(LinkConfig(number=2), "auv_2")
    honest = [content(submap) for data in packets for submap in clean.receive(data, 1.0)]
    assert [content(submap) for submap in found] == honest
    assert honest[-1] == wanted
    # One in 65536 passes the packet's checksum; the item's own has to catch that.
    assert sum(link.counts.refused.values()) >= num_damaged - 1
    assert link.counts.duplicates > 0


@given(st.binary(max_size=100))
def test_noise_is_counted(data):
    link = AcousticLink(LinkConfig(), "auv_1")
    assert link.receive(data, 0.0) == []
    assert sum(link.counts.refused.values()) == 1


def test_packets_with_a_sound_checksum_and_any_content_harm_nothing(rng):
    from uw_dslam_ros2.core.link.transport.packets import Packet

    link = AcousticLink(LinkConfig(number=1), "auv_1")
    for _ in range(2000):
        fields = [int(rng.integers(0, n)) for n in (4, 32, 1024, 64, 128)]
        payload = rng.bytes(int(rng.integers(1, 58)))
        assert link.receive(Packet(*fields, payload).pack(b""), 0.0) == []
    assert list(link.submaps()) == []
    assert link.counts.refused


def test_packets_of_another_version_are_refused():
    link = AcousticLink(LinkConfig(number=1), "auv_1")
    data = AcousticLink(LinkConfig(number=2), "auv_2").next_packet(0.0)
    content = bytes([data[0] ^ 0x40]) + data[1:-2]
    assert link.receive(content + digest_of(content, b"", 2), 0.0) == []
    assert link.counts.refused == {"version of the": 1}
    assert link.age_s(2, 0.0) is None


def test_who_lacks_the_key_is_not_heard():
    ours = AcousticLink(LinkConfig(number=1, key="secret"), "auv_1")
    stranger = AcousticLink(LinkConfig(number=2), "auv_2")
    ours.receive(stranger.next_packet(0.0), 0.0)
    assert ours.name_of(2) is None
    assert sum(ours.counts.refused.values()) == 1


def test_a_second_vehicle_of_one_name_is_not_believed():
    link = AcousticLink(LinkConfig(number=1), "auv_1")
    for number in (2, 3):
        other = AcousticLink(LinkConfig(number=number), "auv_2")
        link.receive(other.next_packet(0.0), 0.0)
    assert (link.name_of(2), link.name_of(3)) == ("auv_2", None)
    assert sum(link.counts.refused.values()) == 1


def test_a_submap_of_another_vehicle_is_refused_by_name():
    link = AcousticLink(LinkConfig(number=1), "auv_1")
    with pytest.raises(InvalidInputError, match=r"'auv_2' on the link of 'auv_1'"):
        link.add_submap(own_submap(2, 0))


def test_packets_keep_to_the_size_and_six_bytes_are_overhead():
    assert OVERHEAD_BYTES <= 6
    talk = fleet(packet_bytes=48, loss=0.3)
    talk.until_all_know(6, 500.0)
    assert max(len(data) for _, _, data in talk.packets) <= 48


def test_many_vehicles_fit_their_reports_into_small_packets():
    talk = Talk(num=12, packet_bytes=32, bit_rate=5000.0, guard_s=0.8)
    for number in talk.links:
        talk.add(own_submap(number, 0))
    talk.until_all_know(12, 900.0)
    assert max(len(data) for _, _, data in talk.packets) <= 32


def test_decisions_come_to_all_before_anything_else_and_once():
    talk = fleet(num_submaps=1, num=3, loss=0.3)
    talk.links[1].add_decision(b"forbid")
    talk.run(20.0)
    talk.links[1].add_decision(b"forbid")  # a manager that begins again says it again
    talk.until_all_know(3, 400.0)
    talk.run(talk.now_s + 60.0)
    assert [talk.links[n].take_decisions() for n in (1, 2, 3)] == [[], [b"forbid"], [b"forbid"]]
    assert talk.links[2].take_decisions() == []
    again = AcousticLink.from_state(LinkConfig(number=2), "auv_2", talk.links[2].to_state())
    assert again.take_decisions() == [b"forbid"]
    again.add_decision(b"forbid")  # so does the manager that heard it
    assert again.num_open(talk.now_s) == 0


@pytest.mark.parametrize("decision", [b"", bytes(1001)])
def test_decisions_without_bounds_are_refused(decision):
    with pytest.raises(InvalidInputError, match="expected 1 to 1000"):
        AcousticLink(LinkConfig(number=1), "auv_1").add_decision(decision)


def some_answer(x_m):
    return encode_answer(bytes(6), make_result(SE2(x_m, 0.0, 0.0)))


def test_an_answer_that_somebody_has_told_is_not_told_again():
    talk = Talk(num=3)
    talk.run(60.0)
    for link in talk.links.values():
        link.add_answer(some_answer(1.0))
    talk.run(300.0)
    heard = [link.take_answers() for link in talk.links.values()]
    assert sorted(map(len, heard)) == [0, 1, 1], "one has told it, and once"
    assert not any(link.num_open(talk.now_s) for link in talk.links.values())
    for link in talk.links.values():
        link.add_answer(some_answer(1.0))
    talk.run(600.0)
    assert not any(link.take_answers() for link in talk.links.values())


def test_the_first_vehicle_tells_its_answers_before_walls_and_the_others_after():
    talk = Talk(num=2)
    talk.run(60.0)
    order = {}
    for number, link in talk.links.items():
        talk.add(own_submap(number, 0))
        link.add_answer(some_answer(number))
        order[number] = [
            item.label for item in sorted(link._outbox.items, key=lambda item: item.rank)
        ]
    assert order[1] == ["hello", "outline", "coarse", "answers", "fine"]
    assert order[2] == ["hello", "outline", "coarse", "fine", "answers"]
