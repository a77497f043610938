"""The lines that every display makes of a status: locks, fault, notices, alarms."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from membrane_ctrl.model.lock import Lock, describe_lock

_LOCK_FIELDS = tuple(field.name for field in fields(Lock))


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
    lines: list[str] = []
    stated = status.get("locks")
    if not isinstance(stated, list):
        return lines
    for each in stated:
        if not isinstance(each, dict):
            continue
        lock = Lock(**{name: str(each.get(name, "")) for name in _LOCK_FIELDS})
        line = describe_lock(lock)
        if problem := each.get("problem"):
            line += f"; NOT STORED: {problem}"
        lines.append(line)
    return lines


def fault_line(status: Mapping[str, Any]) -> str:
    """Return the fault of a status with its cause and remedy; empty without one."""
    fault = status.get("fault")
    if not fault:
        return ""
    return "{code} {name}: {cause}; {remedy}".format_map(fault)


def notice_lines(status: Mapping[str, Any], topic: str | None = None) -> list[str]:
    """Return the sentences of a status's notices on neither faults nor locks.

    Parameters
    ----------
    status : mapping
        As the port answers it.
    topic : str, optional
        Only those of this topic, such as `maintenance`; None: all.
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
