"""What a vehicle says next, and how often."""

import pytest

from uw_dslam_ros2.core.link.coding.items import PeerReport
from uw_dslam_ros2.core.link.transport.outbox import Outbox

PEER = 2


def sent(outbox, peers=(PEER,), limit=100):
    """Numbers of the items of which fragments go out, until there is nothing left."""
    numbers = []
    while (item := outbox.next_item(peers)) is not None and len(numbers) < limit:
        outbox.cut(item, 64, 1, 0, b"")
        numbers.append(item.number)
    return numbers


def outbox_with_loss(received, num=20):
    """After one item of `num` fragments, of which so many have come; nothing of it is lacking."""
    outbox = Outbox()
    outbox.add(bytes(58 * num - 20), 0.0, "first")
    assert len(sent(outbox)) == num
    outbox.hear(PEER, PeerReport(0, 0, (num - received,)))
    outbox.hear(PEER, PeerReport(0, 1))
    return outbox


@pytest.mark.parametrize(("received", "expected"), [(20, 5), (14, 6)])
def test_an_item_goes_out_with_the_sums_that_a_listener_is_likely_to_need(received, expected):
    outbox = outbox_with_loss(received)
    outbox.add(bytes(58 * 5 - 20), 0.0, "second")
    assert sent(outbox) == [1] * expected


@pytest.mark.parametrize(("received", "expected"), [(20, 1), (14, 2)])
def test_a_turn_that_would_be_empty_carries_one_repair_more(received, expected):
    outbox = outbox_with_loss(received)
    item = outbox.add(bytes(58 * 5 - 20), 0.0, "second")
    sent(outbox)
    outbox.hear(PEER, PeerReport(0, 1, (1,)))
    before = outbox.loss
    assert (before > 0.1) == (received < 20)
    assert sent(outbox) == [item.number] * expected
    # Something that was not sent yet goes before the one more.
    outbox.hear(PEER, PeerReport(0, 1, (1,)))
    outbox.add(bytes(20), 5.0, "third")
    assert sent(outbox)[:2] == [1, 2]
