"""Starts the alarm process of the service when a run or the heartbeat needs it, and replaces it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from multiprocessing.connection import Connection
from pathlib import Path

from membrane_ctrl.config.service import HeartbeatConfig
from membrane_ctrl.processes.child import Child
from membrane_ctrl.processes.event_pipe import make_pipe
from membrane_ctrl.processes.managed_child import ManagedChild
from membrane_ctrl.service.alarm_process import SERVICE_WORKS, AlarmProcessSpec
from membrane_ctrl.service.runs_to_follow import find_published_run, read_alarms_config

_STOPS_S = 3.0
_TARGET = "membrane_ctrl.service.alarm_process:alarm_process_main"


class AlarmChild:
    """The alarm process, in the service.

    Parameters
    ----------
    folders : sequence of Path
        Folders of runs on this machine.
    heartbeat : HeartbeatConfig
        Where heartbeats are sent, and how often; empty: nowhere.
    """

    def __init__(self, folders: Sequence[Path], heartbeat: HeartbeatConfig) -> None:
        self._spec = AlarmProcessSpec(tuple(folders), heartbeat)
        self._managed: ManagedChild | None = None
        self._newest: dict[Path, Path | None] = {}

    def look_after(self, now_s: float) -> None:
        """Start the process if it is needed; confirm that the service works; print its ends."""
        if self._managed is None:
            if not self._spec.heartbeat.is_wanted and not self._find_alarms():
                return
            self._managed = ManagedChild(self._make)
            self._managed.start(now_s)
        for event in self._managed.check_child(now_s):
            print(f"membrane-ctrl serve: {event.sentence}", file=sys.stderr, flush=True)
        self._managed.send(SERVICE_WORKS)

    def close(self) -> None:
        """End the process: the holds send their alarms themselves."""
        if self._managed is not None:
            self._managed.child.stop(_STOPS_S)

    def _find_alarms(self) -> bool:
        """Whether a new run has alarms to send."""
        for logs in self._spec.folders:
            newest = find_published_run(logs)
            if newest is None or newest == self._newest.get(logs):
                continue
            self._newest[logs] = newest
            if read_alarms_config(newest) is not None:
                return True
        return False

    def _make(self, count: int) -> tuple[Child, Connection]:
        ours, theirs = make_pipe()
        return Child("alarms", _TARGET, (self._spec, theirs), 0), ours
