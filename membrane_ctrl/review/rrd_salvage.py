"""What is whole of a Rerun segment that Rerun refuses: cut anywhere, or damaged within.

Rerun reads a file to its first fault, and of one that is cut short nothing. Here the messages that are whole are
copied to a temporary file and read from there; if one of them does not decode, halves are tried until it is alone.
The segment itself is only read.
"""

from __future__ import annotations

import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from rerun.chunk import Chunk, RrdReader

from membrane_ctrl.recording.atomic import open_plain
from membrane_ctrl.recording.segment_bounds import END, HEAD_BYTES, Message, panics_are_faults, require_bounded
from membrane_ctrl.review.rrd_place import STORE, whole_messages

# Rerun's ways to say that something cannot be read.
FAULTS = (RuntimeError, ValueError, OSError)
# A disk's bad sector spoils a message or two; of a file spoiled all over, no more is looked for.
_FAULTS_MAX = 50


def read_chunks(path: Path, entities: set[str]) -> list[Chunk]:
    """Chunks of some entities. Raises one of `FAULTS` if Rerun refuses the file."""
    require_bounded(path)
    with warnings.catch_warnings(), panics_are_faults():
        warnings.simplefilter("ignore")  # the reader's way to say that a file has no footer
        return [chunk for chunk in RrdReader(path).stream() if chunk.entity_path in entities]


def salvage(path: Path, entities: set[str]) -> tuple[list[Chunk], int]:
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
    stores: list[Message]  # without them Rerun takes no other
    entities: set[str]
    lost_bytes: int = 0
    faults: int = 0

    def chunks(self, part: list[Message]) -> list[Chunk]:
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
