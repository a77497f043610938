"""Faults and notices of the last runs: when each stood, and what it was."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path

from membrane_ctrl.model import errors
from membrane_ctrl.model.event_base import Event
from membrane_ctrl.model.events import Fault
from membrane_ctrl.model.standing_fault import standing_fault_after
from membrane_ctrl.review import catalogue
from membrane_ctrl.review.formatting import format_span
from membrane_ctrl.run_files.event_log import LoggedEvent
from membrane_ctrl.run_files.run import open_run
from membrane_ctrl.web.run_end import find_end_s

_RUNS_MOST = 20  # newest
_ALARMS_MOST = 200
_KEPT_S = 10.0  # a list is read once in this time, for all viewers


@dataclass(frozen=True, slots=True)
class PastAlarm:
    """A fault or notice.

    Attributes
    ----------
    name : str
        Of the alarm about it.
    text : str
        Its sentence.
    began_s, ended_s : float
        UTC; the end is NaN while it stands.
    run : str
        Name of the run's folder.
    is_fault : bool
        Whether it stopped the pump.
    """

    name: str
    text: str
    began_s: float
    ended_s: float
    run: str
    is_fault: bool

    def make_cells(self, utc: bool) -> dict[str, object]:
        """The row of a table."""
        stands = math.isnan(self.ended_s)
        return {
            "key": f"{self.run} {self.name} {self.began_s}",
            "began": _format_time(self.began_s, utc),
            "lasted": "stands" if stands else format_span(self.ended_s - self.began_s),
            "alarm": self.name.replace("_", " "),
            "text": self.text,
            "run": self.run,
        }


def list_alarms(logs: Path) -> list[PastAlarm]:
    """The faults and notices of the newest runs of a folder, newest first."""
    return _list_alarms(logs, time.monotonic() // _KEPT_S)


@lru_cache(maxsize=8)
def _list_alarms(logs: Path, _turn: float) -> list[PastAlarm]:
    if not logs.is_dir():
        return []
    found: list[PastAlarm] = []
    for folder in catalogue.list_run_folders(logs)[-_RUNS_MOST:]:
        with suppress(OSError, ValueError, errors.CommandError):  # one damaged run hides no other
            run = open_run(folder)
            began_s = run.origin_utc.timestamp()
            found += find_alarms(run.log, began_s, find_end_s(run), folder.name)
    return sorted(found, key=lambda alarm: alarm.began_s, reverse=True)[:_ALARMS_MOST]


def find_alarms(
    log: Iterable[LoggedEvent], began_s: float, end_s: float, run: str
) -> list[PastAlarm]:
    """The faults and notices of a run.

    Parameters
    ----------
    log : iterable of LoggedEvent
        In the order of time.
    began_s, end_s : float
        UTC of the run's start and end; NaN while it runs.
    run : str
        Name of the run folder, for the table.
    """
    standing: dict[object, PastAlarm] = {}
    ended: list[PastAlarm] = []
    fault: Fault | None = None

    def end_alarm(key: object, time_s: float) -> None:
        alarm = standing.pop(key, None)
        if alarm is not None:
            ended.append(replace(alarm, ended_s=time_s))

    for each in log:
        event, time_s = each.event, began_s + each.mono_s
        # A fault ends when it is cleared, and when another one takes its place.
        before, fault = fault, standing_fault_after(fault, event)
        if fault is None and before is not None:
            end_alarm("fault", time_s)
        if isinstance(event, Fault):
            end_alarm("fault", time_s)
            standing["fault"] = PastAlarm(event.name, event.sentence, time_s, math.nan, run, True)
            continue
        # Notices that the event closes and opens.
        changes = event.notice_changes({}) if _may_change(event) else None
        for key in changes.closed if changes else ():
            end_alarm(key, time_s)
        for notice in changes.opened if changes else ():
            end_alarm(notice.key, time_s)
            standing[notice.key] = PastAlarm(
                notice.key.alarm, notice.text, time_s, math.nan, run, False
            )
    if math.isfinite(end_s):  # a run that has ended has no standing alarms
        for remaining in list(standing):
            end_alarm(remaining, end_s)
    return [*ended, *standing.values()]


def _may_change(event: Event) -> bool:
    return bool(event.opens or event.closes)


def _format_time(utc_s: float, utc: bool) -> str:
    moment = datetime.fromtimestamp(utc_s, UTC)
    return f"{moment if utc else moment.astimezone():%Y-%m-%d %H:%M:%S}"
