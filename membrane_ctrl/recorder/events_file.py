"""Writes `events.jsonl`, each line as soon as the event is known."""

import os
from collections import deque
from collections.abc import Sequence
from pathlib import Path

from membrane_ctrl.model.event_lines import from_dict
from membrane_ctrl.model.events import EventLine
from membrane_ctrl.model.file_checksums import dumps_checked

# Events that wait while the disk is full; a fault campaign makes a few hundred.
_WAITING_MAX = 10_000
# A killed recorder saved its progress up to a second earlier: at most this many events may come
# twice.
_TAIL_BYTES = 1_000_000


class EventsFile:
    """Appends events; after a failed write nothing is lost or torn, and the next call continues.

    Parameters
    ----------
    path : Path
        `events.jsonl` of the run; made with the first event.
    resumed : bool
        After a killed recorder: remove a torn last line, and do not repeat existing lines.

    Attributes
    ----------
    lost : int
        Events dropped because too many waited on a full disk.
    """

    def __init__(self, path: Path, resumed: bool = False) -> None:
        self._path = path
        self._written = _repair_tail(path) if resumed else frozenset()
        self._waiting: deque[bytes] = deque()
        self._sync = False
        self._descriptor: int | None = None
        self.lost = 0

    def select_unwritten(self, events: Sequence[EventLine]) -> list[EventLine]:
        """The events that no earlier recorder of the run has written."""
        return [
            event for event in events if dumps_checked(event).encode() + b"\n" not in self._written
        ]

    def append_events(self, events: Sequence[EventLine]) -> None:
        """Write events, after those still waiting. Raises OSError (full disk)."""
        for event in events:
            line = dumps_checked(event).encode() + b"\n"
            if line in self._written:
                continue
            self._waiting.append(line)
            self._sync |= from_dict(event).urgent
        while len(self._waiting) > _WAITING_MAX:
            # the first line may already be half written: keep it, drop the second
            del self._waiting[1]
            self.lost += 1
        self._write_lines()

    def _write_lines(self) -> None:
        if self._waiting and self._descriptor is None:
            self._descriptor = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        while self._waiting and self._descriptor is not None:
            written = os.write(self._descriptor, self._waiting[0])
            rest = self._waiting[0][written:]
            if rest:
                self._waiting[0] = rest
            else:
                self._waiting.popleft()
        if self._sync and self._descriptor is not None:
            os.fsync(self._descriptor)
            self._sync = False

    def restart(self, recent: Sequence[EventLine]) -> None:
        """Start a new file after the old one's removal, with the events written to it meanwhile.
        Raises OSError.
        """
        was_open = self._descriptor is not None  # not opened yet: nothing was lost
        self.close()
        self.append_events(recent if was_open else [])

    def close(self) -> None:
        """Close the file."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def _repair_tail(path: Path) -> frozenset[bytes]:
    """Cut a torn line off the end; return the last whole lines."""
    if not path.exists():
        return frozenset()
    with path.open("r+b") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - _TAIL_BYTES))
        tail = file.read()
        whole = tail[: tail.rfind(b"\n") + 1]
        file.truncate(size - len(tail) + len(whole))
    return frozenset(whole.splitlines(keepends=True))
