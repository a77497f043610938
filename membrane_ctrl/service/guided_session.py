"""The guided session of commissioning for viewers of the page: starts it, follows it, answers it.

The session is a program of its own, the same that runs in a terminal, and it resumes sessions of
either. Each question has a number, and an answer names it: an answer to an earlier question is
refused, so a reload or a second click never confirms twice. If the service ends, the session
notices the end of its input and stops safely.
"""

from __future__ import annotations

import os
import signal
import subprocess
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
    LineMessage,
    PlanMessage,
    QuestionMessage,
    SessionMessage,
    StageMessage,
)
from membrane_ctrl.commissioning.guide.session_state import read_state
from membrane_ctrl.model import errors, files, terminal
from membrane_ctrl.service.hold_starter import is_configuration_name

LOG_NAME = "page.log"
_MESSAGES_MOST = 2000  # of one start; a session of a day shows some hundred
_SESSIONS_MOST = 100
_ANSWER_MOST = 1000  # characters
_ENDS_S = 150.0  # a hold lowers nothing, but closes its recording
_UNITS_REFUSAL = (
    "this service runs under systemd without access to devices: run `sudo -u membrane "
    "membrane-ctrl commission FOLDER` in a terminal, or the emulated bench here"
)


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
        Whether the service is a unit of systemd, which has no access to devices.
    command : sequence of str, optional
        Another program than `membrane-ctrl commission`, for tests.
    """

    def __init__(self, folder: Path, units: bool = False, command: Sequence[str] = ()) -> None:
        self._folder = folder
        self._units = units
        self._command = list(command) or [sys.executable, "-m", "membrane_ctrl", "commission"]
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="guided session")
        self._thread.submit(os.getpid).result()  # the thread keeps the present priority
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
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
        if self._units and not simulated:
            raise errors.InputError(_UNITS_REFUSAL)
        self._thread.submit(self._start, name, folder, simulated, who).result()

    def _start(self, name: str, folder: Path, simulated: bool, who: str) -> None:
        with self._lock:
            if self._seen.is_running:
                raise errors.InputError(f"the session {self._seen.name} runs; stop it first")
            # The program that a terminal would run, with messages instead of text.
            words = [*self._command, str(folder), "--messages"]
            if simulated:
                words.append("--twin")
            with errors.convert_write_errors(folder, errors.DeviceError):
                files.make_folder(folder)
                log = files.fresh_text(folder / LOG_NAME)
            with log:
                self._process = subprocess.Popen(
                    words,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    encoding="utf-8",
                    errors="replace",
                    start_new_session=True,
                )
            # A thread follows it, so that no viewer waits.
            self._seen = SeenSession(name, is_running=True)
            self._reader = threading.Thread(
                target=self._follow, args=(self._process, name, folder), daemon=True
            )
            self._reader.start()
        _log(f"{who} has started the guided session {name}")

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
        with self._lock:
            waiting = self._seen.question
            if waiting is None or waiting.number != number or self._process is None:
                raise errors.InputError("this question has been answered already")
            self._update(question=None)
            assert self._process.stdin is not None
            given = AnswerMessage(number=number, answer=text)
            with suppress(BrokenPipeError):
                print(given.model_dump_json(), file=self._process.stdin, flush=True)
            _log(f"{who} answers {waiting.question.key}: {terminal.one_line(text)}")

    def stop(self, who: str) -> None:
        """Stop the session as Ctrl-C does: the pump is off, and it can be resumed."""
        with self._lock:
            if self._process is None or not self._seen.is_running:
                return
            self._process.send_signal(signal.SIGINT)
        _log(f"{who} stops the guided session")

    def close(self) -> None:
        """Stop the session and wait for its end."""
        self.stop("the end of the service")
        if self._reader is not None:
            self._reader.join(_ENDS_S)
        self._thread.shutdown()

    def _follow(self, process: subprocess.Popen[str], name: str, folder: Path) -> None:
        """Take the messages of a session until it ends."""
        assert process.stdout is not None
        for line in process.stdout:
            try:
                message = MESSAGES.validate_json(line)
            except ValidationError:
                continue
            with self._lock:
                self._take_message(message)
        code = process.wait()
        process.stdout.close()
        if process.stdin is not None:
            with suppress(BrokenPipeError):
                process.stdin.close()
        with self._lock:
            self._update(question=None, is_running=False, ended=_describe_end(code, name, folder))

    def _take_message(self, message: SessionMessage) -> None:
        match message:
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


def _describe_end(code: int, name: str, folder: Path) -> str:
    """How a session ended, for people."""
    match code:
        case errors.Exit.DONE:
            return f"{name}: accepted; the report is below"
        case errors.Exit.REJECTED:
            return f"{name}: not accepted; the report states the reasons"
        case errors.Exit.INTERRUPTED:
            return f"{name}: stopped; start it again to resume it, here or in a terminal"
    lines = ["no message"]
    with suppress(OSError):
        text = (folder / LOG_NAME).read_text(encoding="utf-8", errors="replace")
        lines = text.strip().splitlines() or lines
    return f"{name}: ended with code {code}: {terminal.one_line(lines[-1])}"


def _log(text: str) -> None:
    print(f"membrane-ctrl serve: {text}", file=sys.stderr, flush=True)
