"""The status of a hold as the port answers it, and the lines that every display makes of it."""

import math
from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any

from membrane_ctrl.model import telemetry
from membrane_ctrl.model.lock import Lock, describe_lock
from membrane_ctrl.model.notices import Notice
from membrane_ctrl.model.run_status import RunStatus

_LOCK_FIELDS = tuple(field.name for field in fields(Lock))


def status_table(status: RunStatus) -> dict[str, Any]:
    """The status for people and programs: names instead of codes, None for missing values."""
    row = status.row
    if row is None:
        return {"state": "starting", "why": "no tick has run yet"}
    locks = [
        {**asdict(lock), "problem": status.unstored.get(lock.word, "")} for lock in status.locks
    ]
    fault = None
    if status.fault:
        fault = {key: getattr(status.fault, key) for key in ("code", "name", "cause", "remedy")}
    trial_left_s = None
    if math.isfinite(status.trial_left_s):
        trial_left_s = round(status.trial_left_s, 1)
    columns = {key: value if math.isfinite(value) else None for key, value in asdict(row).items()}
    return {
        "state": telemetry.State(int(row.state)).name.lower(),
        "state_age_s": round(row.mono_s - status.since_s, 3),
        "why": status.why,
        "paused": status.paused,
        "locks": locks,
        "latched": status.latched,
        "fault": fault,
        "notices": [_notice_table(notice) for notice in status.other_notices],
        "recording_ok": not status.recording_problems,
        "safe_level": telemetry.SafeLevel(int(row.safe_level)).name.lower(),
        "shape": telemetry.ShapeState(int(row.shape_state)).name.lower(),
        "shape_reason": status.shape_reason,
        "trial_left_s": trial_left_s,
        "geometry": asdict(status.geometry) if status.geometry else None,
        "row": columns,
    }


def _notice_table(notice: Notice) -> dict[str, str]:
    return {
        "topic": notice.key.topic.value,
        "subject": notice.key.subject,
        "severity": notice.severity,
        "text": notice.short_text,
    }


def lock_lines(status: Mapping[str, Any]) -> list[str]:
    """Return a line for each lock of a status: text, author, time, word, and whether it is not
    stored.

    Parameters
    ----------
    status : mapping
        As the port answers it.

    Returns
    -------
    list of str
    """
    lines = []
    stated = status.get("locks")
    for each in stated if isinstance(stated, list) else ():
        if not isinstance(each, dict):
            continue
        lock = Lock(**{name: str(each.get(name, "")) for name in _LOCK_FIELDS})
        problem = each.get("problem")
        lines.append(describe_lock(lock) + (f"; NOT STORED: {problem}" if problem else ""))
    return lines


def fault_line(status: Mapping[str, Any]) -> str:
    """Return the fault of a status with its cause and remedy; empty without one."""
    fault = status.get("fault")
    if not fault:
        return ""
    return "{code} {name}: {cause}; {remedy}".format_map(fault)


def notice_lines(status: Mapping[str, Any], topic: str | None = None) -> list[str]:
    """Return the sentences of a status's notices on neither faults nor locks, of one topic or of
    all.
    """
    return [
        str(each["text"]) for each in status.get("notices", ()) if topic in (None, each["topic"])
    ]


def alarm_lines(status: Mapping[str, Any]) -> list[str]:
    """Return everything in a status that needs attention, a line each: locks, the fault, other
    notices.
    """
    fault = fault_line(status)
    return [
        *(f"LOCKED {line}" for line in lock_lines(status)),
        *([f"FAULT {fault}"] if fault else []),
        *notice_lines(status),
    ]
