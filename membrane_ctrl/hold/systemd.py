"""Tells systemd that ticks go on: `Type=notify`, `WatchdogSec=`, a status line. Nothing at all without systemd.

The protocol is a datagram of KEY=VALUE lines to the socket in NOTIFY_SOCKET (sd_notify(3)). Sent from the end of a
tick: a loop that hangs sends nothing, and systemd restarts it. Never waits: what the socket does not take is lost.
"""

from __future__ import annotations

import contextlib
import math
import os
import socket
from types import TracebackType

from membrane_ctrl.controller.tick import TickOutputs
from membrane_ctrl.model.events import Event
from membrane_ctrl.model.run_status import RunStatus
from membrane_ctrl.model.states import State

_EVERY_S = 0.5  # far below any sensible WatchdogSec=, and nothing to a tick


class SystemdNotify:
    """A listener to ticks; a context manager that says when it is over.

    Parameters
    ----------
    address : str or None
        Of the socket, by default from the environment; "@name" is an abstract one.
    """

    def __init__(self, address: str | None = None) -> None:
        self._address = (address or os.environ.get("NOTIFY_SOCKET", "")).replace("@", "\0", 1)
        self._next_s = -math.inf
        self._state = -1.0
        self._status = RunStatus()

    def __enter__(self) -> SystemdNotify:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._send("STOPPING=1")
        self._socket.close()

    def told(self, event: Event) -> None:
        """Take in what a child process reports; the next status line has it."""
        self._status = self._status.after_event(event)

    def heard(self, outputs: TickOutputs) -> None:
        """A tick has ended."""
        row = outputs.row
        if row.mono_s < self._next_s and row.state == self._state:
            return
        ready = "READY=1\n" if math.isinf(self._next_s) else ""
        self._next_s, self._state = row.mono_s + _EVERY_S, row.state
        error = f", error {row.error_um:+.2f} um" if math.isfinite(row.error_um) else ""
        fault = f", fault {row.fault:g}" if row.fault else ""
        trouble = f", recording: {self._status.recording_words}" if self._status.recording else ""
        self._send(f"{ready}WATCHDOG=1\nSTATUS={State(int(row.state)).name.lower()}{error}{fault}{trouble}")

    def _send(self, message: str) -> None:
        if self._address:
            with contextlib.suppress(OSError):
                self._socket.sendto(message.encode(errors="replace"), self._address)  # a path may be no text
