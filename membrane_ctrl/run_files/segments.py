"""How a Rerun segment is made up of messages, and what one would take of memory, known before any is taken.

A file is a head of 12 bytes, `RRF2`, version, options, and messages: kind and length (64-bit little endian each),
then so many bytes (rerun's `re_log_encoding`, file format 2). Each message is whole in itself.
"""

import contextlib
import errno
import os
import struct
import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from membrane_ctrl.model.files import open_plain

if TYPE_CHECKING:  # a list of runs need not load Rerun
    from rerun.chunk import Chunk

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
class SegmentMessage:
    """A message's place in its file, kind and length among its bytes."""

    kind: int
    start: int
    end: int

    @property
    def size(self) -> int:
        """Bytes."""
        return self.end - self.start


def heads(file: BinaryIO) -> Iterator[SegmentMessage]:
    """Each message up to the end, as the file says it: none of it need be true."""
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


# Where the messages of a Rerun recording begin, so that a reader may leave out a part of it.


STORE = 1  # which recording, or which blueprint, the messages behind it are of
_FOOTER_BYTES = 32  # behind the last message: where its table of contents is


def first_message_after(path: Path, place: int) -> int:
    """Where the first message at or behind `place` begins, the last one's end at most; 0 for another form of file."""
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
    """The messages that a file has in full, up to its end or to where what follows is none. Raises OSError.

    What is larger than a recorder writes is none: a sparse file may claim a terabyte.
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


def is_closed(path: Path) -> bool:
    """Whether messages follow one another to the end of a closed file; what is in them is not looked at.

    Raises
    ------
    OSError
    """
    found = whole_messages(path)
    return bool(found) and found[-1].kind == END and path.stat().st_size == found[-1].end + _FOOTER_BYTES


# What is whole of a Rerun segment that Rerun refuses: cut anywhere, or damaged within.
#
# Rerun reads a file to its first fault, and of one that is cut short nothing. Here the messages that are whole are
# copied to a temporary file and read from there; if one of them does not decode, halves are tried until it is alone.
# The segment itself is only read.


# Rerun's ways to say that something cannot be read.
FAULTS = (RuntimeError, ValueError, OSError)
# A disk's bad sector spoils a message or two; of a file spoiled all over, no more is looked for.
_FAULTS_MAX = 50


def read_chunks(path: Path, entities: set[str]) -> list["Chunk"]:
    """Chunks of some entities. Raises one of `FAULTS` if Rerun refuses the file."""
    from rerun.chunk import RrdReader

    require_bounded(path)
    with warnings.catch_warnings(), panics_are_faults():
        warnings.simplefilter("ignore")  # the reader's way to say that a file has no footer
        return [chunk for chunk in RrdReader(path).stream() if chunk.entity_path in entities]


def salvage(path: Path, entities: set[str]) -> tuple[list["Chunk"], int]:
    """Chunks of some entities in a segment that Rerun refuses, and how many bytes of it are left out.

    Raises
    ------
    OSError
        If the segment cannot be read, or there is no room for the copy.
    """
    found = whole_messages(path)
    size = path.lstat().st_size
    if not found:
        return [], size
    with tempfile.TemporaryDirectory(prefix="membrane-review-") as folder, open_plain(path) as source:
        stores = [message for message in found if message.kind == STORE]
        copy = _Copy(source, Path(folder) / "whole.rrd", stores, entities)
        chunks = copy.chunks([message for message in found if message.kind not in {STORE, END}])
    behind = 0 if found[-1].kind == END else size - found[-1].end
    return chunks, behind + copy.lost_bytes


@dataclass(slots=True)
class _Copy:
    source: BinaryIO
    path: Path
    stores: list[SegmentMessage]  # without them Rerun takes no other
    entities: set[str]
    lost_bytes: int = 0
    faults: int = 0

    def chunks(self, part: list[SegmentMessage]) -> list["Chunk"]:
        """Chunks of those messages of a part that decode."""
        self.source.seek(0)
        with self.path.open("wb") as file:
            file.write(self.source.read(HEAD_BYTES))
            for message in (*self.stores, *part):
                self.source.seek(message.start)
                file.write(self.source.read(message.size))
        try:
            return read_chunks(self.path, self.entities)
        except FAULTS:
            if len(part) < 2 or self.faults >= _FAULTS_MAX:
                self.faults += 1
                self.lost_bytes += sum(message.size for message in part)
                return []
        half = len(part) // 2
        return self.chunks(part[:half]) + self.chunks(part[half:])
