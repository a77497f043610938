"""Which process sends the alarms of a run, and what was sent: two files in the run's folder.

Several processes can send: the service, and the alarm process of the hold. One of them is the
*sender*. It holds a lock on `alarms.lock`, which ends with the process, and writes the time into
that file while it works; a sender that has not done so for `STALE_S` hangs and is replaced.

`alarms.jsonl` has a line for each sender and for each attempt to send a message. A new sender reads
it first, so a message is sent once. Before each message a sender checks that no other has taken its
place. Only if a sender dies or hangs between sending a message and recording it, the next one sends
it again: a lost alarm would be worse.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import math
import os
import secrets
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from membrane_ctrl.alarms.book import AlarmMessage, SentMessage
from membrane_ctrl.model import plain_json

LOG_NAME = "alarms.jsonl"
LOCK_NAME = "alarms.lock"
STALE_S = 75.0  # a message to a list of services takes 60 s at most
_LOG_BYTES_MAX = 16_000_000
_STAMP_BYTES_MAX = 64
_TEXT_FIELDS = ("kind", "name", "severity", "text")

Line = dict[str, Any]


class SentLog:
    """The two files, for one process.

    Parameters
    ----------
    folder : Path
        Of the run.
    by : str
        Kind of process, for the record: `hold` or `service`.

    Raises
    ------
    OSError
        The files cannot be opened or made.
    """

    def __init__(self, folder: Path, by: str) -> None:
        self._by = by
        self._token = secrets.token_hex(8)
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
        self._log = os.open(folder / LOG_NAME, flags | os.O_APPEND, 0o644)
        try:
            self._lock = os.open(folder / LOCK_NAME, flags, 0o644)
        except OSError:
            os.close(self._log)
            raise
        self._read_bytes = 0
        self._rest = b""
        self._entries: list[Line] = []
        self._shown = 0
        self._is_torn = False  # the file's last line
        self._is_sender = False

    def close(self) -> None:
        """Close both files; another process may become the sender."""
        os.close(self._lock)
        os.close(self._log)

    def has_sender(self) -> bool:
        """Whether another process is the sender, and works."""
        if self._try_lock():
            self._unlock()
            return False
        return time.monotonic() - self._read_stamp() < STALE_S

    def become_sender(self) -> None:
        """Become the sender. The caller has checked that there is none."""
        self._try_lock()  # a sender that hangs keeps its lock
        self.note_work()
        self._read_new_lines()
        self._append({"sender": self._token, "by": self._by})
        self._read_new_lines()
        self._is_sender = True

    def is_sender(self) -> bool:
        """Whether this process is the sender: no other has become it since."""
        if not self._is_sender:
            return False
        self._read_new_lines()
        for entry in reversed(self._entries):
            if "sender" in entry:
                self._is_sender = entry["sender"] == self._token
                break
        if self._is_sender:
            self._try_lock()  # one that hung when this process took its place may have ended
        else:
            self._unlock()
        return self._is_sender

    def note_work(self) -> None:
        """State that the sender works."""
        with contextlib.suppress(OSError):
            os.pwrite(self._lock, f"{time.monotonic():016.3f}\n".encode(), 0)

    def note_attempt(self, message: AlarmMessage, to: str, at_s: float, accepted: bool) -> None:
        """Record an attempt to send a message.

        Parameters
        ----------
        message : AlarmMessage
            That was sent, or not.
        to : str
            Name of the list of services.
        at_s : float
            Second of the run.
        accepted : bool
            Whether a service of the list accepted it.
        """
        fields = asdict(message)
        if math.isnan(message.condition_s):
            fields["condition_s"] = None
        self._append({**fields, "to": to, "at_s": round(at_s, 3), "sent": accepted, "by": self._by})

    def read_sent(self) -> list[SentMessage]:
        """Return the messages that were accepted, oldest first."""
        self._read_new_lines()
        found = [_parse_sent(line) for line in self._entries if line.get("sent") is True]
        return [each for each in found if each is not None]

    def was_sent(self, message: AlarmMessage, to: str) -> bool:
        """Whether a message was accepted before, sent by whichever process.

        Parameters
        ----------
        message : AlarmMessage
            Compared by name, kind and occurrence. A reminder may be sent again: False.
        to : str
            Key of the configuration that names the list of services.
        """
        if message.kind == "reminder":
            return False
        return any(
            each.to == to
            and each.message.name == message.name
            and each.message.kind == message.kind
            and each.message.occurrence == message.occurrence
            for each in self.read_sent()
        )

    def take_attempts(self) -> list[Line]:
        """Return the recorded attempts of all senders since the last call."""
        self._read_new_lines()
        new = [entry for entry in self._entries[self._shown :] if "sent" in entry]
        self._shown = len(self._entries)
        return new

    def _try_lock(self) -> bool:
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True

    def _unlock(self) -> None:
        fcntl.flock(self._lock, fcntl.LOCK_UN)

    def _read_stamp(self) -> float:
        """Return when the sender has last stated that it works; -inf if it never has."""
        try:
            return float(os.pread(self._lock, _STAMP_BYTES_MAX, 0))
        except (OSError, ValueError):
            return -math.inf

    def _append(self, line: Line) -> None:
        """Write a line; on a full disk keep it in memory only: the alarm matters more."""
        # A line that a full disk has cut gets its end first, so that it spoils no other line.
        data = json.dumps(line).encode() + b"\n"
        if self._is_torn:
            data = b"\n" + data
        try:
            written = os.write(self._log, data)
        except OSError:
            written = 0
        was_cut = 0 < written < len(data)
        nothing_written = written == 0
        self._is_torn = was_cut or (self._is_torn and nothing_written)
        if written < len(data):
            self._entries.append(line)

    def _read_new_lines(self) -> None:
        with contextlib.suppress(OSError):
            while self._read_bytes < _LOG_BYTES_MAX:
                data = os.pread(self._log, 65_536, self._read_bytes)
                if not data:
                    return
                self._read_bytes += len(data)
                *complete, self._rest = (self._rest + data).split(b"\n")
                self._entries += [line for line in map(_parse_line, complete) if line is not None]


def _parse_line(data: bytes) -> Line | None:
    """Return a line of the file; None for anything else, such as a line torn by a full disk."""
    try:
        line = plain_json.loads(data.decode())
    except ValueError:
        return None
    return line if isinstance(line, dict) else None


def _parse_sent(line: Line) -> SentMessage | None:
    """Return the message of a line; None if it is damaged."""
    texts: dict[str, Any] = {name: line.get(name) for name in _TEXT_FIELDS}
    at_s, occurrence = line.get("at_s"), line.get("occurrence")
    if not all(isinstance(text, str) for text in texts.values()):
        return None
    if not isinstance(at_s, int | float) or not isinstance(occurrence, int):
        return None
    condition_s = line.get("condition_s")
    message = AlarmMessage(
        **texts,
        escalated=line.get("escalated") is True,
        occurrence=occurrence,
        condition_s=float(condition_s) if isinstance(condition_s, int | float) else math.nan,
    )
    return SentMessage(message, str(line.get("to")), float(at_s))
