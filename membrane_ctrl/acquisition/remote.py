"""The acquisition's line to the process that started it: commands in, small reports out, and whether it lives."""

from __future__ import annotations

import os
import select
import time
from multiprocessing.connection import Connection
from typing import Literal

from membrane_ctrl.child_report import alive
from membrane_ctrl.tick import Event

AcquisitionState = Literal["preparing", "running", "paused", "retrying", "failed", "stopped"]

_PARENT_CHECK_S = 0.2  # how soon a dead parent is noticed
_ALIVE_EVERY_S = 1.0
# Between two looks at the line: one exposure (up to 10 s), one reconstruction, a camera that is opened again
_STEP_S = 60.0
# Compiling kernels on a slow machine, and the self-test of a real screen and camera, do not look at it at all
_PREPARING_S = 900.0


class Remote:
    """Commands "pause", "resume", "full", "capture" and "stop" over a Connection; reports as dicts.

    Attributes
    ----------
    stop, paused : bool
        What was last asked for. `stop` is also set when the parent has died.

    Parameters
    ----------
    control : Connection
        Both ways.
    parent_pid : int
        The process whose end is ours.
    """

    def __init__(self, control: Connection, parent_pid: int) -> None:
        self._control = control
        self._parent_pid = parent_pid
        self._full = self._capture = False
        self._said = ("", "")
        self._step_s = _PREPARING_S
        self._alive_due_s = 0.0
        self.stop = False
        self.paused = False

    def listen(self, timeout_s: float = 0.0) -> None:
        """Take what has been sent; without anything to take, wait for it up to `timeout_s` (at most 0.2 s)."""
        if os.getppid() != self._parent_pid:
            self.stop = True
            return
        self._say_alive()
        try:
            while self._control.poll(min(timeout_s, _PARENT_CHECK_S)):
                self._obey(self._control.recv())
                timeout_s = 0.0
        except (EOFError, OSError):  # the other end is closed
            self.stop = True

    def interrupts(self) -> bool:
        """Whether a running cycle should end now."""
        self.listen()
        return self.stop or self.paused

    def end(self) -> None:
        """Stop, as if told to."""
        self.stop = True

    def take_full(self) -> bool:
        """Whether a full cycle was asked for since the last call."""
        wanted, self._full = self._full, False
        return wanted

    def take_capture(self) -> bool:
        """Whether a full cycle to be kept on disk was asked for since the last call."""
        wanted, self._capture = self._capture, False
        return wanted

    def report(self, state: AcquisitionState, message: str = "", **details: object) -> None:
        """Send a report that says something new; a cycle as good as the last is no news for a record of weeks.

        It is dropped when the other end does not read, as the cycle must never wait for it.
        """
        if (state, message) == self._said:
            return
        self._said = (state, message)
        self._send({"kind": "acquisition", "state": state, "message": message, **details})

    def tell(self, event: Event) -> None:
        """Put an event on record; it is dropped like a report."""
        self._send(event)

    def prepared(self) -> None:
        """From now on the line is looked at between any two exposures."""
        self._step_s = _STEP_S
        self._alive_due_s = 0.0
        self._say_alive()

    def _say_alive(self) -> None:
        if time.monotonic() >= self._alive_due_s:
            self._alive_due_s = time.monotonic() + _ALIVE_EVERY_S
            self._send(alive(self._step_s))

    def _send(self, event: dict[str, object]) -> None:
        try:
            if select.select([], [self._control.fileno()], [], 0)[1]:
                self._control.send(event)
        except OSError:
            self.stop = True

    def _obey(self, command: object) -> None:
        match command:
            case "pause":
                self.paused = True
            case "resume":
                self.paused = False
            case "full":
                self._full = True
            case "capture":
                self._capture = True
            case "stop":
                self.stop = True
            case _:
                self.report("running", f"unknown command {command!r}: use pause, resume, full, capture or stop")
