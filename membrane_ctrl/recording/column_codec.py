"""Tick records as columns that zlib can make something of, and back to the last bit.

A column whose values are short decimals (a device counts in tenths of a micrometre, and 12.3 is the double nearest
to 123 / 10) goes as the differences of those whole numbers; any other as the exclusive or with the tick before. Of
either the bytes are sorted by their place: the first of all ticks, then the second.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_AS_IT_IS = 255
_DIGITS_MAX = 6


def encode_columns(records: NDArray[np.void]) -> bytes:
    """(n,) records as bytes: for each field its code (digits, or 255) and its column."""
    if not len(records):
        return b""
    return b"".join(_encode(np.ascontiguousarray(records[name])) for name in records.dtype.names or ())


def decode_columns(data: bytes, kind: np.dtype[np.void], count: int) -> tuple[NDArray[np.void], int]:
    """(count,) records of a kind, and how many bytes of `data` they took. Raises ValueError if there are too few."""
    # before the memory is taken: a count may be anything
    if count * sum(min(4, kind[name].itemsize) for name in kind.names or ()) > len(data):
        raise ValueError(f"{count} ticks are said to be in {len(data)} bytes")
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


def _decode(code: int, data: bytes, field: np.dtype[Any], count: int) -> NDArray[Any]:
    width = 4 if code != _AS_IT_IS else field.itemsize
    planes = np.frombuffer(data, dtype="u1").reshape(width, count).T
    if code == _AS_IT_IS:
        return np.ascontiguousarray(np.bitwise_xor.accumulate(planes, axis=0)).view(field).reshape(count)
    steps = np.ascontiguousarray(planes).view("<i4").reshape(count)
    decoded: NDArray[Any] = np.cumsum(steps, dtype=np.int64) / 10.0**code
    return decoded


def _same(values: NDArray[Any], column: NDArray[Any]) -> bool:
    """To the last bit: minus zero is not zero."""
    return bool(np.array_equal(values.view("<u8"), column.view("<u8")))


def _by_place(values: NDArray[Any]) -> bytes:
    return np.ascontiguousarray(values.view("u1").reshape(len(values), -1).T).tobytes()
