"""The controller's inputs, tick by tick, for a replay (docs/replay.md)."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from membrane_ctrl.controller.tick import RECORD, Records
from membrane_ctrl.model import files, plain_json, shape_estimate
from membrane_ctrl.run_files import column_reader, shapes, tables

T = TypeVar("T")
# A shape is used within seconds of its exposures.
_SHAPE_BEFORE_S = 60.0
_NEEDED = ("tick", "now_s", "output_crc", "tail_bytes")

# Files of earlier versions.
SCHEMA = "membrane-inputs/1"
_MAGIC = b"MBRNin01"
_HEAD = struct.Struct("<8sII")  # magic, bytes that follow, their CRC-32
_COUNT = struct.Struct("<I")
_PART = struct.Struct("<cqI")  # kind, tick, bytes that follow
_TAIL, _SHAPE, _MEMORY = b"C", b"S", b"M"
# A file of six hours at 200 Hz is 130 MB, a second 100 kB; a shape with its covariance is 12 kB, a memory 30 kB.
_FILE_BYTES_MAX = 300_000_000
_BODY_BYTES_MAX = 16_000_000
_HEAD_BYTES_MAX = 65_536
# Permitted field types of a record: no objects, no arrays.
_CODES = {code: code for code in ("<i8", "<f8", "|u1", "<u4")}


@dataclass(frozen=True, slots=True)
class InputsFrame:
    """A part of a run: ticks by number, tails and memories by tick, shape estimates by time."""

    records: Records
    tails: dict[int, bytes]
    memories: dict[int, bytes]
    estimates: dict[float, shape_estimate.ShapeEstimate]


class InputsReader:
    """Reads the inputs of a run or an incident; damage is listed, not raised."""

    def __init__(self, folder: Path, paths: list[Path]) -> None:
        self._folder = folder
        self.paths = paths
        self.program = ""  # that wrote the last file read
        self.damage: list[str] = []  # unreadable parts so far, one line per place

    def __iter__(self) -> Iterator[InputsFrame]:
        """Yield all frames in order; ticks written twice (by a resumed recorder) appear once."""
        raise NotImplementedError

    def since(self, time_s: float) -> InputsReader:
        """A reader that starts at the last memory before this time of the run, or earlier."""
        raise NotImplementedError


def open_inputs(folder: Path) -> InputsReader:
    """Return a reader of a run's inputs, from the tables or from the `inputs-*.bin` of earlier versions."""
    earlier = sorted(folder.glob("inputs-*.bin"))
    if earlier:
        return FramesReader(folder, earlier)
    return TablesReader(folder, column_reader.column_files(folder, tables.TICKS))


class TablesReader(InputsReader):
    """Reads the tables `ticks`, `rare` and `shapes`, one batch of ticks after the other."""

    _from_s = -math.inf

    def __iter__(self) -> Iterator[InputsFrame]:
        """Yield all frames in order, each with the rare parts and shapes up to its end."""
        last = 0
        rare = _Ahead((row.time_s, row) for row in self._rare())
        figures = _Ahead((estimate.time_s, estimate) for estimate in self._estimates())
        for table in self._tables(tables.TICKS, tuple(tables.GIVEN.values())):
            records = self._records(table)
            records = records[(records["tick"] > last) & (records["now_s"] >= self._from_s)]
            if not len(records):
                continue
            last, until_s = int(records["tick"][-1]), float(records["now_s"][-1])
            parts = list(rare.until(until_s))
            tails = {row.tick: row.data for row in parts if row.kind == tables.COMMANDS}
            memories = {row.tick: row.data for row in parts if row.kind == tables.MEMORY}
            yield InputsFrame(records, tails, memories, {found.time_s: found for found in figures.until(until_s)})

    def since(self, time_s: float) -> InputsReader:
        """A reader that starts at the last memory before this time of the run."""
        found = TablesReader(self._folder, self.paths)
        times_s = [row.time_s for row in found._rare() if row.kind == tables.MEMORY and row.time_s <= time_s]
        found.damage.clear()  # reported again when the file is read
        found._from_s = max(times_s, default=-math.inf)
        return found

    def _tables(self, table: str, names: Sequence[str], before_s: float = 0.0) -> Iterator[pa.Table]:
        """A table's batches, without files that end before the reader starts."""
        paths = column_reader.column_files(self._folder, table)
        begin_s = self._from_s - before_s
        time_name = "mono_s" if table == tables.TICKS else "time_s"
        for place, path in enumerate(paths):
            if math.isfinite(begin_s) and place + 1 < len(paths):
                next_s = column_reader.first_s(paths[place + 1], time_name)
                if next_s is not None and next_s < begin_s:
                    continue
            if table == tables.TICKS:
                self.program = column_reader.written_by(path) or self.program
            yield from column_reader.read_parts(path, names, self.damage, cells=0)

    def _records(self, table: pa.Table) -> Records:
        """The records of a batch, missing fields as NaN or 0; none without the mandatory fields."""
        names = {tables.GIVEN[name] for name in _NEEDED}
        records = np.zeros(table.num_rows if names <= set(table.column_names) else 0, dtype=RECORD)
        for name, column in tables.GIVEN.items() if len(records) else ():
            with np.errstate(invalid="ignore"):
                if column in table.column_names:
                    records[name] = table.column(column).to_numpy()
                elif RECORD[name].kind == "f":
                    records[name] = np.nan
        return records

    def _rare(self) -> Iterator[_Rare]:
        for table in self._tables(tables.RARE, tables.rare_schema().names):
            if table.column_names == tables.rare_schema().names:
                rows = zip(*(table.column(name).to_pylist() for name in table.column_names), strict=True)
                yield from (row for row in (_Rare(*values) for values in rows) if row.time_s >= self._from_s)

    def _estimates(self) -> Iterator[shape_estimate.ShapeEstimate]:
        for table in self._tables(tables.SHAPES, shapes.ESTIMATE_COLUMNS, _SHAPE_BEFORE_S):
            try:
                yield from shapes.estimates(table.filter(pc.field("time_s") >= self._from_s - _SHAPE_BEFORE_S))
            except (ValueError, LookupError) as error:
                column_reader.add_note(self.damage, f"{tables.SHAPES}: a batch holds no estimates ({error})")


@dataclass(frozen=True, slots=True)
class _Rare:
    """A row of the table `rare`."""

    time_s: float
    tick: int
    kind: str
    data: bytes


class _Ahead(Generic[T]):
    """Items in order of time, handed out up to a given time."""

    def __init__(self, timed: Iterator[tuple[float, T]]) -> None:
        self._timed = timed
        self._next = next(timed, None)

    def until(self, time_s: float) -> Iterator[T]:
        """The items up to a time that were not handed out before."""
        while self._next is not None and self._next[0] <= time_s:
            yield self._next[1]
            self._next = next(self._timed, None)


class FramesReader(InputsReader):
    """Reads the `inputs-*.bin` of an earlier version, frame by frame.

    A file is one line of JSON, then one frame per second: magic, length, CRC-32, zlib of the number of ticks, their
    records in columns, then parts of kind `C` (commands and ended tasks), `M` (memory), `S` (shape estimate).
    """

    def __iter__(self) -> Iterator[InputsFrame]:
        """Yield all frames in order; ticks written twice appear once."""
        last = 0
        for path in self.paths:
            try:
                data = files.read_bytes(path, _FILE_BYTES_MAX)
            except OSError as error:
                self.damage.append(f"{path.name}: cannot be read ({error.strerror})")
                continue
            kind = self._kind_of(data, path.name)
            if kind is None:
                continue
            for body in self._bodies(data, path.name):
                try:
                    frame = _frame_of(body, kind)
                except (ValueError, struct.error, LookupError, TypeError) as error:
                    self.damage.append(f"{path.name}: a frame holds no ticks ({error})")
                    continue
                fresh = frame.records[frame.records["tick"] > last]
                if len(fresh):
                    last = int(fresh["tick"][-1])
                yield InputsFrame(fresh, frame.tails, frame.memories, frame.estimates)

    def since(self, time_s: float) -> InputsReader:
        """A reader that starts with the run."""
        return FramesReader(self._folder, self.paths)

    def _kind_of(self, data: bytes, name: str) -> np.dtype[np.void] | None:
        """The file's own record type: an older program's may lack fields, a newer one's may have more."""
        line, _, _ = data[:_HEAD_BYTES_MAX].partition(b"\n")  # a full partition would copy the rest
        try:
            head = plain_json.loads(line.decode())
            fields = [(str(field), _CODES[code]) for field, code in head["fields"]]
            kind = np.dtype(fields)
            self.program = str(head["program"])
        except (ValueError, KeyError, TypeError):
            self.damage.append(f"{name}: its first line is damaged; assuming this version's format")
            return RECORD
        if head.get("schema") != SCHEMA:
            self.damage.append(f"{name}: schema {head.get('schema')}, expected {SCHEMA}")
            return None
        return kind

    def _bodies(self, data: bytes, name: str) -> Iterator[bytes]:
        """Bodies of all whole frames, with anything between them."""
        place = 0
        good_until = data.find(b"\n") + 1
        in_vain = 0
        while (place := data.find(_MAGIC, place)) >= 0 and in_vain <= len(data):
            body, end = _body_at(data, place)
            if body is None:
                in_vain += min(end, len(data)) - place
                place += 1
                continue
            self._note_damage(name, good_until, place)
            yield body
            place = good_until = end
        self._note_damage(name, good_until, len(data))

    def _note_damage(self, name: str, start: int, end: int) -> None:
        if end > start:
            self.damage.append(f"{name}: {end - start} bytes at {start} are unreadable")


def _body_at(data: bytes, place: int) -> tuple[bytes | None, int]:
    """A frame's body and end; None and the end of the search if it is not whole."""
    if place + _HEAD.size > len(data):
        return None, place
    _, length, crc = _HEAD.unpack_from(data, place)
    end = place + _HEAD.size + length
    if end > len(data) or length > _BODY_BYTES_MAX:
        return None, place + _HEAD.size
    packed = data[place + _HEAD.size : end]
    if zlib.crc32(packed) != crc:
        return None, end
    inflating = zlib.decompressobj()
    try:
        body = inflating.decompress(packed, _BODY_BYTES_MAX)
    except zlib.error:
        return None, end
    return (body, end) if inflating.eof else (None, end)


def _frame_of(body: bytes, kind: np.dtype[np.void]) -> InputsFrame:
    (count,) = _COUNT.unpack_from(body)
    if len({*(kind.names or ()), *_NEEDED}) != len(kind.names or ()):
        raise ValueError("a mandatory field is missing")
    records, taken = decode_columns(body[_COUNT.size :], kind, count)
    place = _COUNT.size + taken
    frame = InputsFrame(_known_fields(records), {}, {}, {})
    while place < len(body):
        part, tick, length = _PART.unpack_from(body, place)
        data = body[place + _PART.size : place + _PART.size + length]
        place += _PART.size + length
        if part == _TAIL:
            frame.tails[tick] = data
        elif part == _MEMORY:
            frame.memories[tick] = data
        elif part == _SHAPE:
            estimate = shape_estimate.unpack_estimate(data)
            frame.estimates[estimate.time_s] = estimate
    return frame


def _known_fields(records: Records) -> Records:
    """Convert the records to ours, missing fields as NaN or 0."""
    if records.dtype == RECORD:
        return records
    ours = np.zeros(len(records), dtype=RECORD)
    for name in RECORD.names or ():
        if name in (records.dtype.names or ()):
            ours[name] = records[name]
        elif RECORD[name].kind == "f":
            ours[name] = np.nan
    return ours


# A column is code and data: code 0 to 6 is the number of decimals of values that are whole numbers over a power of
# ten, as differences in 4 bytes; 255 is the exclusive or with the tick before. Bytes are sorted by position.
_AS_IT_IS = 255
_DIGITS_MAX = 6


def decode_columns(data: bytes, kind: np.dtype[np.void], count: int) -> tuple[NDArray[np.void], int]:
    """(count,) records of a kind, and the number of bytes of `data` used. Raises ValueError if there are too few."""
    # before allocating memory: a count may be anything
    if count * sum(min(4, kind[name].itemsize) for name in kind.names or ()) > len(data):
        raise ValueError(f"{count} ticks cannot be in {len(data)} bytes")
    records = np.empty(count, dtype=kind)
    if not count:
        return records, 0
    place = 0
    for name in kind.names or ():
        field = kind[name]
        if place >= len(data):
            raise ValueError("too short for its ticks")
        code = data[place]
        if code != _AS_IT_IS and (code > _DIGITS_MAX or field.kind != "f"):
            raise ValueError(f"column {name} has no code {code}")
        size = count * (4 if code != _AS_IT_IS else field.itemsize)
        records[name] = _decode(code, data[place + 1 : place + 1 + size], field, count)
        place += 1 + size
    return records, place


def _decode(code: int, data: bytes, field: np.dtype[Any], count: int) -> NDArray[Any]:
    width = 4 if code != _AS_IT_IS else field.itemsize
    planes = np.frombuffer(data, dtype="u1").reshape(width, count).T
    if code == _AS_IT_IS:
        return np.ascontiguousarray(np.bitwise_xor.accumulate(planes, axis=0)).view(field).reshape(count)
    steps = np.ascontiguousarray(planes).view("<i4").reshape(count)
    decoded: NDArray[Any] = np.cumsum(steps, dtype=np.int64) / 10.0**code
    return decoded
