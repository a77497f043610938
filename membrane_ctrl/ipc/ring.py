"""A ring of messages in shared memory: one writer that never waits, any number of readers.

The writer overwrites the oldest slot; a reader that was too slow sees a gap in the sequence numbers and counts
it. What a killed writer had put is still there for its readers. Each slot carries its sequence number before
and after the message: a reader takes a slot only if both are the one it expects, before and after copying.
Numbers are 8-byte aligned, which x86-64 and ARM64 write at once.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.shared_memory import SharedMemory

_HEADER_BYTES = 64  # a cache line of its own for the write counter
_U64 = struct.Struct("<Q")
_SLOT_OVERHEAD = 3 * 8  # sequence, length, sequence again


@dataclass(frozen=True, slots=True)
class RingAddress:
    """What another process needs to read a ring (or to become its only writer)."""

    name: str
    slots: int
    slot_bytes: int


class Ring:
    """Owns the shared memory; create it in the process that outlives the readers' start.

    Parameters
    ----------
    slots : int
        Messages kept.
    slot_bytes : int
        Longest message.
    """

    def __init__(self, slots: int, slot_bytes: int) -> None:
        stride = _stride(slot_bytes)
        self._memory = SharedMemory(create=True, size=_HEADER_BYTES + slots * stride)
        self.address = RingAddress(self._memory.name, slots, slot_bytes)

    def close(self) -> None:
        """Give the memory back; readers that are still attached keep theirs."""
        self._memory.close()
        self._memory.unlink()


class RingWriter:
    """The one writer of a ring."""

    def __init__(self, address: RingAddress) -> None:
        self._memory = SharedMemory(address.name)
        self._buffer = _buffer(self._memory)
        self._address = address
        self._stride = _stride(address.slot_bytes)
        self._next = _U64.unpack_from(self._buffer, 0)[0]

    @property
    def slot_bytes(self) -> int:
        """Longest message."""
        return self._address.slot_bytes

    def put(self, message: bytes) -> None:
        """Write one message over the oldest. Raises ValueError if it is longer than a slot."""
        length = len(message)
        if length > self._address.slot_bytes:
            raise ValueError(f"message of {length} bytes in a ring of {self._address.slot_bytes}-byte slots")
        buffer = self._buffer
        sequence = self._next + 1
        start = _HEADER_BYTES + (self._next % self._address.slots) * self._stride
        _U64.pack_into(buffer, start, sequence)
        _U64.pack_into(buffer, start + 8, length)
        buffer[start + 16 : start + 16 + length] = message
        _U64.pack_into(buffer, start + self._stride - 8, sequence)
        self._next = sequence
        _U64.pack_into(buffer, 0, sequence)

    def close(self) -> None:
        """Detach."""
        self._memory.close()


class RingReader:
    """One reader; it starts at the oldest message still in the ring.

    Attributes
    ----------
    dropped : int
        Messages overwritten before this reader got to them.
    """

    def __init__(self, address: RingAddress) -> None:
        self._memory = SharedMemory(address.name)
        self._buffer = _buffer(self._memory)
        self._address = address
        self._stride = _stride(address.slot_bytes)
        self._read = 0
        self.dropped = 0

    def drain(self, limit: int | None = None) -> list[bytes]:
        """All messages since the last call (at most `limit`), oldest first."""
        messages: list[bytes] = []
        while limit is None or len(messages) < limit:
            written = self._written()
            if self._read >= written:
                break
            oldest = max(0, written - self._address.slots)
            if self._read < oldest:
                self.dropped += oldest - self._read
                self._read = oldest
            message = self._take(self._read)
            self._read += 1
            if message is None:
                self.dropped += 1
            else:
                messages.append(message)
        return messages

    def latest(self) -> bytes | None:
        """The newest message, or None if there is none yet; older ones are passed over and not counted."""
        while written := self._written():
            self._read = written
            if (message := self._take(written - 1)) is not None:
                return message
        return None

    def _written(self) -> int:
        return int(_U64.unpack_from(self._buffer, 0)[0])

    def _take(self, index: int) -> bytes | None:
        buffer = self._buffer
        start = _HEADER_BYTES + (index % self._address.slots) * self._stride
        after = _U64.unpack_from(buffer, start + self._stride - 8)[0]
        length = min(_U64.unpack_from(buffer, start + 8)[0], self._address.slot_bytes)
        message = bytes(buffer[start + 16 : start + 16 + length])
        before = _U64.unpack_from(buffer, start)[0]
        return message if before == after == index + 1 else None

    def close(self) -> None:
        """Detach."""
        self._memory.close()


@contextmanager
def ring(slots: int, slot_bytes: int) -> Iterator[RingAddress]:
    """A ring for the length of a `with` block."""
    owner = Ring(slots, slot_bytes)
    try:
        yield owner.address
    finally:
        owner.close()


def _buffer(memory: SharedMemory) -> memoryview:
    assert memory.buf is not None  # None only after close()
    return memory.buf


def _stride(slot_bytes: int) -> int:
    return (slot_bytes + _SLOT_OVERHEAD + 7) // 8 * 8
