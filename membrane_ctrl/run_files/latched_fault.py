"""A fault that outlives its run: written at a trip, respected at the next start, cleared by a
person.

One file beside the run folders. It is written without waiting for the disk (a tick has no time for
that) and replaced atomically, so that a reader sees the old or the new one; an unreadable file
counts as a fault.
"""

import contextlib
import json
import os
from dataclasses import asdict, dataclass
from datetime import datetime, timedelta
from pathlib import Path

from membrane_ctrl.model.program import file_origin, remove_origin

NAME = "latched-fault.json"
SCHEMA = "membrane-latched-fault/1"
RESUMES_NAME = "resumes.json"
RESUMES_SCHEMA = "membrane-resumes/1"
_DAY_S = 86_400.0
_RESUMES_MOST = 1000  # per day, the upper limit of `resume.most_per_day`
# More than a fault takes; the smallest unit of a disk.
_RESERVE_BYTES = 4096
# Keeps the room that an earlier run reserved. Does not follow links or wait for pipes.
_IN_PLACE = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
_MOST_BYTES = 65536  # a longer file is not ours, and is not read to its end


@dataclass(frozen=True, slots=True)
class LatchedFault:
    """What tripped, when, and the run that recorded it."""

    name: str
    cause: str
    seen: str
    remedy: str
    time_utc: str
    run: str

    def __str__(self) -> str:
        """The fault as one line."""
        seen = f" ({self.seen})" if self.seen else ""
        return " ".join(f"{self.name}: {self.cause}{seen}, {self.time_utc}, run {self.run}".split())


class LatchedFile:
    """The file in a folder of runs."""

    def __init__(self, logs_dir: Path) -> None:
        self.path = logs_dir / NAME
        self._reserve = logs_dir / f".{NAME}.reserve"

    def read(self) -> LatchedFault | None:
        """Read the latched fault, None if there is none. Never raises: an unreadable file counts as
        latched.
        """
        try:
            content = _read_content(self.path)
            if content is None:
                return None
            table = json.loads(content)
            remove_origin(table, SCHEMA)
            if not all(isinstance(value, str) for value in table.values()):
                raise ValueError("a value that is no text")
            return LatchedFault(**table)
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            return self._make_unreadable_fault(f"{type(error).__name__}: {error}")

    def write(self, fault: LatchedFault) -> None:
        """Latch, in place of an older fault. Raises OSError."""
        text = json.dumps({**file_origin(SCHEMA), **asdict(fault)}, indent=1) + "\n"
        self._fill_reserved(text.encode())
        self._reserve.replace(self.path)
        with contextlib.suppress(OSError):
            self.reserve_space()

    def reserve_space(self) -> None:
        """Reserve disk space for a fault, so that one on a full disk latches too.
        Raises OSError.
        """
        self._fill_reserved(bytes(_RESERVE_BYTES))

    def _fill_reserved(self, content: bytes) -> None:
        """Write to the reserved file, in its space. Removes anything in its place that is not a
        file.
        """
        try:
            number = os.open(self._reserve, _IN_PLACE, 0o644)
        except OSError:
            self._reserve.unlink()
            number = os.open(self._reserve, _IN_PLACE, 0o644)
        with os.fdopen(number, "r+b") as file:
            file.write(content)
            file.truncate()

    def release_space(self) -> None:
        """Release that space."""
        with contextlib.suppress(OSError):
            self._reserve.unlink(missing_ok=True)

    def sync(self) -> None:
        """Sync the file so that it survives a power cut; for the end of a run. Raises OSError."""
        if not self.path.exists():
            return
        for path in (self.path, self.path.parent):
            number = os.open(path, os.O_RDONLY)
            try:
                os.fsync(number)
            finally:
                os.close(number)

    def clear(self) -> None:
        """Clear the latch, after a person or the resume rule decided so. Raises OSError."""
        self.path.unlink(missing_ok=True)

    def _make_unreadable_fault(self, why: str) -> LatchedFault:
        return LatchedFault(
            "unreadable",
            f"{self.path} cannot be read",
            why,
            "look at the last run",
            "unknown time",
            "unknown",
        )


class ResumeLog:
    """When faults cleared automatically, so that a restart does not reset the day's count; beside
    the runs.
    """

    def __init__(self, logs_dir: Path) -> None:
        self.path = logs_dir / RESUMES_NAME

    def ages_s(self, now: datetime) -> tuple[float, ...]:
        """Ages of the last day's resumes, oldest first. Never raises: an unreadable file counts as
        full.
        """
        try:
            content = _read_content(self.path)
            stamps = [] if content is None else _read_stamps(content)
            ages_s = [(now - datetime.fromisoformat(stamp)).total_seconds() for stamp in stamps]
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
            return (0.0,) * _RESUMES_MOST
        # a future one (the clock was set back) counts as just now
        return tuple(sorted((max(0.0, age_s) for age_s in ages_s if age_s < _DAY_S), reverse=True))

    def add_resume(self, when: datetime) -> None:
        """Add one and drop those older than a day. Raises OSError."""
        ages_s = self.ages_s(when)
        kept = [when - timedelta(seconds=age_s) for age_s in ages_s[-_RESUMES_MOST:]]
        scratch = self.path.with_name(f".{self.path.name}.new")
        stamps = [stamp.isoformat() for stamp in (*kept, when)]
        table = {**file_origin(RESUMES_SCHEMA), "resumed_utc": stamps}
        scratch.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")
        scratch.replace(self.path)


def _read_stamps(content: bytes) -> list[str]:
    table = json.loads(content)
    remove_origin(table, RESUMES_SCHEMA)
    stamps: list[str] = table["resumed_utc"]
    return stamps


def _read_content(path: Path) -> bytes | None:
    """The content; None if there is nothing, not even a dangling link. Raises OSError or
    ValueError.
    """
    try:
        path.lstat()
    except FileNotFoundError:
        return None
    if not path.is_file():  # reading a pipe would block
        raise ValueError("not a file")
    with path.open("rb") as file:
        content = file.read(_MOST_BYTES + 1)
    if len(content) > _MOST_BYTES:
        raise ValueError(f"longer than {_MOST_BYTES} bytes")
    return content
