"""The guided session of commissioning for viewers of the page: starts it, follows it, answers it.

The session is a program of its own, the same that runs in a terminal, and it resumes sessions of
either; under systemd, one at the bench is a unit of its own (`session_links`). Each question has a
number, and an answer names it: an answer to an earlier question is refused, so a reload or a second
click never confirms twice. If the service ends, the session notices the end of its input and stops
safely.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from membrane_ctrl.commissioning.guide.dialogue import StageHead, StageProgress
from membrane_ctrl.commissioning.guide.session_messages import (
    MESSAGES,
    AnswerMessage,
    CheckMessage,
    EndMessage,
    LineMessage,
    PlanMessage,
    QuestionMessage,
    SessionMessage,
    StageMessage,
)
from membrane_ctrl.commissioning.guide.session_state import read_state
from membrane_ctrl.model import errors, files, terminal
from membrane_ctrl.service.hold_starter import is_configuration_name
from membrane_ctrl.service.session_links import (
    SESSION_SOCKET,
    ProgramLink,
    SessionLink,
    UnitLink,
)

LOG_NAME = "page.log"
_MESSAGES_MOST = 2000  # of one start; a session of a day shows some hundred
_SESSIONS_MOST = 100
_ANSWER_MOST = 1000  # characters
_ENDS_S = 150.0  # a hold lowers nothing, but closes its recording


ShownMessage = StageMessage | LineMessage | CheckMessage


@dataclass(frozen=True, slots=True)
class SessionEntry:
    """A session in the folder."""

    name: str
    simulated: bool
    stages_done: int
    problem: str = ""


@dataclass(frozen=True, slots=True)
class SeenSession:
    """A session at one moment.

    Attributes
    ----------
    name : str
        Of its folder; empty before the first start.
    is_running : bool
    plan : tuple of StageProgress
        All stages.
    stage : StageHead or None
        The present one.
    question : QuestionMessage or None
        The one that waits for its answer.
    messages : tuple
        Heads of stages, lines and checks since the start.
    dropped : int
        Messages before these that are no longer kept.
    ended : str
        How the last start ended; empty while it runs.
    """

    name: str = ""
    is_running: bool = False
    plan: tuple[StageProgress, ...] = ()
    stage: StageHead | None = None
    question: QuestionMessage | None = None
    messages: tuple[ShownMessage, ...] = ()
    dropped: int = 0
    ended: str = ""


class GuidedSession:
    """The session that this service runs, one at a time.

    Make it before the service lowers its priority, which the session must not inherit.

    Parameters
    ----------
    folder : Path
        Of the sessions.
    units : bool
        Whether the service is a unit of systemd, which has no access to devices: a session at the
        bench is another unit then.
    command : sequence of str, optional
        Another program than `membrane-ctrl commission`, for tests.
    unit_socket : Path, optional
        Where systemd listens for that unit.
    """

    def __init__(
        self,
        folder: Path,
        units: bool = False,
        command: Sequence[str] = (),
        unit_socket: Path = SESSION_SOCKET,
    ) -> None:
        self._folder = folder
        self._units = units
        self._unit_socket = unit_socket
        self._command = list(command) or [sys.executable, "-m", "membrane_ctrl", "commission"]
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="guided session")
        self._thread.submit(os.getpid).result()  # the thread keeps the present priority
        self._lock = threading.Lock()
        self._link: SessionLink | None = None
        self._end: EndMessage | None = None
        self._reader: threading.Thread | None = None
        self._seen = SeenSession()

    @property
    def seen(self) -> SeenSession:
        """The session now."""
        with self._lock:
            return self._seen

    def list_sessions(self) -> list[SessionEntry]:
        """Return the sessions of the folder by name."""
        found = []
        with suppress(OSError):
            folders = sorted(path.parent for path in self._folder.glob("*/session.json"))
            found = [_read_entry(each) for each in folders[:_SESSIONS_MOST]]
        return [each for each in found if is_configuration_name(each.name)]

    def find_folder(self, name: str) -> Path:
        """Return the folder of a session. Raises InputError for a name that none can have."""
        path = self._folder / name
        if not is_configuration_name(name) or path.is_symlink():
            raise errors.InputError(f"{name[:80]!r}: not the name of a session")
        return path

    def start(self, name: str, simulated: bool, who: str) -> None:
        """Start a session, or resume the one of that name.

        Parameters
        ----------
        name : str
            Of its folder.
        simulated : bool
            On the emulated bench.
        who : str
            The viewer.

        Raises
        ------
        InputError, DeviceError
            The name is wrong, another session runs, or the program does not start.
        """
        folder = self.find_folder(name)
        self._thread.submit(self._start, name, folder, simulated, who).result()

    def _start(self, name: str, folder: Path, simulated: bool, who: str) -> None:
        with self._lock:
            if self._seen.is_running:
                raise errors.InputError(f"the session {self._seen.name} runs; stop it first")
            link = self._open_link(name, folder, simulated)
            # A thread follows it, so that no viewer waits.
            self._link, self._end = link, None
            self._seen = SeenSession(name, is_running=True)
            self._reader = threading.Thread(
                target=self._follow, args=(link, name, folder), daemon=True
            )
            self._reader.start()
        _log(f"{who} has started the guided session {name}")

    def _open_link(self, name: str, folder: Path, simulated: bool) -> SessionLink:
        """Start the program that a terminal would run, with messages instead of text."""
        if self._units and not simulated:
            return UnitLink(self._unit_socket, name)
        words = [*self._command, str(folder), "--messages"]
        if simulated:
            words.append("--twin")
        with errors.convert_write_errors(folder, errors.DeviceError):
            files.make_folder(folder)
            log = files.fresh_text(folder / LOG_NAME)
        with log:
            return ProgramLink(words, log)

    def answer(self, number: int, text: str, who: str) -> None:
        """Answer a question of the session.

        Parameters
        ----------
        number : int
            Of the question: each is answered once.
        text : str
            The answer.
        who : str
            The viewer.

        Raises
        ------
        InputError
            The question waits no longer, or the answer is too long.
        """
        if len(text) > _ANSWER_MOST:
            raise errors.InputError(f"longer than {_ANSWER_MOST} characters")
        # Two viewers may answer at once: the lock and the number give each question one answer
        with self._lock:
            waiting = self._seen.question
            if waiting is None or waiting.number != number or self._link is None:
                raise errors.InputError("this question has been answered already")
            self._update(question=None)
            given = AnswerMessage(number=number, answer=text)
            self._link.send_line(given.model_dump_json())
            _log(f"{who} answers {waiting.question.key}: {terminal.one_line(text)}")

    def stop(self, who: str) -> None:
        """Stop the session as Ctrl-C does: the pump is off, and it can be resumed."""
        with self._lock:
            if self._link is None or not self._seen.is_running:
                return
            self._link.interrupt()
        _log(f"{who} stops the guided session")

    def close(self) -> None:
        """Stop the session and wait for its end."""
        self.stop("the end of the service")
        if self._reader is not None:
            self._reader.join(_ENDS_S)
        self._thread.shutdown()

    def _follow(self, link: SessionLink, name: str, folder: Path) -> None:
        """Take the messages of a session until it ends; on a thread of its own."""
        with suppress(OSError):
            for line in link.source:
                try:
                    message = MESSAGES.validate_json(line)
                except ValidationError:  # of a newer program, or a line that a library prints
                    continue
                with self._lock:
                    self._take_message(message)
        code = link.close()
        with self._lock:
            ended = _describe_end(code, self._end, name, folder)
            self._update(question=None, is_running=False, ended=ended)

    def _take_message(self, message: SessionMessage) -> None:
        match message:
            case EndMessage():
                self._end = message
            case PlanMessage():
                self._update(plan=message.plan)
            case QuestionMessage():
                self._update(question=message)
            case StageMessage():
                self._update(stage=message.stage)
                self._keep_message(message)
            case _:
                self._keep_message(message)

    def _keep_message(self, message: ShownMessage) -> None:
        kept = (*self._seen.messages, message)
        surplus = max(0, len(kept) - _MESSAGES_MOST)
        self._update(messages=kept[surplus:], dropped=self._seen.dropped + surplus)

    def _update(self, **changed: Any) -> None:
        self._seen = replace(self._seen, **changed)


def _read_entry(folder: Path) -> SessionEntry:
    try:
        state = read_state(folder)
    except errors.InputError as error:
        return SessionEntry(folder.name, False, 0, str(error))
    if state is None:
        return SessionEntry(folder.name, False, 0, "removed")
    return SessionEntry(folder.name, state.simulated, len(state.records))


def _describe_end(code: int | None, end: EndMessage | None, name: str, folder: Path) -> str:
    """How a session ended, for people.

    Parameters
    ----------
    code : int or None
        Of the program, where this process started it.
    end : EndMessage or None
        The session's last message; None if it ended without one.
    name : str
    folder : Path
        Of the session.
    """
    if code is None and end is None:
        seen = "another one may run; `journalctl -u 'membrane-commission@*'` has its output"
        return f"{name}: ended without a message: {seen}"
    match code if end is None else end.code:
        case errors.Exit.DONE:
            return f"{name}: accepted; the report is below"
        case errors.Exit.REJECTED:
            return f"{name}: not accepted; the report states the reasons"
        case errors.Exit.INTERRUPTED:
            return f"{name}: stopped; start it again to resume it, here or in a terminal"
    if end is not None:
        return f"{name}: {terminal.one_line(end.problem)}"
    return f"{name}: ended with code {code}: {_read_last_line(folder)}"


def _read_last_line(folder: Path) -> str:
    """The last line that a session's program printed beside its messages."""
    lines: list[str] = []
    with suppress(OSError):
        text = (folder / LOG_NAME).read_text(encoding="utf-8", errors="replace")
        lines = text.strip().splitlines()
    return terminal.one_line(lines[-1]) if lines else "no message"


def _log(text: str) -> None:
    print(f"membrane-ctrl serve: {text}", file=sys.stderr, flush=True)
