"""Where the messages of a Rerun recording begin, so that a reader may leave out a part of it.

A file is a head of 12 bytes, `RRF2`, version, options, and messages: kind and length (64-bit little endian each),
then so many bytes (rerun's `re_log_encoding`, file format 2). Each message is whole in itself.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

HEAD_BYTES = 12
_MAGIC = b"RRF2"
_MESSAGE = struct.Struct("<QQ")
_FOOTER_BYTES = 32  # behind the last message: where its table of contents is
END = 0  # the last message of a file that was closed; a table of contents follows
STORE = 1  # which recording, or which blueprint, the messages behind it are of
_KINDS = range(8)  # four are in use; a larger number is no kind but a place that was missed


@dataclass(frozen=True, slots=True)
class Message:
    """A message's place in its file, kind and length among its bytes."""

    kind: int
    start: int
    end: int

    @property
    def size(self) -> int:
        """Bytes."""
        return self.end - self.start


def first_message_after(path: Path, place: int) -> int:
    """Where the first message at or behind `place` begins, the last one's end at most; 0 for another form of file."""
    at = HEAD_BYTES
    with path.open("rb") as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            return 0
        for message in _heads(file):
            if at >= place or message.kind == END:
                break
            if message.kind not in _KINDS:
                return 0
            at = message.end
    return at


def whole_messages(path: Path) -> list[Message]:
    """The messages that a file has in full, up to its end or to where what follows is none. Raises OSError."""
    size = path.stat().st_size
    found: list[Message] = []
    with path.open("rb") as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            return found
        for message in _heads(file):
            if message.kind not in _KINDS or message.end > size:
                break
            found.append(message)
    return found


def is_closed(path: Path) -> bool:
    """Whether messages follow one another to the end of a closed file; what is in them is not looked at.

    Raises
    ------
    OSError
    """
    found = whole_messages(path)
    return bool(found) and found[-1].kind == END and path.stat().st_size == found[-1].end + _FOOTER_BYTES


def _heads(file: BinaryIO) -> Iterator[Message]:
    """Each message up to the end, as the file says it: none of it need be true."""
    at = HEAD_BYTES
    while True:
        file.seek(at)
        head = file.read(_MESSAGE.size)
        if len(head) < _MESSAGE.size:
            return
        kind, length = _MESSAGE.unpack(head)
        message = Message(kind, at, at + _MESSAGE.size + length)
        yield message
        if kind == END:
            return
        at = message.end
