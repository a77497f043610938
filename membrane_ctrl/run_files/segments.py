"""Finds the messages of a Rerun segment, so that a live view may skip a part of it.

A file has a header of 12 bytes (`RRF2`, version, options) and messages: kind and length (64-bit
little endian each), then that many bytes (rerun's `re_log_encoding`, file format 2).
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from membrane_ctrl.model.files import open_plain

_HEAD_BYTES = 12
_MAGIC = b"RRF2"
_MESSAGE = struct.Struct("<QQ")
_END = 0  # the last message of a closed file; a table of contents follows
_KINDS = range(8)  # four are in use; a larger number means a wrong position
_PLACE_MAX = 1 << 62  # no file is this large


@dataclass(frozen=True, slots=True)
class SegmentMessage:
    """A message's kind, and its end in the file."""

    kind: int
    end: int


def segments(folder: Path) -> list[Path]:
    """The run's Rerun segments, in order."""
    return sorted(folder.glob("*.rrd"))


def first_message_after(path: Path, place: int) -> int:
    """Start of the first message at or after `place`, at most the last one's end; 0 for another
    kind of file.
    """
    at = _HEAD_BYTES
    with open_plain(path) as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            return 0
        for message in _messages(file):
            if at >= place or message.kind == _END:
                break
            if message.kind not in _KINDS:
                return 0
            at = message.end
    return at


def _messages(file: BinaryIO) -> Iterator[SegmentMessage]:
    """Each message up to the end, as the file claims, true or not."""
    at = _HEAD_BYTES
    while True:
        file.seek(at)
        head = file.read(_MESSAGE.size)
        if len(head) < _MESSAGE.size:
            return
        kind, length = _MESSAGE.unpack(head)
        message = SegmentMessage(kind, at + _MESSAGE.size + length)
        yield message
        if kind == _END or message.end > _PLACE_MAX:
            return
        at = message.end
