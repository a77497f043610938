"""How a Rerun segment is made up of messages, and what one would take of memory, known before any is taken.

A file is a head of 12 bytes, `RRF2`, version, options, and messages: kind and length (64-bit little endian each),
then so many bytes (rerun's `re_log_encoding`, file format 2). Each message is whole in itself.
"""

from __future__ import annotations

import contextlib
import errno
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from membrane_ctrl.recording.atomic import open_plain

HEAD_BYTES = 12
MAGIC = b"RRF2"
_MESSAGE = struct.Struct("<QQ")
END = 0  # the last message of a file that was closed; a table of contents follows
_DATA = 2
KINDS = range(8)  # four are in use; a larger number is no kind but a place that was missed
# A chunk is a second of an entity, a thumbnail or a map: some hundred kilobytes.
_MESSAGE_BYTES_MAX = 64_000_000
# An hour at 200 Hz holds 0.5 GB of numbers.
_SEGMENT_BYTES_MAX = 700_000_000
MESSAGES_MAX = 1_000_000
_LOOK_BYTES = 65_536  # the fields in front of a message's data take a hundred
_PLACE_MAX = 1 << 62  # no file has as many bytes
_BYTES = 2  # the kind of a field that has a length
_UNCOMPRESSED_SIZE = 3 << 3  # field 3, a number


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


def heads(file: BinaryIO) -> Iterator[Message]:
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
        if kind == END or message.end > _PLACE_MAX:
            return
        at = message.end


@contextlib.contextmanager
def panics_are_faults() -> Iterator[None]:
    """Where Rerun's own code gives up on a file, Python gets what is no `Exception`: here it is a `RuntimeError`."""
    try:
        yield
    except BaseException as error:
        if type(error).__name__ != "PanicException":
            raise
        raise RuntimeError(f"Rerun gave up on it ({str(error)[:80]})") from None


def require_bounded(path: Path) -> None:
    """Look at a segment before Rerun does, which takes whatever memory a message asks for.

    Raises
    ------
    OSError
        No plain file, or one that would inflate to more than a recorder writes.
    """
    total = end = 0
    with open_plain(path) as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise OSError(errno.EINVAL, "not a Rerun recording", str(path))
        for number, message in enumerate(heads(file)):
            stated = _inflated_bytes(file.read(min(message.size, _LOOK_BYTES))) if message.kind == _DATA else 0
            total += stated
            end = message.end
            if max(stated, message.size) > _MESSAGE_BYTES_MAX and message.kind in KINDS:
                raise _too_large(path, f"a message of {max(stated, message.size) / 1e6:.0f} MB")
            if total > _SEGMENT_BYTES_MAX or number > MESSAGES_MAX:
                raise _too_large(path, f"more than {_SEGMENT_BYTES_MAX / 1e6:.0f} MB or {MESSAGES_MAX} messages")
        rest = os.fstat(file.fileno()).st_size - end
    if rest > _MESSAGE_BYTES_MAX:
        raise _too_large(path, f"{rest / 1e6:.0f} MB that are no messages")


def _too_large(path: Path, what: str) -> OSError:
    return OSError(errno.EFBIG, f"{what}, which no recorder writes", str(path))


def _inflated_bytes(message: bytes) -> int:
    """What a message's data inflates to, by its field `uncompressed_size`; its own size, if it does not say.

    A protocol buffer: each field a key and a number, or a key, a length and so many bytes. The data comes last.
    """
    place, stated = 0, len(message)
    while place < len(message):
        key, place = _varint(message, place)
        value, place = _varint(message, place)
        if key == _UNCOMPRESSED_SIZE:
            stated = max(stated, value)
        elif key & 7 == _BYTES:
            place += value
        elif key & 7:  # neither a number nor bytes: none of Rerun's
            break
    return stated


def _varint(data: bytes, place: int) -> tuple[int, int]:
    """A number of seven bits a byte, and where it ends."""
    number = 0
    for shift in range(0, 70, 7):
        if place >= len(data):
            break
        byte = data[place]
        place += 1
        number |= (byte & 0x7F) << shift
        if byte < 0x80:
            break
    return number, place
