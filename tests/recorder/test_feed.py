"""Each message once, by one reader or the next: the feed across a recorder's death."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from membrane_ctrl.processes.ring import RingAddress, RingReader, RingWriter, open_ring
from membrane_ctrl.recorder.feed import Feed


@pytest.fixture
def address() -> Iterator[RingAddress]:
    with open_ring(8, 16) as found:
        yield found


def feed_of(address: RingAddress, position: int = 0, dropped: int = 0) -> Feed:
    return Feed(RingReader(address), position, dropped)


def put(writer: RingWriter, first: int, last: int) -> None:
    for number in range(first, last):
        writer.put(str(number).encode())


def test_a_second_reader_continues_where_the_first_stopped(address: RingAddress) -> None:
    writer = RingWriter(address)
    first = feed_of(address)
    put(writer, 0, 5)
    assert first.drain_messages() == [b"0", b"1", b"2", b"3", b"4"]
    put(writer, 5, 7)
    second = feed_of(address, first.position, first.dropped)
    assert second.drain_messages() == [b"5", b"6"]
    put(writer, 7, 9)
    assert second.drain_messages() == [b"7", b"8"]
    assert (second.position, second.dropped) == (9, 0)


def test_what_was_overwritten_between_two_readers_is_counted_and_what_was_recorded_is_not(
    address: RingAddress,
) -> None:
    writer = RingWriter(address)
    put(writer, 0, 20)
    second = feed_of(address, 5, 1)  # 5 recorded; 5..11 overwritten; 12..19 there
    assert second.drain_messages() == [str(number).encode() for number in range(12, 20)]
    assert second.dropped == 1 + 7
    put(writer, 20, 30)  # 20 and 21 are overwritten before it looks
    assert second.drain_messages() == [str(number).encode() for number in range(22, 30)]
    assert second.dropped == 1 + 7 + 2


def test_all_that_is_left_was_recorded_before(address: RingAddress) -> None:
    put(RingWriter(address), 0, 20)
    feed = feed_of(address, 20)
    assert feed.drain_messages() == []
    assert (feed.position, feed.dropped) == (20, 0)
