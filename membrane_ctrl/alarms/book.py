"""The standing alarms and the messages about them. Time is an argument: no clock, no I/O.

An alarm is raised when its condition has persisted, escalated to more people if nobody acknowledges
it, repeated as a reminder, and cleared when the condition has stayed away. A condition that returns
sooner is the same alarm; a latched fault is always a new one. Several conditions under one name are
one alarm: a full disk affects all files.
"""

import math
from dataclasses import dataclass, field
from typing import Literal

from membrane_ctrl.config.port import AlarmRule, AlarmsConfig
from membrane_ctrl.model.notices import NoticeChanges, Severity


@dataclass(frozen=True, slots=True)
class Sign:
    """The condition of an alarm has appeared or cleared."""

    name: str  # of the alarm
    bad: bool  # True: the condition has appeared; False: it has cleared
    severity: Severity = "warning"
    text: str = ""
    for_s: float = 0.0  # how long the condition must persist before a message
    # which of several conditions under one name; the alarm stands until all clear. With `bad`
    # False, "" means all
    about: str = ""
    # once all conditions have cleared, the next one is a new alarm, however soon
    anew: bool = False


def signs_of(changes: NoticeChanges) -> list[Sign]:
    """Signs in the notices that an event closes and opens."""
    cleared = [Sign(key.alarm, False, about=key.subject) for key in changes.closed]
    appeared = [
        Sign(
            notice.key.alarm,
            True,
            notice.severity,
            notice.text,
            notice.delay_s,
            notice.key.subject,
            notice.always_new,
        )
        for notice in changes.opened
    ]
    return cleared + appeared


def sign_of_value(rule: AlarmRule, value: float, standing: bool) -> Sign | None:
    """Sign of a telemetry value for a rule whose condition was `standing`; None if nothing changes.

    NaN changes nothing: missing values are the safety table's task.
    """
    if math.isnan(value):
        return None
    if rule.magnitude:
        value = abs(value)
    side = 1.0 if rule.raise_at > rule.clear_at else -1.0
    if not standing and side * value > side * rule.raise_at:
        text = (
            f"{rule.field} = {value:.4g}, {'above' if side > 0 else 'below'} {rule.raise_at:g} "
            f"for {rule.for_s:g} s"
        )
        return Sign(rule.name, True, rule.severity, text, rule.for_s)
    if standing and side * value < side * rule.clear_at:
        return Sign(rule.name, False)
    return None


MessageKind = Literal["raised", "escalated", "reminder", "cleared"]


@dataclass(frozen=True, slots=True)
class AlarmMessage:
    """A message to send."""

    kind: MessageKind  # change of the alarm
    name: str  # of the alarm, as the next two
    severity: Severity
    text: str
    escalated: bool = False  # also to the `escalation_urls_file`


@dataclass(slots=True)
class _Alarm:
    sign: Sign  # content of the messages
    since_s: float  # of the condition
    standing: dict[str, Sign] = field(default_factory=dict)  # by subject, oldest first
    gone_s: float = math.inf  # when the last condition cleared
    told_s: float = math.inf
    reminded_s: float = math.inf
    escalated: bool = False
    acknowledged: bool = False

    @property
    def is_reported(self) -> bool:
        return math.isfinite(self.told_s)

    def end_condition(self, about: str) -> None:
        """End one of its conditions, or all with ""; reminders name one that still stands."""
        if about:
            self.standing.pop(about, None)
        else:
            self.standing.clear()
        if self.standing and self.sign.about not in self.standing:
            self.sign = next(iter(self.standing.values()))


class AlarmBook:
    """All alarms of a run."""

    def __init__(self, config: AlarmsConfig) -> None:
        self._config = config
        self._alarms: dict[str, _Alarm] = {}

    def note_standing(self, name: str) -> bool:
        """The condition of this alarm stands."""
        alarm = self._alarms.get(name)
        return alarm is not None and math.isinf(alarm.gone_s)

    def take_sign(self, sign: Sign, now_s: float) -> None:
        """Take a sign."""
        alarm = self._alarms.get(sign.name)
        if alarm is None or (sign.bad and sign.anew and math.isfinite(alarm.gone_s)):
            if sign.bad:
                self._alarms[sign.name] = _Alarm(sign, now_s, standing={sign.about: sign})
            return
        if not sign.bad:
            alarm.end_condition(sign.about)
            if alarm.standing:
                return
            if alarm.is_reported:
                alarm.gone_s = min(alarm.gone_s, now_s)
            else:  # cleared before any message
                del self._alarms[sign.name]
            return
        alarm.gone_s = math.inf
        alarm.standing[sign.about] = sign
        if not alarm.is_reported or alarm.sign.about not in alarm.standing:
            alarm.sign = sign

    def acknowledge_all(self) -> None:
        """Acknowledge all raised alarms: no more reminders, no escalation."""
        for alarm in self._alarms.values():
            alarm.acknowledged |= alarm.is_reported

    def step(self, now_s: float) -> list[AlarmMessage]:
        """Return the due messages."""
        messages: list[AlarmMessage] = []
        for name, alarm in list(self._alarms.items()):
            kind = self._list_due(alarm, now_s)
            if kind is None:
                continue
            if kind == "cleared":
                del self._alarms[name]
            elif kind == "raised":
                alarm.told_s = alarm.reminded_s = now_s
            else:
                alarm.reminded_s = now_s
                alarm.escalated |= kind == "escalated"
            messages.append(
                AlarmMessage(kind, name, alarm.sign.severity, alarm.sign.text, alarm.escalated)
            )
        return messages

    def _list_due(self, alarm: _Alarm, now_s: float) -> MessageKind | None:
        config = self._config
        if now_s - alarm.gone_s >= config.clear_after_s:
            return "cleared"
        if not alarm.is_reported:
            return "raised" if now_s - alarm.since_s >= alarm.sign.for_s else None
        if alarm.acknowledged or math.isfinite(alarm.gone_s):
            return None
        if not alarm.escalated and now_s - alarm.told_s >= config.escalate_after_s:
            return "escalated"
        return "reminder" if now_s - alarm.reminded_s >= config.remind_every_s else None
