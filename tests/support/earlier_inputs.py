"""`inputs-NNN.bin` as the recorder of version 0.1 wrote them: a tick's inputs, a frame a second."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.controller.tick import RECORD, TickBatch
from membrane_ctrl.model.shape_estimate import ShapeEstimate, pack_estimate

_AS_IT_IS = 255
_DIGITS_MAX = 6


def write_inputs(path: Path, batches: list[tuple[TickBatch, list[ShapeEstimate]]]) -> None:
    """Write a file of frames."""
    head = {
        "schema": "membrane-inputs/1",
        "program": "membrane-ctrl 0.1.0",
        "fields": [list(f) for f in RECORD.descr],
    }
    frames = [_packed(batch, shapes) for batch, shapes in batches]
    path.write_bytes(json.dumps(head).encode() + b"\n" + b"".join(frames))


def _packed(batch: TickBatch, shapes: list[ShapeEstimate]) -> bytes:
    parts = [(b"C", tick, tail) for tick, tail in batch.tails.items()]
    parts += [(b"M", tick, memory) for tick, memory in batch.memories.items()]
    parts += [(b"S", 0, pack_estimate(shape)) for shape in shapes]
    body = struct.pack("<I", len(batch.records)) + encode_columns(batch.records)
    body += b"".join(struct.pack("<cqI", kind, tick, len(data)) + data for kind, tick, data in parts)
    packed = zlib.compress(body, 6)
    return struct.pack("<8sII", b"MBRNin01", len(packed), zlib.crc32(packed)) + packed


def encode_columns(records: NDArray[np.void]) -> bytes:
    """(n,) records as bytes: for each field its code (digits, or 255) and its column."""
    if not len(records):
        return b""
    return b"".join(_encode(np.ascontiguousarray(records[name])) for name in records.dtype.names or ())


def _encode(column: NDArray[Any]) -> bytes:
    if column.dtype.kind == "f" and np.isfinite(column).all():
        largest = float(np.abs(column).max())
        for digits in range(_DIGITS_MAX + 1):
            if largest * 10.0**digits >= 2**30:
                break
            whole = np.rint(column * 10.0**digits).astype("<i4")
            if _same(whole / 10.0**digits, column):
                return bytes([digits]) + _by_place(np.diff(whole, prepend=np.int32(0)).astype("<i4"))
    planes = column.view("u1").reshape(len(column), -1)
    return bytes([_AS_IT_IS]) + _by_place(np.vstack((planes[:1], planes[1:] ^ planes[:-1])))


def _same(values: NDArray[Any], column: NDArray[Any]) -> bool:
    """To the last bit: minus zero is not zero."""
    return bool(np.array_equal(values.view("<u8"), column.view("<u8")))


def _by_place(values: NDArray[Any]) -> bytes:
    return np.ascontiguousarray(values.view("u1").reshape(len(values), -1).T).tobytes()
