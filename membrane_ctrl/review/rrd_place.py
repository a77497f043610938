"""Where the messages of a Rerun recording begin, so that a reader may leave out a part of it."""

from __future__ import annotations

from pathlib import Path

from membrane_ctrl.recording.atomic import open_plain
from membrane_ctrl.recording.segment_bounds import END, HEAD_BYTES, KINDS, MAGIC, MESSAGES_MAX, Message, heads

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


def whole_messages(path: Path) -> list[Message]:
    """The messages that a file has in full, up to its end or to where what follows is none. Raises OSError."""
    size = path.stat().st_size
    found: list[Message] = []
    with open_plain(path) as file:
        if file.read(len(MAGIC)) != MAGIC:
            return found
        for message in heads(file):
            if message.kind not in KINDS or message.end > size or len(found) > MESSAGES_MAX:
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
