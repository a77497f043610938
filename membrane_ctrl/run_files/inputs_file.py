"""`inputs-000.bin`, `-001`, ...: everything the controller was given, for a replay (docs/replay.md).

A file is one line of JSON and then frames, one a second: magic, length, CRC-32, zlib. A frame is whole or it is not
there: what a crash or a bad sector leaves is read up to the damage and from the next magic on. In a frame the ticks'
records come first, in columns (`column_codec`), then the rare parts.
"""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import struct
import zlib
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from membrane_ctrl.controller.tick import RECORD, Records, TickBatch
from membrane_ctrl.model import files, plain_json, shape_estimate
from membrane_ctrl.run_files.column_file import decode_columns, encode_columns

SCHEMA = "membrane-inputs/1"
_MAGIC = b"MBRNin01"
_HEAD = struct.Struct("<8sII")  # magic, bytes that follow, their CRC-32
_COUNT = struct.Struct("<I")
_PART = struct.Struct("<cqI")  # kind, tick, bytes that follow
_TAIL, _SHAPE, _MEMORY = b"C", b"S", b"M"
_LOOK_BYTES = 1 << 20  # holds a first frame, whatever is in it
# While the disk is full frames wait here, one a second: ten minutes, in which a person who was told makes room; 2 MB.
WAITING_MAX = 600
# A file of six hours at 200 Hz is 130 MB, a second 100 kB; a shape with its covariance is 12 kB, a memory 30 kB.
_FILE_BYTES_MAX = 300_000_000
_BODY_BYTES_MAX = 16_000_000
_HEAD_BYTES_MAX = 65_536
# What a record's fields may be: no objects, no arrays.
_CODES = {code: code for code in ("<i8", "<f8", "|u1", "<u4")}
_NEEDED = ("tick", "now_s", "output_crc", "tail_bytes")


class InputsFile:
    """Appends frames; what a full disk does not take waits, and the next call goes on where this one stopped.

    Parameters
    ----------
    run_dir : Path
        Folder of the run.
    version : str
        Of the program; a replay by another one says so.
    segment_s : float
        Length of a file.
    """

    def __init__(self, run_dir: Path, version: str, segment_s: float = math.inf) -> None:
        self._run_dir = run_dir
        self._segment_s = segment_s
        self._segment_until_s = math.inf
        head = {"schema": SCHEMA, "program": f"membrane-ctrl {version}", "fields": [list(f) for f in RECORD.descr]}
        self._head = json.dumps(head).encode() + b"\n"
        self._descriptor: int | None = None
        self._waiting: deque[tuple[int, bytes]] = deque()  # ticks in it, frame
        self._given_up_ticks = 0

    @property
    def lost_ticks(self) -> int:
        """Ticks that no file has: given up, or still waiting for the disk."""
        return self._given_up_ticks + sum(ticks for ticks, _ in self._waiting)

    def append(self, batch: TickBatch, shapes: list[shape_estimate.ShapeEstimate], now_s: float = 0.0) -> None:
        """Write one frame, and those still waiting from before. Raises OSError (full disk): it waits."""
        if len(batch.records) or shapes:
            self._waiting.append((len(batch.records), _packed(batch, shapes)))
        while len(self._waiting) > WAITING_MAX:
            self._given_up_ticks += self._waiting.popleft()[0]
        while self._waiting:
            self._write(self._descriptor_at(now_s), self._waiting[0][1])
            self._waiting.popleft()

    def _descriptor_at(self, now_s: float) -> int:
        if now_s >= self._segment_until_s:
            self.close()
        if self._descriptor is None:
            number = sum(1 for _ in self._run_dir.glob("inputs-*.bin"))
            path = self._run_dir / f"inputs-{number:03d}.bin"
            self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
            self._segment_until_s = now_s + self._segment_s
        if not os.lseek(self._descriptor, 0, os.SEEK_CUR):
            self._write(self._descriptor, self._head)
        return self._descriptor

    @staticmethod
    def _write(descriptor: int, data: bytes) -> None:
        """All of it or nothing. Raises OSError."""
        before = os.lseek(descriptor, 0, os.SEEK_CUR)
        try:
            written = os.write(descriptor, data)
            if written < len(data) and os.write(descriptor, data[written:]) < len(data) - written:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError:
            with contextlib.suppress(OSError):  # half a frame is damage to a reader, and what is there is room
                os.ftruncate(descriptor, before)
            os.lseek(descriptor, before, os.SEEK_SET)
            raise

    def sync(self) -> None:
        """Wait until the disk has it. Raises OSError."""
        if self._descriptor is not None:
            os.fdatasync(self._descriptor)

    def close(self) -> None:
        """Close the file there is."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def _packed(batch: TickBatch, shapes: list[shape_estimate.ShapeEstimate]) -> bytes:
    parts = [(_TAIL, tick, tail) for tick, tail in batch.tails.items()]
    parts += [(_MEMORY, tick, memory) for tick, memory in batch.memories.items()]
    parts += [(_SHAPE, 0, shape_estimate.pack_estimate(shape)) for shape in shapes]
    body = _COUNT.pack(len(batch.records)) + encode_columns(batch.records)
    body += b"".join(_PART.pack(kind, tick, len(data)) + data for kind, tick, data in parts)
    packed = zlib.compress(body, 6)
    return _HEAD.pack(_MAGIC, len(packed), zlib.crc32(packed)) + packed


@dataclass(frozen=True, slots=True)
class InputsFrame:
    """About a second of a run: ticks by number, tails and memories by tick, shape estimates by time."""

    records: Records
    tails: dict[int, bytes]
    memories: dict[int, bytes]
    estimates: dict[float, shape_estimate.ShapeEstimate]


class InputsReader:
    """Reads the `inputs-*.bin` of a folder frame by frame; damage is listed, not raised.

    Parameters
    ----------
    folder : Path
        Of the run, or of an incident.

    Attributes
    ----------
    program : str
        Who recorded the last file that was read.
    damage : list of str
        What could not be read so far, one line a place.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.paths = sorted(folder.glob("inputs-*.bin"))
        self.program = ""
        self.damage: list[str] = []

    def __iter__(self) -> Iterator[InputsFrame]:
        """All frames in order; a tick that was written twice (a recorder that went on) comes once. Raises OSError."""
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
        """A reader that begins a file or two before this time of the run."""
        found = InputsReader(self._folder)
        begun = [place for place, path in enumerate(self.paths) if found._first_s(path) <= time_s]
        found.paths = self.paths[max(0, max(begun, default=0) - 1) :]
        found.damage.clear()  # it is told again when the file is read
        return found

    def _first_s(self, path: Path) -> float:
        try:
            with files.open_plain(path) as file:
                data = file.read(_LOOK_BYTES)
            kind = self._kind_of(data, path.name)
            body = next(self._bodies(data, path.name), None)
            frame = None if kind is None or body is None else _frame_of(body, kind)
        except (OSError, ValueError, struct.error, LookupError, TypeError):  # told when it is read
            return math.inf
        return math.inf if frame is None or not len(frame.records) else float(frame.records["now_s"][0])

    def _kind_of(self, data: bytes, name: str) -> np.dtype[np.void] | None:
        """The file's own record: one of an older program may lack a field, one of a newer have more."""
        line, _, _ = data[:_HEAD_BYTES_MAX].partition(b"\n")  # of all of it the rest would be a copy
        try:
            head = plain_json.loads(line.decode())
            fields = [(str(field), _CODES[code]) for field, code in head["fields"]]
            kind = np.dtype(fields)
            self.program = str(head["program"])
        except (ValueError, KeyError, TypeError):
            self.damage.append(f"{name}: its first line is damaged; taken for one of this program")
            return RECORD
        if head.get("schema") != SCHEMA:
            self.damage.append(f"{name}: {head.get('schema')} where {SCHEMA} is known")
            return None
        return kind

    def _bodies(self, data: bytes, name: str) -> Iterator[bytes]:
        """Bodies of all whole frames; between them anything may lie."""
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
            self.damage.append(f"{name}: {end - start} bytes at {start} are not readable")


def _body_at(data: bytes, place: int) -> tuple[bytes | None, int]:
    """A frame's body and where the frame ends; None if it is not whole, and how far it was looked at."""
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
        raise ValueError("without a field that every record has")
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
    """The records as ours: what they lack is NaN or 0."""
    if records.dtype == RECORD:
        return records
    ours = np.zeros(len(records), dtype=RECORD)
    for name in RECORD.names or ():
        if name in (records.dtype.names or ()):
            ours[name] = records[name]
        elif RECORD[name].kind == "f":
            ours[name] = np.nan
    return ours
