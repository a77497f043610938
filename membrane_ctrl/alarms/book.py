"""The standing alarms and the messages about them. Time is an argument: no clock, no I/O.

An alarm is raised when its condition has persisted, escalated to more people if nobody acknowledges
it, repeated as a reminder, and cleared when the condition has stayed away. A condition that returns
sooner is the same alarm; a latched fault is always a new one. Several conditions under one name are
one alarm: a full disk affects all files.

A book may begin where another process has stopped: `adopt_sent` takes over what that has sent.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from membrane_ctrl.config.alarms import AlarmRule, AlarmsConfig
from membrane_ctrl.model.notices import NoticeChanges, Severity

# Keys of the configuration that name the lists of services
LAB, ESCALATION = "urls_file", "escalation_urls_file"
MessageKind = Literal["raised", "escalated", "reminder", "cleared"]


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
    always_new: bool = False
    condition_s: float = math.nan  # of the run: when it appeared; NaN if no event states it


def signs_of(changes: NoticeChanges, condition_s: float = math.nan) -> list[Sign]:
    """Return the signs in the notices that an event closes and opens.

    Parameters
    ----------
    changes : NoticeChanges
        What the event closes and opens.
    condition_s : float
        Time of the event.
    """
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
            condition_s,
        )
        for notice in changes.opened
    ]
    return cleared + appeared


def sign_of_value(rule: AlarmRule, value: float, standing: bool) -> Sign | None:
    """Return the sign of a telemetry value for a rule.

    Parameters
    ----------
    rule : AlarmRule
        Field, limits and delay; `raise_at` above `clear_at` means a largest value.
    value : float
        NaN changes nothing: missing values are the safety table's task.
    standing : bool
        Whether the rule's condition was there before.

    Returns
    -------
    Sign or None
        None if nothing changes.
    """
    if math.isnan(value):
        return None
    if rule.magnitude:
        value = abs(value)
    side = 1.0 if rule.raise_at > rule.clear_at else -1.0
    if not standing and side * value > side * rule.raise_at:
        side_name = "above" if side > 0 else "below"
        text = f"{rule.field} = {value:.4g}, {side_name} {rule.raise_at:g} for {rule.for_s:g} s"
        return Sign(rule.name, True, rule.severity, text, rule.for_s)
    if standing and side * value < side * rule.clear_at:
        return Sign(rule.name, False)
    return None


@dataclass(frozen=True, slots=True)
class AlarmMessage:
    """A message to send."""

    kind: MessageKind  # change of the alarm
    name: str  # of the alarm, as the next two
    severity: Severity
    text: str
    escalated: bool = False  # also to the `escalation_urls_file`
    occurrence: int = 1  # of the alarms of this name in the run
    condition_s: float = math.nan  # as in `Sign`


@dataclass(frozen=True, slots=True)
class SentMessage:
    """A message that a list of services has accepted."""

    message: AlarmMessage
    to: str  # key of the configuration that names the list
    at_s: float  # of the run: when it was sent


@dataclass(slots=True)
class _Alarm:
    sign: Sign  # content of the messages
    since_s: float  # of the condition
    standing: dict[str, Sign] = field(default_factory=dict)  # by subject, oldest first
    gone_s: float = math.inf  # when the last condition cleared
    reported_s: float = math.inf
    reminded_s: float = math.inf
    escalated: bool = False
    acknowledged: bool = False
    occurrence: int = 0

    @property
    def is_reported(self) -> bool:
        return math.isfinite(self.reported_s)

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
        self._occurrences: dict[str, int] = {}
        self._acknowledged_s = -math.inf

    def is_standing(self, name: str) -> bool:
        """Whether the condition of this alarm persists."""
        alarm = self._alarms.get(name)
        return alarm is not None and math.isinf(alarm.gone_s)

    def take_sign(self, sign: Sign, now_s: float) -> None:
        """Take a sign that a condition is there, or over.

        Parameters
        ----------
        sign : Sign
            What it is about.
        now_s : float
            Time of the sign, on the clock of `step`.
        """
        # A first condition opens the alarm; nothing is sent before it has persisted. A latched
        # fault replaces an alarm whose condition is over, even if its end was not sent yet.
        alarm = self._alarms.get(sign.name)
        if alarm is None or (sign.bad and sign.always_new and math.isfinite(alarm.gone_s)):
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

    def acknowledge_all(self, now_s: float) -> None:
        """Acknowledge all raised alarms: no more reminders, no escalation."""
        self._acknowledged_s = now_s
        for alarm in self._alarms.values():
            alarm.acknowledged |= alarm.is_reported

    def adopt_sent(self, sent: Sequence[SentMessage], now_s: float) -> None:
        """Continue where another sender has stopped: what it has sent is not sent again.

        Parameters
        ----------
        sent : sequence of SentMessage
            All of the run, oldest first.
        now_s : float
            Second of the run.
        """
        # The conditions that this book has followed stay; what it has noted as sent is
        # replaced by what the log states. An alarm that is over, and was never sent, is dropped.
        for name, alarm in list(self._alarms.items()):
            alarm.reported_s = alarm.reminded_s = math.inf
            alarm.escalated = alarm.acknowledged = False
            if math.isfinite(alarm.gone_s):
                del self._alarms[name]
        for name in dict.fromkeys(each.message.name for each in sent):
            self._adopt_alarm(name, [each for each in sent if each.message.name == name], now_s)

    def _adopt_alarm(self, name: str, sent: Sequence[SentMessage], now_s: float) -> None:
        newest = max(each.message.occurrence for each in sent)
        self._occurrences[name] = newest
        of_newest = [each for each in sent if each.message.occurrence == newest]
        first = of_newest[0]
        if any(each.message.kind == "cleared" for each in of_newest):
            return  # what stands under this name began later
        alarm = self._alarms.get(name)
        if alarm is not None and _began_later(alarm.sign, first.message):
            return
        if alarm is None:  # cleared while there was no sender
            sign = Sign(name, True, first.message.severity, first.message.text)
            alarm = self._alarms[name] = _Alarm(sign, now_s, gone_s=now_s)
        alarm.occurrence = newest
        alarm.reported_s = first.at_s
        alarm.reminded_s = of_newest[-1].at_s
        # the first list may have the message and the second not: each gets what it lacks
        if self._config.escalation_urls_file:
            last_list = ESCALATION
        else:
            last_list = first.to
        alarm.escalated = any(each.message.escalated and each.to == last_list for each in of_newest)
        alarm.acknowledged = self._acknowledged_s >= first.at_s

    def step(self, now_s: float) -> list[AlarmMessage]:
        """Return the due messages."""
        messages: list[AlarmMessage] = []
        for name, alarm in list(self._alarms.items()):
            kind = self._list_due(alarm, now_s)
            if kind is None:
                continue
            # The alarm stores what its people have been sent
            if kind == "cleared":
                del self._alarms[name]
            elif kind == "raised":
                alarm.reported_s = now_s
                alarm.reminded_s = now_s
                alarm.occurrence = self._occurrences.get(name, 0) + 1
                self._occurrences[name] = alarm.occurrence
            else:
                alarm.reminded_s = now_s
                alarm.escalated |= kind == "escalated"
            messages.append(
                AlarmMessage(
                    kind,
                    name,
                    alarm.sign.severity,
                    alarm.sign.text,
                    alarm.escalated,
                    alarm.occurrence,
                    alarm.sign.condition_s,
                )
            )
        return messages

    def _list_due(self, alarm: _Alarm, now_s: float) -> MessageKind | None:
        # In this order: the end, the first message after the condition has persisted; then, unless
        # a person has acknowledged it, once to more people, and from then on reminders.
        config = self._config
        if now_s - alarm.gone_s >= config.clear_after_s:
            return "cleared"
        if not alarm.is_reported:
            if now_s - alarm.since_s >= alarm.sign.for_s:
                return "raised"
            return None
        if alarm.acknowledged or math.isfinite(alarm.gone_s):
            return None
        if not alarm.escalated and now_s - alarm.reported_s >= config.escalate_after_s:
            return "escalated"
        if now_s - alarm.reminded_s >= config.remind_every_s:
            return "reminder"
        return None


def _began_later(sign: Sign, sent: AlarmMessage) -> bool:
    """Whether a condition is another one than that of a message, under the same name."""
    return sign.always_new and sign.condition_s > sent.condition_s
