"""Where the messages of a Rerun recording begin, so that a reader may leave out a part of it.

A file is a head of 12 bytes, `RRF2`, version, options, and messages: kind and length (64-bit little endian each),
then so many bytes (rerun's `re_log_encoding`, file format 2). Each message is whole in itself.
"""

from __future__ import annotations

import struct
from pathlib import Path

_MAGIC, _HEAD_BYTES = b"RRF2", 12
_MESSAGE = struct.Struct("<QQ")
_END = 0  # the last message of a file that was closed; a table of contents follows
_KINDS = range(8)  # four are in use; a larger number is no kind but a place that was missed


def first_message_after(path: Path, place: int) -> int:
    """Where the first message at or behind `place` begins, the last one's end at most; 0 for another form of file."""
    with path.open("rb") as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            return 0
        at = _HEAD_BYTES
        while at < place:
            file.seek(at)
            head = file.read(_MESSAGE.size)
            if len(head) < _MESSAGE.size:
                break
            kind, length = _MESSAGE.unpack(head)
            if kind == _END:
                break
            if kind not in _KINDS:
                return 0
            at += _MESSAGE.size + length
    return at
