"""The ring keeps the newest, counts what a slow reader lost, and hands over no torn message."""

from __future__ import annotations

import multiprocessing
import os
import random
import signal
import struct
from dataclasses import replace
from mmap import mmap
from multiprocessing.shared_memory import SharedMemory

import pytest

from membrane_ctrl.processes.ring import RingAddress, RingError, RingReader, RingWriter, open_ring


def test_messages_arrive_in_order_and_once() -> None:
    with open_ring(8, 16) as address:
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
    with open_ring(4, 8) as address:
        writer, reader = RingWriter(address), RingReader(address)
        for number in range(11):
            writer.put(struct.pack("<q", number))
        assert [struct.unpack("<q", m)[0] for m in reader.drain()] == [7, 8, 9, 10]
        assert reader.dropped == 7
        writer.close()
        reader.close()


def test_readers_do_not_disturb_each_other() -> None:
    with open_ring(8, 8) as address:
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
    with open_ring(2, 8) as address:
        reader = RingReader(address)
        assert reader.latest() is None
        reader.close()


def test_a_message_longer_than_a_slot_is_refused_and_leaves_the_ring_whole() -> None:
    with open_ring(2, 4) as address:
        writer, reader = RingWriter(address), RingReader(address)
        with pytest.raises(ValueError, match="5 bytes"):
            writer.put(b"12345")
        writer.put(b"1234")
        assert reader.drain() == [b"1234"]
        writer.close()
        reader.close()


ROUNDS = 300_000


def _hammer(address: RingAddress, go: multiprocessing.synchronize.Event) -> None:
    writer = RingWriter(address)
    writer.put(struct.pack("<q", 1) * 4)
    go.wait()
    for number in range(2, ROUNDS + 1):
        writer.put(struct.pack("<q", number) * 4)
    writer.close()


def test_the_counter_never_goes_back_beside_a_racing_writer() -> None:
    context = multiprocessing.get_context("spawn")
    with open_ring(64, 32) as address:
        go = context.Event()
        process = context.Process(target=_hammer, args=(address, go))
        process.start()
        reader = RingReader(address)
        while reader.latest() is None:
            pass
        go.set()
        last = looks = 0
        while last < ROUNDS:
            counts = [reader._slots.written for _ in range(200)]
            assert counts == sorted(counts)
            assert counts[0] >= last
            message = reader.latest()
            assert message is not None, f"nothing there after message {last}"
            numbers = set(struct.unpack("<4q", message))
            assert len(numbers) == 1
            number = numbers.pop()
            assert number >= last
            last, looks = number, looks + 1
        process.join()
        assert looks > 100  # or the two never raced
        reader.close()


OLD, NEW = b"old one." * 2, b"newest!."


def _stores(address: RingAddress) -> tuple[bytes, list[tuple[int, bytes]]]:
    """The memory before the third message of a ring of two is put, and the stores of that put in
    their order.
    """
    memory = SharedMemory(address.name)
    writer = RingWriter(address)
    writer.put(OLD)
    writer.put(OLD)
    before = bytes(memory.buf)
    writer.put(NEW)
    after = bytes(memory.buf)
    writer.close()
    memory.close()
    words = range(0, len(before), 8)
    changed = [word for word in words if before[word : word + 8] != after[word : word + 8]]
    return before, [
        (word, after[word : word + 8]) for word in [*changed[1:], changed[0]]
    ]  # the counter is the last


@pytest.mark.parametrize("seen", range(32))
def test_whatever_part_of_a_put_is_visible_no_message_is_torn(seen: int) -> None:
    """ARM64 may show a reader any of a put's stores first; a writer may be killed after each."""
    with open_ring(2, 16) as address:
        before, stores = _stores(address)
        assert len(stores) == 5  # sequence, length and CRC, message, sequence, counter
        memory = SharedMemory(address.name)
        memory.buf[:] = before
        for bit, (place, value) in enumerate(stores):
            if seen >> bit & 1:
                memory.buf[place : place + 8] = value
        reader, newest = RingReader(address), RingReader(address)
        got = reader.drain()
        assert set(got) <= {OLD, NEW}
        assert (NEW in got) == (seen == 31)
        assert newest.latest() in ({NEW} if seen == 31 else {OLD, None})
        memory.buf[:] = before
        for place, value in stores:
            memory.buf[place : place + 8] = value
        assert [*got, *reader.drain()][-1] == NEW  # what was not visible at first is not lost
        for end in (reader, newest, memory):
            end.close()


def test_a_slot_that_is_never_complete_costs_one_message_and_blocks_no_reader() -> None:
    with open_ring(4, 8) as address:
        writer, reader = RingWriter(address), RingReader(address)
        memory = SharedMemory(address.name)
        writer.put(b"a")
        writer.put(b"b")
        memory.buf[64 + 16] ^= 1  # of message "a"
        assert reader.drain() == []
        assert reader.drain() == [b"b"]
        assert reader.dropped == 1
        memory.buf[64 + 32 + 16] ^= 1
        assert reader.latest() is None
        for end in (writer, reader, memory):
            end.close()


@pytest.mark.parametrize(
    "ring_address",
    [
        RingAddress("", 8, 16),
        RingAddress("", 4, 8),
        RingAddress("", 0, 16),
        RingAddress("", 2**40, 16),
    ],
)
def test_another_ring_than_the_named_one_is_refused(ring_address: RingAddress) -> None:
    with open_ring(4, 16) as address, pytest.raises(RingError):
        RingReader(replace(ring_address, name=address.name))


def test_a_reader_refuses_or_reads_whatever_the_memory_holds() -> None:
    """Random headers, counters and slots; half of the headers are true, so that what is behind them
    is read.
    """
    rng = random.Random(12)
    read = 0
    for _ in range(10_000):
        address = RingAddress("psm_00000000", _number(rng, 8), _number(rng, 64))
        memory = mmap(-1, 1024)
        memory[:] = rng.randbytes(1024)
        memory[:8] = struct.pack("<Q", _number(rng, 8) % 2**64)
        if rng.random() < 0.5:
            true = RingAddress("psm_00000000", rng.randint(1, 8), rng.randint(0, 64))
            address = true if rng.random() < 0.9 else address
            memory[8:32] = b"MBRring1" + struct.pack("<QQ", true.slots, true.slot_bytes)
        try:
            reader = RingReader(address, memory)
        except RingError:
            continue
        read += 1
        messages = [*reader.drain(), *reader.drain(), *filter(None, [reader.latest()])]
        assert len(messages) <= 2 * address.slots + 1
        assert all(len(message) <= address.slot_bytes for message in messages)
        reader.close()
    assert 3000 < read < 6000


def _number(rng: random.Random, usual: int) -> int:
    extremes = (0, -1, 1, 2**31, 2**32, 2**63 - 1, 2**63, 2**64 - 1, 2**64, -(2**63), 10**30)
    return rng.choice(extremes) if rng.random() < 0.3 else rng.randint(0, usual)


def _write_for_ever(address: RingAddress, started: multiprocessing.synchronize.Event) -> None:
    writer, number = RingWriter(address), 0
    while True:
        number += 1
        writer.put(struct.pack("<q", number) * 512)
        started.set()


def test_no_torn_message_beside_a_racing_writer_and_its_last_words_survive_its_death() -> None:
    context = multiprocessing.get_context("spawn")
    with open_ring(4, 4096) as address:
        started = context.Event()
        process = context.Process(target=_write_for_ever, args=(address, started))
        process.start()
        assert started.wait(30)
        reader, taken = RingReader(address), 0
        while taken < 500:
            for message in reader.drain(limit=4):
                values = set(struct.unpack("<512q", message))
                assert len(values) == 1
                taken += 1
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        process.join()
        assert len(reader.drain()) >= 1 or reader.latest() is not None
        reader.close()
