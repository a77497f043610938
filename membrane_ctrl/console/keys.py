"""The console's keys. Each becomes a request to the control port, as `membrane-ctrl ctl` sends it.

The terminal belongs to the shell: keys are read only in the foreground, and modes that the shell
has set meanwhile are left alone.
"""

from __future__ import annotations

import codecs
import os
import re
import termios
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from membrane_ctrl.control_port.client import PortClient
from membrane_ctrl.control_port.outcome import Outcome
from membrane_ctrl.control_port.safety_commands import is_safety_command
from membrane_ctrl.model import errors, terminal

_LINE_MODES, _CONTROL_CHARACTERS = 3, 6  # of what `termios.tcgetattr` returns
_NO_KEY = b"\0"  # disables a control character
_READ_BYTES = 4096
_ESCAPE_SEQUENCE = re.compile(r"\x1b(?:\[[0-9;?]*[ -/]*[@-~]|O.)")  # arrows, function keys
_MARK_MAX = 200  # characters; the port takes 500 bytes


@dataclass(frozen=True, slots=True)
class Keyboard:
    """A terminal with its modes before the run; picklable."""

    path: str
    modes: list[Any]

    @classmethod
    def of_stdin(cls) -> Keyboard | None:
        """The terminal on stdin; None unless stderr, where the console draws, is the same one."""
        with suppress(OSError, termios.error):
            if os.ttyname(0) == os.ttyname(2):
                return cls(os.ttyname(0), termios.tcgetattr(0))
        return None

    def restore(self) -> None:
        """Restore the modes after a killed console; in the background they are the shell's."""
        with suppress(OSError, termios.error):
            if terminal.in_foreground(0):
                termios.tcsetattr(0, termios.TCSANOW, self.modes)


class KeyReader:
    """Reads a terminal key by key, without an echo, until `close`. Raises OSError if it cannot be
    opened.
    """

    def __init__(self, keyboard: Keyboard) -> None:
        self._before = keyboard.modes
        self._handle = os.open(keyboard.path, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
        self._decoder = codecs.getincrementaldecoder("utf-8")("replace")

    def read(self) -> str:
        """What was typed since the last call; empty in the background."""
        if not terminal.in_foreground(self._handle):
            return ""
        with suppress(OSError, termios.error):  # nothing was typed, or the terminal has gone
            if not self._is_ours():  # also after the shell had the terminal
                self._take()
            return _ESCAPE_SEQUENCE.sub(
                "", self._decoder.decode(os.read(self._handle, _READ_BYTES))
            )
        return ""

    def close(self) -> None:
        """Restore the terminal's modes, unless a shell has changed them after the death of the
        control process.
        """
        with suppress(OSError, termios.error):
            if self._is_ours():
                termios.tcsetattr(self._handle, termios.TCSANOW, self._before)
        os.close(self._handle)

    def _is_ours(self) -> bool:
        modes = termios.tcgetattr(self._handle)
        suspend = modes[_CONTROL_CHARACTERS][termios.VSUSP]
        return not modes[_LINE_MODES] & termios.ICANON and bool(suspend == _NO_KEY)

    def _take(self) -> None:
        modes = termios.tcgetattr(self._handle)
        modes[_LINE_MODES] &= ~(termios.ICANON | termios.ECHO)
        modes[_CONTROL_CHARACTERS][termios.VSUSP] = _NO_KEY
        termios.tcsetattr(self._handle, termios.TCSANOW, modes)


Request = dict[str, Any]
Send = Callable[[Request], "Future[str]"]


def sender(socket: Path, run: str) -> Send:
    """Return a function that sends requests to a run without waiting for the answer.

    They are sent one after the other, but safety commands do not wait for the others.
    """
    worker, safety_worker = ThreadPoolExecutor(1), ThreadPoolExecutor(1)

    def send(request: Request) -> Future[str]:
        chosen = safety_worker if is_safety_command(request["do"]) else worker
        return chosen.submit(ask, socket, run, request)

    return send


def ask(socket: Path, run: str, request: Request) -> str:
    """Send a request to the run behind a socket; returns what became of it in one line."""
    what = request["do"]
    try:
        with PortClient.unix(socket, notice=lambda _: None) as client:
            if client.greeting.get("run") != run:
                return Outcome.failed(what, f"{socket}: another run listens there").text
            answer = client.ask(**request, why="key")
    except errors.DeviceError as error:
        return Outcome.failed(what, str(error)).text
    return Outcome.from_answer(what, answer).text


HELP = (
    ("h", "hold: start to hold, or return to holding", "hold"),
    ("p", "pause the loop at the pump's mean flow; p again resumes", "pause"),
    ("m", "mark: add a remark to the timeline", 'mark "text"'),
    ("s", "stop: end the run safely, after a confirmation", "stop"),
    ("?", "show or hide this help", ""),
)
_FOOT = "h hold  p pause/resume  m mark  s stop  ? help"
_SUSPENDED = "Ctrl-Z does nothing here: a suspended hold would lose the mirror; s stops the run"


class Desk:
    """The dialogue with the operator: keys in, requests and the console's last line out."""

    def __init__(self, send: Send) -> None:
        self._send = send
        self._prompt = ""  # "mark" or "stop" while it waits for an answer
        self._text = ""
        self._said = ""
        self._answer: Future[str] | None = None
        self.help = False

    @property
    def asks(self) -> bool:
        """Whether the last line waits for the operator."""
        return bool(self._prompt)

    @property
    def foot(self) -> str:
        """The console's last line."""
        if self._answer is not None and self._answer.done():
            self._said, self._answer = self._answer.result(), None
        match self._prompt:
            case "mark":
                return f"mark: {self._text}▏ (Enter sends, Esc cancels)"
            case "stop":
                return "stop the run? y: yes, any other key: no"
        return f"{self._said}   · {_FOOT}" if self._said else _FOOT

    def typed(self, text: str, paused: bool) -> None:
        """Take what was typed. Of several characters at once only the first is a command: the rest
        may be a paste.
        """
        if not text:
            return
        if self._prompt == "mark":
            self._write(text)
        elif self._prompt == "stop":
            self._prompt = ""
            if text[0] in "yY":
                self._ask({"do": "stop"})
            else:
                self._said = "not stopped"
        else:
            self._command(text[0].lower(), paused)

    def _command(self, key: str, paused: bool) -> None:
        match key:
            case "h":
                self._ask({"do": "hold"})
            case "p":
                self._ask({"do": "resume" if paused else "pause"})
            case "m":
                self._prompt, self._text = "mark", ""
            case "s":
                self._prompt = "stop"
            case "?":
                self.help = not self.help
            case "\x1a":
                self._said = _SUSPENDED

    def _write(self, text: str) -> None:
        for letter in text:
            if letter in "\r\n":
                self._prompt = ""
                if self._text.strip():
                    self._ask({"do": "mark", "text": self._text.strip()})
                return
            if letter == "\x1b":
                self._prompt = ""
                return
            if letter in "\x7f\b":
                self._text = self._text[:-1]
            elif letter.isprintable():
                self._text = (self._text + letter)[:_MARK_MAX]

    def _ask(self, request: Request) -> None:
        self._said = f"{request['do']}: waiting for the answer"
        self._answer = self._send(request)
