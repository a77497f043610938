"""What an Arrow stream would take of memory, known before any is taken.

A compressed buffer begins with the size that it says it inflates to, and Arrow takes that much at once: four
megabytes may become four gigabytes. So the sizes of a batch are added up first, out of its head (a flatbuffer,
`Message.fbs` of the format), and what no recorder writes is refused.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator

import numpy as np
import pyarrow as pa

# A recorder's batch is a minute of ticks at 200 Hz, or an hour of the coarsest level: 8 MB.
BATCH_BYTES_MAX = 64_000_000
# Six hours of ticks at 200 Hz are 0.3 GB on the disk.
FILE_BYTES_MAX = 320_000_000
_HEADER, _BUFFERS, _COMPRESSION = 2, 2, 3  # numbers of the fields in `Message` and in `RecordBatch`


def require_bounded(data: bytes) -> None:
    """Raise `pa.ArrowInvalid` if a batch would inflate to more than `BATCH_BYTES_MAX`, or is no batch of numbers."""
    reader = pa.ipc.MessageReader.open_stream(data)
    for message in _messages(reader):
        if message.type == "schema":
            continue
        if message.type != "record batch":
            raise pa.ArrowInvalid(f"a {message.type}, which no recorder writes")
        try:
            size = _inflated_bytes(memoryview(message.metadata), memoryview(message.body or b""))
        except (struct.error, IndexError):
            raise pa.ArrowInvalid("the head of a batch is damaged") from None
        if size > BATCH_BYTES_MAX:
            raise pa.ArrowInvalid(
                f"a batch of {size / 1e6:.0f} MB; more than {BATCH_BYTES_MAX / 1e6:.0f} are not read"
            )


def _messages(reader: pa.ipc.MessageReader) -> Iterator[pa.ipc.Message]:
    while True:
        try:
            yield reader.read_next_message()
        except (StopIteration, pa.ArrowException, OSError):  # cut short: whoever reads the batches meets it, too
            return


def _inflated_bytes(head: memoryview, body: memoryview) -> int:
    """Bytes of all buffers of a batch, inflated; a buffer that is stored as it is says -1."""
    batch = _table(head, _field(head, _table(head, 0), _HEADER))
    vector = _field(head, batch, _BUFFERS)
    if not vector:
        return 0
    start = vector + _u32(head, vector)
    count = _u32(head, start)
    buffers = np.frombuffer(head[start + 4 : start + 4 + 16 * count], dtype="<i8").reshape(-1, 2)
    if len(buffers) != count:
        raise IndexError
    if not _field(head, batch, _COMPRESSION):
        return int(np.abs(buffers[:, 1]).sum())
    total = 0
    for offset, length in buffers.tolist():
        if length:
            (stated,) = struct.unpack_from("<q", body, offset)
            total += length if stated == -1 else abs(stated)
    return total


def _table(head: memoryview, place: int) -> int:
    """Where the table is that an offset at a place points to."""
    return place + _u32(head, place)


def _field(head: memoryview, table: int, number: int) -> int:
    """Where a table's field is; 0 if it does not have it."""
    (back,) = struct.unpack_from("<i", head, table)
    vtable = table - back
    (size,) = struct.unpack_from("<H", head, vtable)
    if 4 + 2 * number >= size:
        return 0
    (offset,) = struct.unpack_from("<H", head, vtable + 4 + 2 * number)
    return table + offset if offset else 0


def _u32(head: memoryview, place: int) -> int:
    (number,) = struct.unpack_from("<I", head, place)
    return int(number)
