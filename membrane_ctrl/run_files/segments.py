"""Finds the messages of a Rerun segment, and computes their memory needs before allocating any.

A file has a header of 12 bytes (`RRF2`, version, options) and messages: kind and length (64-bit little endian each),
then that many bytes (rerun's `re_log_encoding`, file format 2). Each message is self-contained.
"""

import contextlib
import errno
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from membrane_ctrl.model.files import open_plain

HEAD_BYTES = 12
MAGIC = b"RRF2"
_MESSAGE = struct.Struct("<QQ")
END = 0  # the last message of a closed file; a table of contents follows
_DATA = 2
KINDS = range(8)  # four are in use; a larger number means a wrong position
# A chunk is a second of an entity, a thumbnail or a map: a few hundred kilobytes.
_MESSAGE_BYTES_MAX = 64_000_000
# An hour at 200 Hz holds 0.5 GB of numbers.
_SEGMENT_BYTES_MAX = 700_000_000
MESSAGES_MAX = 1_000_000
_LOOK_BYTES = 65_536  # the fields before a message's data take a hundred
_PLACE_MAX = 1 << 62  # no file is this large
_BYTES = 2  # the kind of a field that has a length
_UNCOMPRESSED_SIZE = 3 << 3  # field 3, a number


@dataclass(frozen=True, slots=True)
class SegmentMessage:
    """A message's position in its file, including kind and length."""

    kind: int
    start: int
    end: int

    @property
    def size(self) -> int:
        """Size in bytes."""
        return self.end - self.start


def heads(file: BinaryIO) -> Iterator[SegmentMessage]:
    """Each message up to the end, as the file claims, true or not."""
    at = HEAD_BYTES
    while True:
        file.seek(at)
        head = file.read(_MESSAGE.size)
        if len(head) < _MESSAGE.size:
            return
        kind, length = _MESSAGE.unpack(head)
        message = SegmentMessage(kind, at, at + _MESSAGE.size + length)
        yield message
        if kind == END or message.end > _PLACE_MAX:
            return
        at = message.end


@contextlib.contextmanager
def panics_are_faults() -> Iterator[None]:
    """Turn a panic in Rerun's code, which is not an `Exception` in Python, into a `RuntimeError`."""
    try:
        yield
    except BaseException as error:
        if type(error).__name__ != "PanicException":
            raise
        raise RuntimeError(f"Rerun failed on it ({str(error)[:80]})") from None


def require_bounded(path: Path) -> None:
    """Check a segment before Rerun, which allocates whatever memory a message requests.

    Raises OSError (not a regular file, or one that would inflate to more than a recorder writes).
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
        raise _too_large(path, f"{rest / 1e6:.0f} MB outside any message")


def _too_large(path: Path, what: str) -> OSError:
    return OSError(errno.EFBIG, f"{what}, which no recorder writes", str(path))


def _inflated_bytes(message: bytes) -> int:
    """Inflated size of a message's data, from its field `uncompressed_size`, else its own size.

    A protocol buffer: each field is a key and a number, or a key, a length and that many bytes. The data come last.
    """
    place, stated = 0, len(message)
    while place < len(message):
        key, place = _varint(message, place)
        value, place = _varint(message, place)
        if key == _UNCOMPRESSED_SIZE:
            stated = max(stated, value)
        elif key & 7 == _BYTES:
            place += value
        elif key & 7:  # neither a number nor bytes: not written by Rerun
            break
    return stated


def _varint(data: bytes, place: int) -> tuple[int, int]:
    """A number of seven bits per byte, and its end."""
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


# Finds the messages of a Rerun recording, so that a reader may skip a part of it.


STORE = 1  # the recording or blueprint to which the following messages belong
_FOOTER_BYTES = 32  # after the last message: the position of the table of contents


def first_message_after(path: Path, place: int) -> int:
    """Start of the first message at or after `place`, at most the last one's end; 0 for another kind of file."""
    at = HEAD_BYTES
    with open_plain(path) as file:
        if file.read(len(MAGIC)) != MAGIC:
            return 0
        for message in heads(file):
            if at >= place or message.kind == END:
                break
            if message.kind not in KINDS:
                return 0
            at = message.end
    return at


def whole_messages(path: Path) -> list[SegmentMessage]:
    """The complete messages of a file, up to its end or to the first invalid one. Raises OSError.

    A message larger than a recorder writes is invalid: a sparse file may claim a terabyte.
    """
    size = min(path.stat().st_size, _SEGMENT_BYTES_MAX)
    found: list[SegmentMessage] = []
    with open_plain(path) as file:
        if file.read(len(MAGIC)) != MAGIC:
            return found
        for message in heads(file):
            if message.kind not in KINDS or message.end > size or message.size > _MESSAGE_BYTES_MAX:
                break
            if len(found) > MESSAGES_MAX:
                break
            found.append(message)
    return found


def ending(path: Path) -> tuple[bool, int]:
    """Whether consecutive messages reach the end of a closed file, and else the bytes after the last complete one.

    Does not read the content of messages. Rerun takes a file that ends between two messages, or within the head of
    one, as whole. Raises OSError.
    """
    found, size = whole_messages(path), path.stat().st_size
    behind = size - (found[-1].end if found else 0)
    closed = bool(found) and found[-1].kind == END and behind == _FOOTER_BYTES
    return closed, 0 if closed else behind


# Rerun's errors for unreadable data.
FAULTS = (RuntimeError, ValueError, OSError)
