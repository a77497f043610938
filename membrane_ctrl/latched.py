"""The fault that outlives its run: written at a trip, respected at the next start, cleared by a person.

One file beside the run folders. It is written without waiting for the disk (a tick has no time for that) and
replaced as a whole, so that a reader sees the old one or the new one; one that cannot be read counts as a fault.
"""

from __future__ import annotations

import contextlib
import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path

NAME = "latched-fault.json"
SCHEMA = "membrane-latched-fault/1"
# More than a fault takes; the least that a disk gives.
_RESERVE_BYTES = 4096
_MOST_BYTES = 65536  # a longer file is none of ours, and is not read to its end


@dataclass(frozen=True, slots=True)
class LatchedFault:
    """What tripped, when, and where it is recorded."""

    name: str
    cause: str
    seen: str
    remedy: str
    time_utc: str
    run: str

    def __str__(self) -> str:
        """For one line."""
        seen = f" ({self.seen})" if self.seen else ""
        return " ".join(f"{self.name}: {self.cause}{seen}, {self.time_utc}, run {self.run}".split())


class LatchedFile:
    """The file in a folder of runs.

    Parameters
    ----------
    logs_dir : Path
        Where run folders go.
    """

    def __init__(self, logs_dir: Path) -> None:
        self.path = logs_dir / NAME
        self._reserve = logs_dir / f".{NAME}.reserve"

    def read(self) -> LatchedFault | None:
        """The latched fault, None if there is none. Never raises: what cannot be read is latched."""
        try:
            content = self._content()
            if content is None:
                return None
            table = json.loads(content)
            if table.pop("schema") != SCHEMA or not all(isinstance(value, str) for value in table.values()):
                raise ValueError("another schema")
            return LatchedFault(**table)
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            return self._unreadable(f"{type(error).__name__}: {error}")

    def write(self, fault: LatchedFault) -> None:
        """Latch, in place of an older fault. Raises OSError."""
        text = json.dumps({"schema": SCHEMA, **asdict(fault)}, indent=1) + "\n"
        with self._reserve.open("r+b" if self._reserve.exists() else "wb") as file:
            file.write(text.encode())
            file.truncate()
        self._reserve.replace(self.path)
        with contextlib.suppress(OSError):
            self.reserve()

    def add(self, fault: LatchedFault) -> None:
        """Latch, unless something is latched already: the first cause is the one that is told. Raises OSError."""
        if self.read() is None:
            self.write(fault)

    def reserve(self) -> None:
        """Take the room for a fault while there is some: one on a full disk is latched as well. Raises OSError."""
        self._reserve.write_bytes(bytes(_RESERVE_BYTES))

    def release(self) -> None:
        """Give that room back."""
        with contextlib.suppress(OSError):
            self._reserve.unlink(missing_ok=True)

    def sync(self) -> None:
        """Wait until it is on the disk, power cut or not; for the end of a run. Raises OSError."""
        if not self.path.exists():
            return
        for path in (self.path, self.path.parent):
            number = os.open(path, os.O_RDONLY)
            try:
                os.fsync(number)
            finally:
                os.close(number)

    def clear(self) -> None:
        """A person has looked at it, or the resume rule let it go. Raises OSError."""
        self.path.unlink(missing_ok=True)

    def _content(self) -> bytes | None:
        """What is there; None if nothing is, not even a link whose aim is gone. Raises OSError or ValueError."""
        try:
            self.path.lstat()
        except FileNotFoundError:
            return None
        if not self.path.is_file():  # of a pipe the first byte would be waited for
            raise ValueError("no file")
        with self.path.open("rb") as file:
            content = file.read(_MOST_BYTES + 1)
        if len(content) > _MOST_BYTES:
            raise ValueError(f"longer than {_MOST_BYTES} bytes")
        return content

    def _unreadable(self, why: str) -> LatchedFault:
        return LatchedFault(
            "unreadable", f"{self.path} cannot be read", why, "look at the last run", "unknown time", "unknown"
        )
