"""The acquisition's connection to its parent: commands in, reports and signs of life out."""

import select
import time
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Literal

from membrane_ctrl.model import acquisition_events, child_events, events
from membrane_ctrl.processes import child

AcquisitionState = Literal["preparing", "running", "paused", "retrying", "failed", "stopped"]

_PARENT_CHECK_S = 0.2  # interval of checking for a dead parent
_ALIVE_EVERY_S = 1.0
# Between two checks of the line: one exposure (up to 10 s), one reconstruction, reopening a camera
_STEP_S = 60.0
# Compiling kernels on a slow machine and the self-test of a real screen and camera do not check it
# at all
_PREPARING_S = 900.0


@dataclass(frozen=True)
class CaptureRequest:
    """A capture set that somebody asked for."""

    turned_deg: float | None = None  # of a mirror that was turned about its axis


class Remote:
    """Commands "pause", "resume", "full", "capture", "capture DEGREES" and "stop" over a
    Connection; reports as dicts.

    `stop` and `paused` reflect the last commands; the parent's death also sets `stop`.
    """

    def __init__(self, control: Connection) -> None:
        self._control = control
        self._full = False
        self._capture: CaptureRequest | None = None
        self._said = ("", "")
        self._step_s = _PREPARING_S
        self._alive_due_s = 0.0
        self.stop = False
        self.paused = False

    def take_commands(self, timeout_s: float = 0.0) -> None:
        """Take pending commands; if there are none, wait up to `timeout_s` (at most 0.2 s)."""
        if not child.parent_lives():
            self.stop = True
            return
        self._say_alive()
        try:
            while self._control.poll(min(timeout_s, _PARENT_CHECK_S)):
                self._execute_command(self._control.recv())
                timeout_s = 0.0
        except (EOFError, OSError):  # the other end is closed
            self.stop = True

    def is_interrupting(self) -> bool:
        """Whether a running cycle should end now."""
        self.take_commands()
        return self.stop or self.paused

    def request_stop(self) -> None:
        """Stop, as if commanded."""
        self.stop = True

    def take_full(self) -> bool:
        """Whether a full cycle was requested since the last call."""
        wanted = self._full
        self._full = False
        return wanted

    def take_capture(self) -> CaptureRequest | None:
        """The newest request of a full cycle to keep on disk since the last call."""
        wanted = self._capture
        self._capture = None
        return wanted

    def report_state(
        self,
        state: AcquisitionState,
        message: str = "",
        cycle: int | None = None,
        traceback: str | None = None,
    ) -> None:
        """Send a report that differs from the last one.

        In weeks of recording, good cycles need no reports. It is dropped if the other end does not
        read: the cycle must never wait.

        Parameters
        ----------
        state : AcquisitionState
        message : str
            For people.
        cycle : int, optional
            The cycle that it is about.
        traceback : str, optional
            Of an unexpected error, for the log.
        """
        if (state, message) == self._said:
            return
        self._said = (state, message)
        self._send(acquisition_events.AcquisitionState(state, message, cycle, traceback))

    def send_event(self, event: events.Event) -> None:
        """Record an event; it may be dropped like a report."""
        self._send(event)

    def start_line_checks(self) -> None:
        """From now on, the line is checked between any two exposures."""
        self._step_s = _STEP_S
        self._alive_due_s = 0.0
        self._say_alive()

    def _say_alive(self) -> None:
        if time.monotonic() >= self._alive_due_s:
            self._alive_due_s = time.monotonic() + _ALIVE_EVERY_S
            self._send(child_events.Alive(self._step_s))

    def _send(self, event: events.Event) -> None:
        try:
            if select.select([], [self._control.fileno()], [], 0)[1]:
                self._control.send(event.to_dict())
        except OSError:
            self.stop = True

    def _execute_command(self, command: object) -> None:
        match command:
            case "pause":
                self.paused = True
            case "resume":
                self.paused = False
            case "full":
                self._full = True
            case "capture":
                self._capture = CaptureRequest()
            case str() if command.startswith("capture "):
                self._capture = CaptureRequest(float(command.removeprefix("capture ")))
            case "stop":
                self.stop = True
            case _:
                self.report_state(
                    "running",
                    f"unknown command {command!r}: use pause, resume, full, capture or stop",
                )
