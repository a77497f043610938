"""Reads the terminal key by key."""

from __future__ import annotations

import codecs
import os
import re
import termios
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from membrane_ctrl.model import job_control

_LINE_MODES = 3  # of what `termios.tcgetattr` returns
_CONTROL_CHARACTERS = 6
_NO_KEY = b"\0"  # disables a control character
_READ_BYTES = 4096
_ESCAPE_SEQUENCE = re.compile(r"\x1b(?:\[[0-9;?]*[ -/]*[@-~]|O.)")  # arrows, function keys


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

    def restore_modes(self) -> None:
        """Restore the modes after a killed console; in the background they are the shell's."""
        with suppress(OSError, termios.error):
            if job_control.in_foreground(0):
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
        if not job_control.in_foreground(self._handle):
            return ""
        with suppress(OSError, termios.error):  # nothing was typed, or the terminal has gone
            if not self._is_ours():  # also after the shell had the terminal
                self._read_keys()
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

    def _read_keys(self) -> None:
        modes = termios.tcgetattr(self._handle)
        modes[_LINE_MODES] &= ~(termios.ICANON | termios.ECHO)
        modes[_CONTROL_CHARACTERS][termios.VSUSP] = _NO_KEY
        termios.tcsetattr(self._handle, termios.TCSANOW, modes)
