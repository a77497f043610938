"""The ring keeps the newest, counts what a slow reader lost, and hands over no torn message."""

from __future__ import annotations

import multiprocessing
import os
import signal
import struct

import pytest

from membrane_ctrl.ipc.ring import RingAddress, RingReader, RingWriter, ring


def test_messages_arrive_in_order_and_once() -> None:
    with ring(8, 16) as address:
        writer, reader = RingWriter(address), RingReader(address)
        writer.put(b"one")
        writer.put(b"")
        assert reader.drain() == [b"one", b""]
        assert reader.drain() == []
        writer.put(b"exactly 16 bytes")
        assert reader.drain() == [b"exactly 16 bytes"]
        assert reader.dropped == 0
        writer.close()
        reader.close()


def test_a_slow_reader_loses_the_oldest_and_counts_them() -> None:
    with ring(4, 8) as address:
        writer, reader = RingWriter(address), RingReader(address)
        for number in range(11):
            writer.put(struct.pack("<q", number))
        assert [struct.unpack("<q", m)[0] for m in reader.drain()] == [7, 8, 9, 10]
        assert reader.dropped == 7
        writer.close()
        reader.close()


def test_readers_do_not_disturb_each_other() -> None:
    with ring(8, 8) as address:
        writer, first, second = RingWriter(address), RingReader(address), RingReader(address)
        writer.put(b"a")
        assert first.drain() == [b"a"]
        writer.put(b"b")
        assert first.drain() == [b"b"]
        assert second.drain(limit=1) == [b"a"]
        assert second.latest() == b"b"
        assert second.drain() == []
        for end in (writer, first, second):
            end.close()


def test_latest_of_an_empty_ring_is_none() -> None:
    with ring(2, 8) as address:
        reader = RingReader(address)
        assert reader.latest() is None
        reader.close()


def test_a_message_longer_than_a_slot_is_refused_and_leaves_the_ring_whole() -> None:
    with ring(2, 4) as address:
        writer, reader = RingWriter(address), RingReader(address)
        with pytest.raises(ValueError, match="5 bytes"):
            writer.put(b"12345")
        writer.put(b"1234")
        assert reader.drain() == [b"1234"]
        writer.close()
        reader.close()


def _write_for_ever(address: RingAddress, started: multiprocessing.synchronize.Event) -> None:
    writer, number = RingWriter(address), 0
    while True:
        number += 1
        writer.put(struct.pack("<q", number) * 512)
        started.set()


def test_no_torn_message_beside_a_racing_writer_and_its_last_words_survive_its_death() -> None:
    context = multiprocessing.get_context("spawn")
    with ring(4, 4096) as address:
        started = context.Event()
        process = context.Process(target=_write_for_ever, args=(address, started))
        process.start()
        assert started.wait(30)
        reader, taken = RingReader(address), 0
        while taken < 2000:
            for message in reader.drain(limit=4):
                values = set(struct.unpack("<512q", message))
                assert len(values) == 1
                taken += 1
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        process.join()
        assert len(reader.drain()) >= 1 or reader.latest() is not None
        reader.close()
