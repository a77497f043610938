"""Faults and notices of a run: when each began, how long it stood."""

from __future__ import annotations

import math

from membrane_ctrl.model.events import Cleared, Event, Fault
from membrane_ctrl.model.recorder_events import RecorderError, RecorderRecovered
from membrane_ctrl.run_files.event_log import LoggedEvent
from membrane_ctrl.web.alarm_history import find_alarms

FAULT = Fault(11, "displacement_missing", "no laser", "nan", "0.2 s", "hold_flow", False, "aim it")


def logged(*given: tuple[float, Event]) -> list[LoggedEvent]:
    return [LoggedEvent(mono_s, event, event.to_dict()) for mono_s, event in given]


def test_a_fault_lasts_until_its_cause_has_gone() -> None:
    log = logged((5.0, FAULT), (8.0, Cleared("displacement_missing")))
    (alarm,) = find_alarms(log, 1000.0, math.nan, "run")
    assert (alarm.began_s, alarm.ended_s, alarm.is_fault) == (1005.0, 1008.0, True)
    cells = alarm.make_cells(utc=True)
    assert (cells["began"], cells["lasted"]) == ("1970-01-01 00:16:45", "3 s")
    assert cells["alarm"] == "displacement missing"


def test_what_has_not_ended_stands_and_ends_with_its_run() -> None:
    log = logged((5.0, FAULT))
    (running,) = find_alarms(log, 0.0, math.nan, "run")
    assert math.isnan(running.ended_s)
    assert running.make_cells(utc=True)["lasted"] == "stands"
    (over,) = find_alarms(log, 0.0, 60.0, "run")
    assert over.ended_s == 60.0


def test_each_subject_has_its_own_notice() -> None:
    log = logged(
        (1.0, RecorderError("ticks", "disk full")),
        (2.0, RecorderError("shapes", "disk full")),
        (3.0, RecorderRecovered("ticks", "works again")),
    )
    ended, standing = find_alarms(log, 0.0, math.nan, "run")
    assert (ended.began_s, ended.ended_s) == (1.0, 3.0)
    assert standing.began_s == 2.0
    assert not standing.is_fault


def test_a_second_fault_ends_the_first() -> None:
    log = logged((1.0, FAULT), (4.0, FAULT))
    first, second = find_alarms(log, 0.0, math.nan, "run")
    assert first.ended_s == second.began_s == 4.0
