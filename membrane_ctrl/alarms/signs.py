"""What the run's events and telemetry mean as alarms: each sign raises an alarm or takes it away."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from membrane_ctrl.port_config import AlarmRule
from membrane_ctrl.tick import Event

Severity = Literal["warning", "critical"]

# a fault that holds the flow for a few samples and is over again wakes nobody
_GLITCH_S = 5.0
_LIARS = {"laser": "the laser", "optics": "the camera"}


@dataclass(frozen=True, slots=True)
class Sign:
    """One alarm's condition has come or gone.

    Attributes
    ----------
    name : str
        Of the alarm.
    bad : bool
        It has come; False: gone.
    severity, text
        Of an alarm that has come.
    for_s : float
        How long the condition must stand before anyone is told.
    about : str
        Which of several conditions under one name: the alarm stands until the last of them has gone. "" with `bad`
        False: all have gone.
    anew : bool
        What comes after the last one has gone is another one, however soon.
    """

    name: str
    bad: bool
    severity: Severity = "warning"
    text: str = ""
    for_s: float = 0.0
    about: str = ""
    anew: bool = False


def signs_of(event: Event) -> list[Sign]:
    """What an event says; most say nothing."""
    match event.get("kind"):
        case "fault":
            text = f"{event.get('cause')} ({event.get('seen')}; {event.get('limit')}); {event.get('remedy')}"
            if event.get("latching"):
                return [Sign("fault", True, "critical", f"{event.get('name')}: {text}", anew=True)]
            return [Sign("glitch", True, "warning", f"{event.get('name')}: {text}", _GLITCH_S)]
        case "cleared":
            return [Sign("glitch", False)]
        case "state" if event.get("from") == "fault":
            return [Sign("fault", False), Sign("glitch", False)]
        case "link":
            up = event.get("message") == "connected again"
            return [Sign("link", not up, "warning", str(event.get("message")), _GLITCH_S)]
        case "child_ended":
            child, code = event.get("child"), event.get("exit_code")
            text = f"the {child} process ended with {code}; the hold goes on without it"
            return [Sign(f"{child}_ended", True, "warning", text, _GLITCH_S)]
        case "child_silent":
            text = f"the {event.get('child')} process does not answer; the hold goes on without it"
            return [Sign(f"{event.get('child')}_ended", True, "warning", text, _GLITCH_S)]
        case "child_given_up":
            text = (
                f"the {event.get('child')} process has ended too often and is left alone for an hour; look at the run"
            )
            return [Sign(f"{event.get('child')}_ended", True, "warning", text)]
        case "child_restarted":
            ended = Sign(f"{event.get('child')}_ended", False)
            # another recorder knows nothing of the former's trouble, and says anew what still stands
            return [ended, Sign("recorder", False)] if event.get("child") == "recorder" else [ended]
        case "recorder_error" | "disk_low":
            text = str(event.get("message", event))
            return [Sign("recorder", True, "warning", text, about=str(event.get("what", "")))]
        case "recorder_recovered":
            return [Sign("recorder", False, about=str(event.get("what", "")))]
        case "port_failed":
            return [Sign("port", True, "warning", f"the control port failed: {event.get('message')}", _GLITCH_S)]
        case "port_open":
            return [Sign("port", False)]
        case "maintenance" | "maintenance_over":
            bad = event.get("kind") == "maintenance"
            return [Sign(f"maintenance_{event.get('name')}", bad, "warning", str(event.get("message")))]
        case "plausibility":
            bad = event.get("liar") != "nobody"
            who = _LIARS.get(str(event.get("liar")), "one of them")
            text = f"laser and camera do not agree; {who} is wrong ({event.get('seen')})"
            return [Sign("plausibility", bad, "warning", text)]
        case "latch_failed":
            text = f"the fault may be forgotten at the next start: {event.get('message')}"
            return [Sign("latch", True, "critical", text)]
        case "latch_written":
            return [Sign("latch", False)]
        case "end":
            return _end_signs(event)
    return []


def _end_signs(event: Event) -> list[Sign]:
    if event.get("exit") in ("done", "interrupted"):
        return []
    return [Sign("run_ended", True, "critical", f"the run has ended: {event.get('exit')}")]


def sign_of_value(rule: AlarmRule, value: float, standing: bool) -> Sign | None:
    """What a telemetry value says to a rule; None: as before.

    Parameters
    ----------
    rule : AlarmRule
        Its limits; between them nothing changes.
    value : float
        Of the rule's field. NaN says nothing: that a value is missing is the safety table's business.
    standing : bool
        The alarm's condition was there with the last value.
    """
    if math.isnan(value):
        return None
    if rule.magnitude:
        value = abs(value)
    side = 1.0 if rule.raise_at > rule.clear_at else -1.0
    if not standing and side * value > side * rule.raise_at:
        text = (
            f"{rule.field} = {value:.4g}, {'above' if side > 0 else 'below'} {rule.raise_at:g} for {rule.for_s:g} s"
        )
        return Sign(rule.name, True, rule.severity, text, rule.for_s)
    if standing and side * value < side * rule.clear_at:
        return Sign(rule.name, False)
    return None
