"""Arrow IPC streams with a CRC-32 per message: a flipped byte costs its batch instead of falsifying values.

Any Arrow reader opens such a file. The seal is custom metadata of each message, text of fixed width: `seal:`, its
position in the message, the message's length, and the CRC-32 of the message with that last number taken as zeros (as
in the header of a tar file), all in hexadecimal. So whole messages are found, even after damage, before Arrow sees a
byte of them: its decoder trusts lengths and offsets.
"""

import io
import re
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from membrane_ctrl.model.files import read_bytes
from membrane_ctrl.run_files import column_codec

# Computes the memory that an Arrow stream would need before allocating any.
#
# A compressed buffer begins with its claimed inflated size, which Arrow allocates at once: four megabytes may become
# four gigabytes. So the sizes of a batch are added up first, from its header (a flatbuffer, `Message.fbs` of the
# format), and anything that no recorder writes is refused.


# A recorder's batch is a minute of ticks at 200 Hz, or an hour of the coarsest level: 8 MB.
BATCH_BYTES_MAX = 64_000_000
# Six hours of ticks at 200 Hz are 0.3 GB on disk.
FILE_BYTES_MAX = 320_000_000
_HEADER, _BUFFERS, _COMPRESSION = 2, 2, 3  # numbers of the fields in `Message` and in `RecordBatch`


def require_bounded(data: bytes) -> None:
    """Raise `pa.ArrowInvalid` if a batch would inflate beyond `BATCH_BYTES_MAX`, or is not a batch of numbers."""
    reader = pa.ipc.MessageReader.open_stream(data)
    for message in _messages(reader):
        if message.type == "schema":
            continue
        if message.type != "record batch":
            raise pa.ArrowInvalid(f"a {message.type}, which no recorder writes")
        try:
            size = _inflated_bytes(memoryview(message.metadata), memoryview(message.body or b""))
        except (struct.error, IndexError):
            raise pa.ArrowInvalid("the header of a batch is damaged") from None
        if size > BATCH_BYTES_MAX:
            raise pa.ArrowInvalid(f"a batch of {size / 1e6:.0f} MB exceeds the limit of {BATCH_BYTES_MAX / 1e6:.0f}")


def _messages(reader: pa.ipc.MessageReader) -> Iterator[pa.ipc.Message]:
    while True:
        try:
            yield reader.read_next_message()
        except (StopIteration, pa.ArrowException, OSError):  # truncated: the batches' reader finds that, too
            return


def _inflated_bytes(head: memoryview, body: memoryview) -> int:
    """Inflated bytes of all buffers of a batch; an uncompressed buffer states -1."""
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
    """Position of the table to which the offset at a position points."""
    return place + _u32(head, place)


def _field(head: memoryview, table: int, number: int) -> int:
    """Position of a table's field; 0 if absent."""
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


_KEY, _CODES = b"seal", b"codes"
_BLANK = b"seal:" + 20 * b"0"
_SEAL = re.compile(rb"seal:([0-9a-f]{4})([0-9a-f]{8})([0-9a-f]{8})")
_NO_CRC = 8 * b"0"
_END = b"\xff\xff\xff\xff\x00\x00\x00\x00"  # Arrow's end of a stream


class SealedStream:
    """Writes one file, new or replaced, message by message; `compression` is `zstd` or `lz4`.

    Raises OSError if the file or its header cannot be written.
    """

    def __init__(self, path: Path, schema: pa.Schema, compression: str | None = None) -> None:
        # one thread: compressing is not urgent, the tick beside it is
        options = pa.ipc.IpcWriteOptions(compression=compression, use_threads=False)
        self._message = io.BytesIO()
        about = {**(schema.metadata or {}), _KEY: _BLANK}
        schema = schema.with_metadata(about)
        self._writer = pa.ipc.new_stream(self._message, schema, options=options)
        self._writer.write_batch(pa.RecordBatch.from_pylist([], schema))
        self._take()  # Arrow writes its header with the first batch, we write it before
        self._file = pa.OSFile(str(path), "wb")
        self._file.write(_sealed(schema.serialize().to_pybytes()))

    def write(self, batch: pa.RecordBatch, codes: bytes | None = None) -> None:
        """Append a batch. Raises OSError (full disk): readers skip a half-written one."""
        about = {_KEY: _BLANK} if codes is None else {_KEY: _BLANK, _CODES: codes}
        self._writer.write_batch(batch, custom_metadata=about)
        self._file.write(_sealed(self._take()))

    def close(self) -> None:
        """End the stream and close the file, even if that raises OSError."""
        with self._file:
            self._writer.close()
            self._file.write(self._take())

    def abandon(self) -> None:
        """Close the file without an end."""
        self._file.close()

    def _take(self) -> bytes:
        message = self._message.getvalue()
        self._message.seek(0)
        self._message.truncate()
        return message


@dataclass(frozen=True, slots=True)
class Damage:
    """A stretch of a file that is not a whole message."""

    batches: int  # whole ones before it
    size_bytes: int
    at_end: bool  # nothing whole follows


@dataclass(frozen=True, slots=True)
class Unsealed:
    """The part of a file that Arrow may read."""

    data: bytes  # a stream of whole messages; empty without a whole header, which every batch needs
    sealed: bool  # False: an unchanged file of a version without seals
    ended: bool  # closed, not left by a killed recorder or truncated
    damage: tuple[Damage, ...]


def unseal(data: bytes) -> Unsealed:
    """Find the whole messages in a file's content."""
    ended = data.endswith(_END)
    if _SEAL.search(data) is None:
        return Unsealed(data, False, ended, ())
    places = list(_whole(data))
    if not places or places[0][0] != 0:
        return Unsealed(b"", True, ended, (Damage(0, len(data), True),))
    size = len(data) - len(_END) * ended
    behind = [start for start, _ in places[1:]] + [size]
    damage = tuple(
        Damage(batches, start - end, batches == len(places) - 1)
        for batches, ((_, end), start) in enumerate(zip(places, behind, strict=True))
        if start > end
    )
    return Unsealed(b"".join(data[a:b] for a, b in places) if damage else data, True, ended, damage)


def whole_batches(path: Path, names: list[str] | None = None) -> Iterator[pa.RecordBatch]:
    """Whole batches of a file, with all columns or some. Raises OSError, pa.ArrowException."""
    data = unseal(read_bytes(path, FILE_BYTES_MAX)).data
    if not data:
        return
    require_bounded(data)
    yield from decoded_batches(data, names)


def decoded_batches(data: bytes, names: Sequence[str] | None = None) -> Iterator[pa.RecordBatch]:
    """Batches of an Arrow stream, with all columns or some, decoded. Raises pa.ArrowException."""
    schema = pa.ipc.open_stream(data).schema
    wanted = list(schema.names if names is None else names)
    fields = [schema.get_field_index(name) for name in column_codec.needed(schema, wanted)]
    # one thread: buffers of a minute are too small to share out
    options = pa.ipc.IpcReadOptions(included_fields=fields, use_threads=False)
    reader = pa.ipc.open_stream(data, options=options)
    while True:
        try:
            batch, about = reader.read_next_batch_with_custom_metadata()
        except StopIteration:
            return
        batch.validate(full=True)  # otherwise Arrow trusts lengths and offsets, and may read foreign memory
        yield column_codec.decode(batch, schema, (about or {}).get(_CODES), wanted)


def _sealed(message: bytes) -> bytes:
    """Fill in the message's blank seal."""
    place = message.index(_BLANK)
    until = place + len(_BLANK)
    text = b"seal:%04x%08x" % (place, len(message))
    head, tail = message[:place] + text, message[until:]
    crc = zlib.crc32(tail, zlib.crc32(_NO_CRC, zlib.crc32(head)))
    return head + b"%08x" % crc + tail


def _whole(data: bytes) -> Iterator[tuple[int, int]]:
    """Start and end of each message with a correct seal."""
    view = memoryview(data)
    end = 0
    in_vain = 0
    place = _SEAL.search(data)
    while place is not None:
        offset, length, crc = (int(text, 16) for text in place.groups())
        start = place.start() - offset
        number = place.start(3)
        if start >= end and place.end() <= start + length <= len(data):
            if in_vain > 2 * len(data):  # nested seals, each with its own checksum: forged, not damaged
                return
            found = zlib.crc32(_NO_CRC, zlib.crc32(view[start:number]))
            if zlib.crc32(view[place.end() : start + length], found) == crc:
                end = start + length
                yield start, end
            else:
                in_vain += length
        place = _SEAL.search(data, max(end, place.end()))
