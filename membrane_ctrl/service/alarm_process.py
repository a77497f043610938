"""The alarm process of the service: sends the alarms of its holds, and the heartbeat.

It is a process of its own, because the libraries that send messages need a limit of memory, and
fifty viewers of the page must not delay an alarm. It ends with the service.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

from membrane_ctrl.alarms.memory_limit import limited_memory
from membrane_ctrl.config.service import HeartbeatConfig
from membrane_ctrl.model import child_events, errors
from membrane_ctrl.processes import child, event_pipe
from membrane_ctrl.service.followed_run import FollowedRun
from membrane_ctrl.service.heartbeat import make_heartbeat
from membrane_ctrl.service.runs_to_follow import find_published_run, read_alarms_config

SERVICE_WORKS = "service works"  # message of the service
_LOOK_S = 0.5
_FIND_S = 1.0
_SERVICE_SILENT_S = 30.0
_STUCK_S = 120.0  # messages to two lists of services take 60 s each
_IDLE_S = 15.0


@dataclass(frozen=True, slots=True)
class AlarmProcessSpec:
    """What the process needs.

    Attributes
    ----------
    folders : tuple of Path
        Folders of runs on this machine.
    heartbeat : HeartbeatConfig
    """

    folders: tuple[Path, ...]
    heartbeat: HeartbeatConfig


class FolderAlarms:
    """Sends the alarms of the runs of one folder, on a thread of its own.

    Attributes
    ----------
    worked_s : float
        Monotonic time of the last complete step.
    """

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._newest: Path | None = None
        self._followed: list[FollowedRun] = []
        self._find_at_s = 0.0
        self.worked_s = time.monotonic()

    def run(self) -> None:
        """Step for ever."""
        while True:
            self.step()
            time.sleep(_LOOK_S)

    def step(self) -> None:
        """Follow a new run, and send what is due."""
        now_s = time.monotonic()
        if now_s >= self._find_at_s:
            self._find_at_s = now_s + _FIND_S
            self._find_run()
        for run in self._followed:
            run.step()
        # the newest stays, also when it is over: it may have to be escalated
        for run in [run for run in self._followed[:-1] if run.is_done]:
            self._followed.remove(run)
            run.close()
        self.worked_s = time.monotonic()

    def describe(self) -> str:
        """The newest run, for the heartbeat."""
        return f"{self._logs}: {'no run' if self._newest is None else self._newest.name}"

    def close(self) -> None:
        """Stop following."""
        for run in self._followed:
            run.close()
        self._followed = []

    def _find_run(self) -> None:
        newest = find_published_run(self._logs)
        if newest is None or newest == self._newest:
            return
        self._newest = newest
        alarms = read_alarms_config(newest)
        if alarms is None:
            return
        try:
            self._followed.append(FollowedRun(newest, alarms))
        except (errors.CommandError, OSError) as error:
            print(f"alarms of {newest}: not sent by the service: {error}", file=sys.stderr)


def alarm_process_main(spec: AlarmProcessSpec, line: Connection) -> None:
    """Send alarms and heartbeats until the service ends.

    Target of a `spawn`ed process.

    Parameters
    ----------
    spec : AlarmProcessSpec
        Folders and heartbeat; pickled by `multiprocessing`, so plain data.
    line : Connection
        Both ways: the service writes `SERVICE_WORKS` while it works, this process reports `Alive`.
        Silence of the service for 30 s stops the heartbeats: the program that expects them reports
        it.
    """
    child.leave_at_stop()
    heartbeat = make_heartbeat(spec.heartbeat)
    report = event_pipe.make_event_sender(line)
    folders = [FolderAlarms(logs) for logs in spec.folders]
    with limited_memory():
        for each in folders:
            threading.Thread(target=each.run, name=f"alarms {each.describe()}", daemon=True).start()
        service_s = time.monotonic()
        while child.parent_lives():
            now_s = time.monotonic()
            if _has_message(line):
                service_s = now_s
            # `Alive` only while every folder's thread works: the service replaces this process
            # otherwise. The heartbeat needs the service, too: its silence is the alarm of last
            # resort, sent by the program that expects it
            if is_working(folders, now_s):
                report(child_events.Alive(_IDLE_S))
                if now_s - service_s < _SERVICE_SILENT_S:
                    heartbeat.step(now_s, "\n".join(each.describe() for each in folders))
            time.sleep(_LOOK_S)


def is_working(folders: Sequence[FolderAlarms], now_s: float) -> bool:
    """Whether all folders are looked after.

    Parameters
    ----------
    folders : sequence of FolderAlarms
        Each steps on its own thread, and notes the end of every step.
    now_s : float
        Monotonic time.
    """
    return all(now_s - each.worked_s < _STUCK_S for each in folders)


def _has_message(line: Connection) -> bool:
    """Take the waiting messages; whether there was one."""
    has_message = False
    with suppress(OSError, EOFError):
        while line.poll():
            has_message |= line.recv() == SERVICE_WORKS
    return has_message
