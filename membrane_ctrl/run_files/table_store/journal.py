"""The journal: a table's newest rows, on the disk within a second, as frames that each stand alone.

A frame is a head of 32 bytes (magic, number of its first row, rows, packed bytes, unpacked bytes,
CRC-32 of all else) and an Arrow IPC message packed with zstd. The first frame holds the schema,
each other one a record batch whose numbers are shuffled byte by byte (`byte_shuffle`). After a
damaged stretch reading continues with the next frame whose checksum is right.

Sizes are checked before memory is taken for them: a head states what its message unpacks to, and a
message whose own buffers are compressed, as an Arrow writer may do, is refused.
"""

import contextlib
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa

from membrane_ctrl.run_files.table_store.byte_shuffle import shuffle_batch, unshuffle_batch
from membrane_ctrl.run_files.table_store.disk import Disk

MAGIC = b"\x93MBRjrn\n"
_HEAD = struct.Struct("<8sQIIII")
_CRC = struct.Struct("<I")
# A second at 200 Hz is 0.1 MB. Ten minutes that waited for a full disk are 50 MB.
FRAME_BYTES_MAX = 128_000_000
# A journal is sealed after an hour or this many bytes: a reader holds all of it.
JOURNAL_BYTES_MOST = 64_000_000
FILE_BYTES_MAX = JOURNAL_BYTES_MOST + FRAME_BYTES_MAX
_CODEC = pa.Codec("zstd", compression_level=3)
# Numbers of fields in the flatbuffers of an Arrow message (`Message.fbs` of the format).
_HEADER_FIELD, _COMPRESSION_FIELD = 2, 3


class JournalWriter:
    """Appends record batches to a new journal. Raises OSError if it cannot be created."""

    def __init__(self, disk: Disk, path: Path, schema: pa.Schema) -> None:
        self._disk = disk
        self.path = path
        self.size_bytes = 0  # of whole frames
        disk.make_folder(path.parent)
        self._descriptor = disk.create(path)
        try:
            self._append_frame(_pack_frame(0, 0, schema.serialize()))
            disk.sync_folder(path.parent)
        except OSError:
            disk.close(self._descriptor)
            disk.remove(path)
            raise

    def append_batch(self, first_row: int, batch: pa.RecordBatch) -> None:
        """Append a batch and sync it: all of it or nothing.

        Parameters
        ----------
        first_row : int
            Number of its first row in the table.
        batch : RecordBatch
            The rows.

        Raises
        ------
        OSError
            The disk did not take it.
        """
        message = shuffle_batch(batch).serialize()
        self._append_frame(_pack_frame(first_row, batch.num_rows, message))

    def _append_frame(self, frame: bytes) -> None:
        try:
            self._disk.write(self._descriptor, frame)
            self._disk.sync(self._descriptor)
        except OSError:
            with contextlib.suppress(OSError):  # a reader skips half a frame
                self._disk.truncate(self._descriptor, self.size_bytes)
            raise
        self.size_bytes += len(frame)

    def close(self) -> None:
        """Close the file."""
        self._disk.close(self._descriptor)


def _pack_frame(first_row: int, rows: int, message: pa.Buffer) -> bytes:
    packed: bytes = _CODEC.compress(message, asbytes=True)
    head = _HEAD.pack(MAGIC, first_row, rows, len(packed), message.size, 0)[: -_CRC.size]
    return head + _CRC.pack(zlib.crc32(packed, zlib.crc32(head))) + packed


@dataclass(frozen=True, slots=True)
class JournalFrame:
    """An intact frame: its place in the file, and the message in it, packed."""

    start: int
    end: int
    first_row: int
    rows: int  # 0: the schema
    unpacked_bytes: int
    packed: memoryview


def find_frames(data: bytes) -> list[JournalFrame]:
    """All intact frames of a journal, in order.

    After a frame the search continues behind it; after a false start, at the next magic. A magic
    that a frame holds by chance is thus not found.
    """
    frames: list[JournalFrame] = []
    place, wasted_bytes = data.find(MAGIC), 0
    while place >= 0:
        frame = _frame_at(data, place)
        if isinstance(frame, JournalFrame):
            frames.append(frame)
            place = data.find(MAGIC, frame.end)
            continue
        wasted_bytes += frame
        if wasted_bytes > 2 * len(data):  # heads within frames, each with its own checksum: forged
            break
        place = data.find(MAGIC, place + 1)
    return frames


def _frame_at(data: bytes, start: int) -> JournalFrame | int:
    """The frame at a place; the bytes examined if there is none."""
    body = start + _HEAD.size
    if body > len(data):
        return 0
    # Sizes first: a damaged head may state anything, and only then is the checksum worth its time
    _, first_row, rows, packed_bytes, unpacked_bytes, crc = _HEAD.unpack_from(data, start)
    end = body + packed_bytes
    if end > len(data) or unpacked_bytes > FRAME_BYTES_MAX:
        return _HEAD.size
    packed = memoryview(data)[body:end]
    head = memoryview(data)[start : body - _CRC.size]
    if zlib.crc32(packed, zlib.crc32(head)) != crc:
        return int(packed_bytes)
    return JournalFrame(start, end, first_row, rows, unpacked_bytes, packed)


def read_schema(frame: JournalFrame) -> pa.Schema:
    """The schema in a journal's first frame. Raises pa.ArrowException, OSError or ValueError."""
    return pa.ipc.read_schema(_unpack_frame(frame))


def read_batch(frame: JournalFrame, schema: pa.Schema) -> pa.RecordBatch:
    """Read the record batch of a frame of unknown origin.

    Parameters
    ----------
    frame : JournalFrame
        The frame.
    schema : Schema
        Of the table.

    Returns
    -------
    RecordBatch

    Raises
    ------
    pa.ArrowException, OSError, ValueError
        The frame is damaged, or no recorder writes such a frame.
    """
    message = pa.ipc.read_message(_unpack_frame(frame))
    if message.type != "record batch" or _is_compressed(memoryview(message.metadata)):
        raise ValueError("a frame that no recorder writes")
    batch = pa.ipc.read_record_batch(message, schema)
    batch.validate(full=True)  # otherwise Arrow trusts lengths and offsets
    # Arrow accepts longer lists than those of the schema, and cuts them at other places
    for column in batch.columns:
        if (
            isinstance(column, pa.FixedSizeListArray)
            and len(column.values) != len(column) * column.type.list_size
        ):
            raise ValueError("lists of another length than those of the schema")
    if batch.num_rows != frame.rows or batch.nbytes > FRAME_BYTES_MAX:
        raise ValueError("a frame that does not hold its stated rows")
    return unshuffle_batch(batch)


def _unpack_frame(frame: JournalFrame) -> pa.Buffer:
    return _CODEC.decompress(pa.py_buffer(frame.packed), decompressed_size=frame.unpacked_bytes)


def _is_compressed(message: memoryview) -> bool:
    """Whether a record batch states that its buffers are compressed. Raises ValueError for a
    damaged header.
    """
    try:
        batch = _table_at(message, _field_place(message, _table_at(message, 0), _HEADER_FIELD))
        return _field_place(message, batch, _COMPRESSION_FIELD) != 0
    except struct.error:
        raise ValueError("the header of a record batch is damaged") from None


def _table_at(data: memoryview, place: int) -> int:
    """Place of the flatbuffer table to which the offset at a place points."""
    return int(place + struct.unpack_from("<I", data, place)[0])


def _field_place(data: memoryview, table: int, number: int) -> int:
    """Place of a field of a flatbuffer table; 0 if absent."""
    vtable = table - struct.unpack_from("<i", data, table)[0]
    if vtable < 0:
        raise ValueError("the header of a record batch is damaged")
    (size,) = struct.unpack_from("<H", data, vtable)
    if 4 + 2 * number >= size:
        return 0
    (offset,) = struct.unpack_from("<H", data, vtable + 4 + 2 * number)
    return int(table + offset) if offset else 0


@dataclass(frozen=True, slots=True)
class JournalBlock:
    """Consecutive rows of a journal, or a stretch of it that is lost."""

    first_row: int
    table: pa.Table


@dataclass(frozen=True, slots=True)
class LostBytes:
    """A stretch of a journal without an intact frame."""

    size_bytes: int
    at_end: bool


def read_journal(
    data: bytes, group_rows: int, schema: pa.Schema
) -> Iterator[JournalBlock | LostBytes]:
    """Read the rows of a journal in blocks, and its damaged stretches, in order.

    Parameters
    ----------
    data : bytes
        The file.
    group_rows : int
        Rows of a block, about.
    schema : Schema
        Replaces that of a journal whose first frame is damaged.

    Returns
    -------
    iterator of JournalBlock or LostBytes

    Raises
    ------
    pa.ArrowException, OSError, ValueError
        The journal's own schema cannot be read.
    """
    frames = find_frames(data)
    if frames and frames[0].rows == 0:
        schema = read_schema(frames[0])
    waiting: list[pa.RecordBatch] = []
    first_row = count = place = 0
    for frame in frames:
        # Bytes between intact frames are lost, and those of a frame whose rows cannot be read
        lost_bytes = frame.start - place
        place = frame.end
        batch = _batch_or_none(frame, schema)
        if batch is None and frame.rows:
            lost_bytes += frame.end - frame.start
        # A block ends before lost bytes, at a gap in the numbers of rows, and when it is full
        follows = batch is None or frame.first_row == first_row + count
        if waiting and (lost_bytes or not follows or count >= group_rows):
            yield _join_batches(first_row, waiting)
            waiting, count = [], 0
        if lost_bytes:
            yield LostBytes(lost_bytes, False)
        if batch is not None:
            if not waiting:
                first_row = frame.first_row
            waiting.append(batch)
            count += batch.num_rows
    if waiting:
        yield _join_batches(first_row, waiting)
    if place < len(data):
        yield LostBytes(len(data) - place, True)


def _join_batches(first_row: int, batches: list[pa.RecordBatch]) -> JournalBlock:
    return JournalBlock(first_row, pa.Table.from_batches(batches).combine_chunks())


def _batch_or_none(frame: JournalFrame, schema: pa.Schema) -> pa.RecordBatch | None:
    """The rows of a frame; None if it has none, or is not what a recorder writes."""
    if not frame.rows:
        return None
    try:
        return read_batch(frame, schema)
    except (pa.ArrowException, OSError, ValueError):
        return None
