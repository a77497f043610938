"""The fault that outlives its run: written at a trip, respected at the next start, cleared by a person.

One file beside the run folders. It is written without waiting for the disk (a tick has no time for that) and
replaced as a whole, so that a reader sees the old one or the new one; one that cannot be read counts as a fault.
"""

import contextlib
import json
import os
from dataclasses import asdict, dataclass
from datetime import datetime, timedelta
from pathlib import Path

NAME = "latched-fault.json"
SCHEMA = "membrane-latched-fault/1"
RESUMES_NAME = "resumes.json"
_DAY_S = 86_400.0
_RESUMES_MOST = 1000  # of a day, as `resume.most_per_day` takes at most
# More than a fault takes; the least that a disk gives.
_RESERVE_BYTES = 4096
# The room that an earlier run reserved is kept. A link in its place is not followed, for a pipe is not waited.
_IN_PLACE = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
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
    """The file in a folder of runs."""

    def __init__(self, logs_dir: Path) -> None:
        self.path = logs_dir / NAME
        self._reserve = logs_dir / f".{NAME}.reserve"

    def read(self) -> LatchedFault | None:
        """The latched fault, None if there is none. Never raises: what cannot be read is latched."""
        try:
            content = _content(self.path)
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
        self._fill(text.encode())
        self._reserve.replace(self.path)
        with contextlib.suppress(OSError):
            self.reserve()

    def add(self, fault: LatchedFault) -> None:
        """Latch, unless something is latched already: the first cause is the one that is told. Raises OSError."""
        if self.read() is None:
            self.write(fault)

    def reserve(self) -> None:
        """Take the room for a fault while there is some: one on a full disk is latched as well. Raises OSError."""
        self._fill(bytes(_RESERVE_BYTES))

    def _fill(self, content: bytes) -> None:
        """Write to the reserve, in the room that it has. What stands in its place and is no file goes."""
        try:
            number = os.open(self._reserve, _IN_PLACE, 0o644)
        except OSError:
            self._reserve.unlink()
            number = os.open(self._reserve, _IN_PLACE, 0o644)
        with os.fdopen(number, "r+b") as file:
            file.write(content)
            file.truncate()

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

    def _unreadable(self, why: str) -> LatchedFault:
        return LatchedFault(
            "unreadable", f"{self.path} cannot be read", why, "look at the last run", "unknown time", "unknown"
        )


class ResumeLog:
    """When faults have cleared by themselves, so that a restart does not begin the day's number anew.

    Parameters
    ----------
    logs_dir : Path
        Where run folders go.
    """

    def __init__(self, logs_dir: Path) -> None:
        self.path = logs_dir / RESUMES_NAME

    def ages_s(self, now: datetime) -> tuple[float, ...]:
        """How long ago those of the last day were, oldest first. Never raises: what cannot be read counts as full."""
        try:
            content = _content(self.path)
            stamps = [] if content is None else json.loads(content)
            ages_s = [(now - datetime.fromisoformat(stamp)).total_seconds() for stamp in stamps]
        except (OSError, ValueError, TypeError, RecursionError):
            return (0.0,) * _RESUMES_MOST
        # one from the future (the clock was set back) counts as just now
        return tuple(sorted((max(0.0, age_s) for age_s in ages_s if age_s < _DAY_S), reverse=True))

    def add(self, when: datetime) -> None:
        """Count one; those older than a day are left out. Raises OSError."""
        kept = [when - timedelta(seconds=age_s) for age_s in self.ages_s(when)][-_RESUMES_MOST:]
        scratch = self.path.with_name(f".{self.path.name}.new")
        scratch.write_text(json.dumps([stamp.isoformat() for stamp in (*kept, when)]) + "\n", encoding="utf-8")
        scratch.replace(self.path)


def _content(path: Path) -> bytes | None:
    """What is there; None if nothing is, not even a link whose aim is gone. Raises OSError or ValueError."""
    try:
        path.lstat()
    except FileNotFoundError:
        return None
    if not path.is_file():  # of a pipe the first byte would be waited for
        raise ValueError("no file")
    with path.open("rb") as file:
        content = file.read(_MOST_BYTES + 1)
    if len(content) > _MOST_BYTES:
        raise ValueError(f"longer than {_MOST_BYTES} bytes")
    return content
