"""Losses by the sequence numbers of the sender, and the choice of the sender."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from plow_twin.stream.senders import Senders

ONE, OTHER = b"one", b"other"


@given(st.sets(st.integers(1, 300), min_size=1))
def test_used_plus_lost_equals_sent_for_any_removed_messages(arrived: set[int]) -> None:
    senders = Senders()
    assert all(senders.count_arrival(ONE, number) for number in sorted(arrived))
    assert len(arrived) + senders.lost == max(arrived)


@given(st.permutations(range(1, 12)))
def test_a_message_that_arrives_late_is_no_loss(order: list[int]) -> None:
    senders = Senders()
    for number in order:
        senders.count_arrival(ONE, number)
    assert senders.lost == 0


def test_messages_from_before_the_subscription_are_no_loss() -> None:
    senders = Senders()
    senders.start([ONE])
    for number in (5000, 5001, 5004):
        senders.count_arrival(ONE, number)
    assert senders.lost == 2


def test_one_sender_is_followed_until_it_leaves_or_a_switch_is_requested() -> None:
    senders = Senders()
    assert not senders.switch()
    assert [senders.count_arrival(ONE, 1), senders.count_arrival(OTHER, 1), senders.count_arrival(ONE, 2)] == [
        True,
        False,
        True,
    ]
    # the list of publishers does not contain the sender yet, which does not mean that the sender has gone
    senders.alive([])
    assert senders.followed == ONE
    senders.alive([ONE, OTHER])
    assert senders.switch()
    assert [senders.count_arrival(ONE, 3), senders.count_arrival(OTHER, 2), senders.count_arrival(OTHER, 4)] == [
        False,
        True,
        True,
    ]
    assert (senders.lost, senders.ignored) == (1, 2)
    senders.alive([ONE, OTHER])
    senders.alive([ONE])
    assert senders.count_arrival(ONE, 4)
    assert senders.lost == 1 and senders.followed == ONE
