"""Recovers the intact part of a Rerun segment that Rerun refuses: truncated, or damaged within.

Rerun reads a file up to its first fault, and nothing of a truncated one. Here the complete messages are copied to a
temporary file and read from there; if one does not decode, bisection isolates it. The segment itself never changes.
"""

from __future__ import annotations

import tempfile
import time
from collections import OrderedDict
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from membrane_ctrl.model.files import open_plain
from membrane_ctrl.run_files.segment_process import SegmentPart, read_parts
from membrane_ctrl.run_files.segments import END, FAULTS, HEAD_BYTES, STORE, SegmentMessage, whole_messages

# A bad sector destroys a message or two; beyond this, give up on the rest of the file.
_FAULTS_MAX = 50
# For a bisection, each step of which starts a process: then the rest of the file is given up, too.
_BISECTION_S = 60.0
_REMEMBERED = 64  # segments

# Starts of undecodable messages, by file, size and time of change: a report reads a segment several times.
_Key = tuple[str, int, int]
_undecodable: OrderedDict[_Key, frozenset[int]] = OrderedDict()


def salvage(path: Path, entities: set[str]) -> tuple[list[SegmentPart], int]:
    """Numbers of some entities in a segment that Rerun refuses, and the number of bytes lost.

    Raises OSError if the segment is unreadable, or there is no room for the copy.
    """
    found = whole_messages(path)
    status = path.lstat()
    if not found:
        return [], status.st_size
    key = (str(path.resolve()), status.st_size, status.st_mtime_ns)
    known = _undecodable.get(key, frozenset())
    with tempfile.TemporaryDirectory(prefix="membrane-review-") as folder, open_plain(path) as source:
        stores = [message for message in found if message.kind == STORE]
        copy = _Copy(source, Path(folder) / "whole.rrd", stores, entities, time.monotonic() + _BISECTION_S)
        data = [message for message in found if message.kind not in {STORE, END}]
        copy.lose([message for message in data if message.start in known])
        parts = copy.parts([message for message in data if message.start not in known])
    _remember(key, known | copy.lost)
    behind = 0 if found[-1].kind == END else status.st_size - found[-1].end
    return parts, behind + copy.lost_bytes


def _remember(key: _Key, lost: frozenset[int]) -> None:
    _undecodable[key] = lost
    _undecodable.move_to_end(key)
    if len(_undecodable) > _REMEMBERED:
        _undecodable.popitem(last=False)


@dataclass(slots=True)
class _Copy:
    source: BinaryIO
    path: Path
    stores: list[SegmentMessage]  # without them Rerun accepts no others
    entities: set[str]
    until_s: float  # of the bisection
    lost_bytes: int = 0
    faults: int = 0
    lost: set[int] = field(default_factory=set)

    def lose(self, part: list[SegmentMessage]) -> None:
        """Count messages as lost."""
        self.lost_bytes += sum(message.size for message in part)
        self.lost |= {message.start for message in part}

    def parts(self, part: list[SegmentMessage]) -> list[SegmentPart]:
        """Numbers of a part's decodable messages."""
        self.source.seek(0)
        with self.path.open("wb") as file:
            file.write(self.source.read(HEAD_BYTES))
            for message in (*self.stores, *part):
                self.source.seek(message.start)
                file.write(self.source.read(message.size))
        try:
            return read_parts(self.path, self.entities)
        except FAULTS:
            if len(part) < 2 or self.faults >= _FAULTS_MAX or time.monotonic() > self.until_s:
                self.faults += 1
                self.lose(part)
                return []
        half = len(part) // 2
        return self.parts(part[:half]) + self.parts(part[half:])
