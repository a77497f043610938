"""`inputs-000.bin`, `-001`, ...: everything the controller was given, for a replay (docs/replay.md).

A file is one line of JSON and then frames, one a second: magic, length, CRC-32, zlib. A frame is whole or it is not
there: what a crash or a bad sector leaves is read up to the damage and from the next magic on. In a frame the ticks'
records come first, as the difference (exclusive or) to the tick before and their bytes in columns (the same byte of
all ticks, then the next byte): together that takes four fifths off; then the rare parts.
"""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from membrane_ctrl.estimate import ShapeEstimate
from membrane_ctrl.tick_record import RECORD, Records, TickBatch, pack_estimate, unpack_estimate

SCHEMA = "membrane-inputs/1"
_MAGIC = b"MBRNin01"
_HEAD = struct.Struct("<8sII")  # magic, bytes that follow, their CRC-32
_COUNT = struct.Struct("<I")
_PART = struct.Struct("<cqI")  # kind, tick, bytes that follow
_TAIL, _SHAPE = b"C", b"S"


class InputsFile:
    """Appends frames. What a full disk did not take is given up: half a frame is no frame.

    Parameters
    ----------
    run_dir : Path
        Folder of the run.
    version : str
        Of the program; a replay by another one says so.
    """

    def __init__(self, run_dir: Path, version: str) -> None:
        self._run_dir = run_dir
        head = {"schema": SCHEMA, "program": f"membrane-ctrl {version}", "fields": [list(f) for f in RECORD.descr]}
        self._head = json.dumps(head).encode() + b"\n"
        self._descriptor: int | None = None

    def next_segment(self, number: int) -> None:
        """Go on in file `number`, or behind what is already in it. Raises OSError."""
        self.close()
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND
        self._descriptor = os.open(self._run_dir / f"inputs-{number:03d}.bin", flags, 0o644)
        if os.fstat(self._descriptor).st_size == 0:
            _write_all(self._descriptor, self._head)

    def append(self, batch: TickBatch, shapes: list[ShapeEstimate]) -> None:
        """Write one frame. Raises OSError (full disk): its ticks are then lost to a replay."""
        if self._descriptor is None or not (len(batch.records) or shapes):
            return
        parts = [(_TAIL, tick, tail) for tick, tail in batch.tails.items()]
        parts += [(_SHAPE, 0, pack_estimate(shape)) for shape in shapes]
        columns = batch.records.view("u1").reshape(-1, RECORD.itemsize).T.copy()
        columns[:, 1:] ^= columns[:, :-1].copy()
        body = _COUNT.pack(len(batch.records)) + columns.tobytes()
        body += b"".join(_PART.pack(kind, tick, len(data)) + data for kind, tick, data in parts)
        packed = zlib.compress(body, 6)
        _write_all(self._descriptor, _HEAD.pack(_MAGIC, len(packed), zlib.crc32(packed)) + packed)

    def sync(self) -> None:
        """Wait until the disk has it. Raises OSError."""
        if self._descriptor is not None:
            os.fdatasync(self._descriptor)

    def close(self) -> None:
        """Close the file there is."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def _write_all(descriptor: int, data: bytes) -> None:
    written = os.write(descriptor, data)
    if written < len(data):  # the rest raises what stopped it
        os.write(descriptor, data[written:])


@dataclass(slots=True)
class Inputs:
    """What the files of a run hold.

    Attributes
    ----------
    program : str
        Who recorded them.
    records : (n,) array of `tick_record.RECORD`
        Ticks by number, each once.
    tails : dict
        Commands and ended tasks by tick.
    estimates : dict
        Shape estimates by time.
    damage : list of str
        What could not be read, one line a place.
    """

    program: str = ""
    records: Records = field(default_factory=lambda: np.empty(0, dtype=RECORD))
    tails: dict[int, bytes] = field(default_factory=dict)
    estimates: dict[float, ShapeEstimate] = field(default_factory=dict)
    damage: list[str] = field(default_factory=list)


def read_inputs(folder: Path) -> Inputs:
    """Read all `inputs-*.bin` of a folder; damage is listed, not raised.

    Raises
    ------
    OSError
        A file cannot be read at all.
    """
    found = Inputs()
    parts = []
    for path in sorted(folder.glob("inputs-*.bin")):
        data = path.read_bytes()
        line, _, _ = data.partition(b"\n")
        try:
            head = json.loads(line)
            same = head["schema"] == SCHEMA and [tuple(f) for f in head["fields"]] == RECORD.descr
        except (ValueError, KeyError, TypeError):
            found.damage.append(f"{path.name}: its first line is not readable")
        else:
            if not same:
                found.damage.append(f"{path.name}: {head['schema']} of {head.get('program')}: other fields than ours")
                continue
            found.program = head["program"]
        for body in _frames(data, path.name, found.damage):
            parts.append(_take_frame(body, found))
    if parts:
        every = np.concatenate(parts)
        _, first = np.unique(every["tick"], return_index=True)  # a recorder that went on repeats a second at most
        found.records = every[first]
    return found


def _frames(data: bytes, name: str, damage: list[str]) -> Iterator[bytes]:
    """Bodies of all whole frames; between them anything may lie."""
    place = data.find(_MAGIC)
    end = place
    while place >= 0:
        if place > end:
            damage.append(f"{name}: {place - end} bytes at {end} are not readable")
        body = _frame_at(data, place)
        if body is None:
            following = data.find(_MAGIC, place + 1)
            stop = following if following >= 0 else len(data)
            damage.append(f"{name}: {stop - place} bytes at {place} are not readable")
            place = end = following
            continue
        packed_bytes = _HEAD.unpack_from(data, place)[1]
        yield body
        end = place + _HEAD.size + packed_bytes
        place = data.find(_MAGIC, end)
        if place < 0 and end < len(data):
            damage.append(f"{name}: {len(data) - end} bytes at {end} are not readable")


def _frame_at(data: bytes, place: int) -> bytes | None:
    if place + _HEAD.size > len(data):
        return None
    _, length, crc = _HEAD.unpack_from(data, place)
    packed = data[place + _HEAD.size : place + _HEAD.size + length]
    if len(packed) < length or zlib.crc32(packed) != crc:
        return None
    return zlib.decompress(packed)


def _take_frame(body: bytes, found: Inputs) -> Records:
    (count,) = _COUNT.unpack_from(body)
    place = _COUNT.size + count * RECORD.itemsize
    columns = np.frombuffer(body[_COUNT.size : place], dtype="u1").reshape(RECORD.itemsize, count)
    columns = np.bitwise_xor.accumulate(columns, axis=1)
    records: Records = np.ascontiguousarray(columns.T).view(RECORD).reshape(count)
    while place < len(body):
        kind, tick, length = _PART.unpack_from(body, place)
        data = body[place + _PART.size : place + _PART.size + length]
        place += _PART.size + length
        if kind == _TAIL:
            found.tails[tick] = data
        else:
            estimate = unpack_estimate(data)
            found.estimates[estimate.time_s] = estimate
    return records
