"""A ring of messages in shared memory: one writer that never waits, any number of readers.

The writer overwrites the oldest slot; a reader that was too slow counts the gap in the sequence
numbers. A killed writer's messages stay readable.

Counter and sequence numbers are 8-byte aligned and written through a memoryview of 8-byte words,
which makes one store of each assignment. (`struct.pack_into` clears the bytes first, and a racing
reader sees the counter as 0.) Each slot carries its sequence number before and after the message. A
reader takes a message only if both are as
expected: it reads the last before copying and the first afterwards. On x86-64 that suffices,
because stores become visible in order. On ARM64 they may not, so each slot also has a CRC-32 of its
message, seeded with its number: an incomplete message does not match, and the reader retries at its
next call.
"""

import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from mmap import mmap
from multiprocessing.shared_memory import SharedMemory

_MAGIC = int.from_bytes(b"MBRring1", "little")
_WRITTEN, _IS_RING, _SLOTS, _SLOT_BYTES = range(4)  # words of the header
_HEADER_BYTES = 64  # a cache line of its own for the write counter
_SLOT_OVERHEAD = 3 * 8  # sequence; length and CRC-32; sequence again
# The largest ring of a run, a minute of inputs at 1 kHz, is 32 MB
_RING_BYTES_MAX = 1 << 27
# A writer that overtakes costs a few tries; a newest slot that never matches is damaged and must
# end `latest`
_TRIES = 100


class RingError(ValueError):
    """The memory is not a ring, or not the one that the address describes."""


@dataclass(frozen=True, slots=True)
class RingAddress:
    """What another process needs to read a ring (or become its only writer)."""

    name: str
    slots: int
    slot_bytes: int

    @property
    def size_bytes(self) -> int:
        """Size of the shared memory. Raises RingError for impossible dimensions."""
        size_bytes = _HEADER_BYTES + self.slots * _slot_stride(self.slot_bytes)
        if self.slots < 1 or self.slot_bytes < 0 or size_bytes > _RING_BYTES_MAX:
            raise RingError(f"a ring cannot have {self.slots} slots of {self.slot_bytes} bytes")
        return size_bytes


class Ring:
    """Owns the shared memory of `slots` messages of at most `slot_bytes`; create it in the
    longest-lived process.
    """

    def __init__(self, slots: int, slot_bytes: int) -> None:
        size_bytes = RingAddress("", slots, slot_bytes).size_bytes
        self._memory = SharedMemory(create=True, size=size_bytes)
        self.address = RingAddress(self._memory.name, slots, slot_bytes)
        assert self._memory.buf is not None  # None only after close()
        with self._memory.buf[:_HEADER_BYTES].cast("Q") as words:
            words[_IS_RING] = _MAGIC
            words[_SLOTS] = slots
            words[_SLOT_BYTES] = slot_bytes

    def close(self) -> None:
        """Free the memory; attached readers keep theirs."""
        self._memory.close()
        self._memory.unlink()


class _Slots:
    """The layout, after checking the memory against its address. Raises RingError."""

    def __init__(self, memory: SharedMemory | mmap, address: RingAddress) -> None:
        whole = memoryview(memory) if isinstance(memory, mmap) else memory.buf
        assert whole is not None  # None only after close()
        self._memory = memory
        self._views = [whole]
        size_bytes = address.size_bytes
        if whole.nbytes < size_bytes:
            raise RingError(
                f"{address.name}: {whole.nbytes} bytes where a ring of {size_bytes} is expected"
            )
        self.bytes = whole[:size_bytes]
        self.words = self.bytes.cast("Q")
        self._views[:0] = self.words, self.bytes
        self.count = address.slots
        self._stride = _slot_stride(address.slot_bytes)
        head = [self.words[word] for word in (_IS_RING, _SLOTS, _SLOT_BYTES)]
        if head != [_MAGIC, address.slots, address.slot_bytes]:
            raise RingError(f"{address.name}: not the expected ring of {address.slots} slots")

    @property
    def written(self) -> int:
        """Number of messages put so far."""
        return self.words[_WRITTEN]

    def span(self, index: int) -> tuple[int, int]:
        """First and last word of a message's slot."""
        start = _HEADER_BYTES + (index % self.count) * self._stride
        return start // 8, (start + self._stride) // 8 - 1

    def close(self) -> None:
        """Detach: memory cannot be closed while viewed."""
        for view in self._views:
            view.release()
        self._memory.close()

    __del__ = close  # before the memory's own end, which would complain about the views


class RingWriter:
    """The only writer of a ring. Raises RingError if it is not a ring."""

    def __init__(self, address: RingAddress) -> None:
        self._slots = _Slots(SharedMemory(address.name), address)
        self._next = self._slots.written
        self.slot_bytes = address.slot_bytes

    def put(self, message: bytes) -> None:
        """Write one message over the oldest. Raises ValueError if it is longer than a slot."""
        length = len(message)
        if length > self.slot_bytes:
            raise ValueError(f"message of {length} bytes in a ring of {self.slot_bytes}-byte slots")
        # The order matters: the first number claims the slot, the last one and the counter release
        # it. A reader that finds two different numbers has met a slot that is being written
        words = self._slots.words
        first, last = self._slots.span(self._next)
        sequence = self._next + 1
        words[first] = sequence
        words[first + 1] = _compute_seal(message, sequence)
        self._slots.bytes[8 * first + 16 : 8 * first + 16 + length] = message
        words[last] = sequence
        self._next = sequence
        words[_WRITTEN] = sequence

    def close(self) -> None:
        """Detach."""
        self._slots.close()


class RingReader:
    """One reader; it starts at the oldest message in the ring, and counts lost messages in
    `dropped`.

    `memory` is the ring's, if the caller has already mapped it. Raises RingError.
    """

    def __init__(self, address: RingAddress, memory: mmap | None = None) -> None:
        self._slots = _Slots(SharedMemory(address.name) if memory is None else memory, address)
        self._slot_bytes = address.slot_bytes
        self._read = 0
        self._looked_at = -1
        self.dropped = 0

    def drain(self, limit: int | None = None) -> list[bytes]:
        """Messages since the last call (at most `limit`, and one round of the ring),
        oldest first.
        """
        messages: list[bytes] = []
        for _ in range(self._slots.count):
            written = self._slots.written
            is_full = limit is not None and len(messages) >= limit
            if self._read >= written or is_full:
                break
            # The writer has overwritten what was not read in time
            oldest = max(0, written - self._slots.count)
            if self._read < oldest:
                self.dropped += oldest - self._read
                self._read = oldest
            # A slot that is being written is read in the next call, or counted as lost if it stays
            # unreadable
            message = self._read_slot(self._read)
            if message is None and self._not_there_yet():
                break
            self._read += 1
            if message is None:
                self.dropped += 1
            else:
                messages.append(message)
        return messages

    def latest(self) -> bytes | None:
        """The newest message, or None if there is none yet;
        skips older ones without counting them.
        """
        for _ in range(_TRIES):
            written = self._slots.written
            if not written:
                break
            self._read = written
            if (message := self._read_slot(written - 1)) is not None:
                return message
        return None

    def _not_there_yet(self) -> bool:
        """Whether the message, not overwritten, has yet to become visible;
        True once per message.
        """
        again = (
            self._looked_at != self._read and self._read > self._slots.written - self._slots.count
        )
        self._looked_at = self._read
        return again

    def _read_slot(self, index: int) -> bytes | None:
        # In the opposite order of the writer: the last number before the copy, the first one after
        slots = self._slots
        first, last = slots.span(index)
        after = slots.words[last]
        seal = slots.words[first + 1]
        length = min(seal & 0xFFFFFFFF, self._slot_bytes)
        message = bytes(slots.bytes[8 * first + 16 : 8 * first + 16 + length])
        before = slots.words[first]
        if before == after == index + 1 and seal == _compute_seal(message, index + 1):
            return message
        return None

    def close(self) -> None:
        """Detach."""
        self._slots.close()


@contextmanager
def open_ring(slots: int, slot_bytes: int) -> Iterator[RingAddress]:
    """A ring for the duration of a `with` block, in the process that lives longest.

    Parameters
    ----------
    slots : int
        Messages that are kept: a reader that is further behind loses the oldest.
    slot_bytes : int
        The longest message.

    Yields
    ------
    RingAddress
        For the writer and the readers, in this or another process; plain data.
    """
    owner = Ring(slots, slot_bytes)
    try:
        yield owner.address
    finally:
        owner.close()


def _compute_seal(message: bytes, sequence: int) -> int:
    """Length and CRC-32 of a message, in one word."""
    return len(message) | zlib.crc32(message, sequence & 0xFFFFFFFF) << 32


def _slot_stride(slot_bytes: int) -> int:
    return (slot_bytes + _SLOT_OVERHEAD + 7) // 8 * 8
