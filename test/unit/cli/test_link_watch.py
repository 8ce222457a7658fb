import pytest

from uw_dslam_ros2.cli.running.link_watch import what_is_open

VEHICLES = ["auv_1", "auv_2"]
LINK = {"items to send": "0", "items unconfirmed": "0", "items lacking": "0"}
MANAGER = {"is_settled": "1", "map_digest": "aa"}


def test_nothing_is_open_where_all_say_so():
    assert what_is_open(VEHICLES, [LINK, LINK], [MANAGER, MANAGER]) == []


@pytest.mark.parametrize(
    ("link", "manager", "sentence"),
    [
        ({"items to send": "3"}, {}, "the link of auv_2 has 3 items to send"),
        (
            {"items unconfirmed": "1"},
            {},
            "the link of auv_2 has 1 items that another vehicle has not confirmed",
        ),
        ({"items lacking": "2"}, {}, "the link of auv_2 has 2 items of others that have not come"),
        ({}, {"is_settled": "0"}, "the queue of auv_2 is still registering"),
        ({}, {"map_digest": "bb"}, "the vehicles' maps differ"),
    ],
)
def test_what_is_missing_is_named(link, manager, sentence):
    told = [LINK, LINK | link], [MANAGER, MANAGER | manager]
    assert what_is_open(VEHICLES, *told) == [sentence]


def test_who_has_told_nothing_yet_is_not_at_rest():
    found = what_is_open(VEHICLES, [LINK, {}], [MANAGER, {}])
    assert "the queue of auv_2 is still registering" in found
    assert "the link of auv_2 has ? items to send" in found
