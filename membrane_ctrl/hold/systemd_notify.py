"""Notifies systemd: the hold is ready, its state, its watchdog, its end."""

from __future__ import annotations

import contextlib
import math
import os
import socket

from membrane_ctrl.controller import tick
from membrane_ctrl.model import events, telemetry
from membrane_ctrl.model.run_status import RunStatus

_CLOSING_US = 120_000_000  # longer than `TimeoutStopSec=` of the unit
_NOTIFY_S = 0.5  # far below any sensible WatchdogSec=, and cheap


class SystemdNotify:
    """Notifies systemd that ticks continue (`Type=notify`, `WatchdogSec=`), with a status line, and
    when they end.

    The protocol is a datagram of KEY=VALUE lines to the socket in NOTIFY_SOCKET (sd_notify(3));
    "@name" means an abstract one. Without a socket nothing is sent. systemd restarts a loop that
    hangs and so sends nothing.
    """

    def __init__(self, address: str | None = None) -> None:
        self._address = (address or os.environ.get("NOTIFY_SOCKET", "")).replace("@", "\0", 1)
        self._next_s = -math.inf
        self._state = -1.0
        self._status = RunStatus()

    def __enter__(self) -> SystemdNotify:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        return self

    def __exit__(self, *_: object) -> None:
        # The recording is closed without ticks; `TimeoutStopSec=` limits how long that takes.
        self._send_message(f"STOPPING=1\nWATCHDOG_USEC={_CLOSING_US}")
        self._socket.close()

    def note_report(self, event: events.Event) -> None:
        """Note a child's report for the next status line."""
        self._status = self._status.after_event(event)

    def handle_tick(self, outputs: tick.TickOutputs) -> None:
        """After a tick: notify, at most twice a second unless the state changes."""
        for event in outputs.events:
            self._status = self._status.after_event(event)
        row = outputs.row
        if row.mono_s < self._next_s and row.state == self._state:
            return
        # Ready with the first tick; each message also feeds the watchdog.
        ready = "READY=1\n" if math.isinf(self._next_s) else ""
        # The line of `systemctl status`: state, error, and what needs attention
        self._next_s = row.mono_s + _NOTIFY_S
        self._state = row.state
        error = ""
        if math.isfinite(row.error_um):
            error = f", {row.format_labelled('error_um', sign=True)}"
        fault = f", fault {row.fault:g}" if row.fault else ""
        locked = ""
        if self._status.locks:
            locked = f", {len(self._status.locks)} locks"
        problems = self._status.recording_problems
        trouble = f", recording: {'; '.join(problems)}" if problems else ""
        self._send_message(
            f"{ready}WATCHDOG=1\nSTATUS={telemetry.State(int(row.state)).name.lower()}{error}{fault}{locked}{trouble}"
        )

    def _send_message(self, message: str) -> None:
        if self._address:
            with contextlib.suppress(OSError):
                # a path need not be valid text
                self._socket.sendto(message.encode(errors="replace"), self._address)
