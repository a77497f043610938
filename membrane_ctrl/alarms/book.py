"""The alarms that stand, and what to tell whom about them. Time is passed in: no clock, no I/O.

An alarm is told when its condition has stood for its time; told again, to more people, when nobody acknowledges it;
brought to mind now and then; and told off when the condition has stayed away. A condition that goes and comes within
that time is the same alarm, told once; a latched fault is always another one. Several conditions under one name are
one alarm: a full disk hits all files.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from membrane_ctrl.alarms.signs import Severity, Sign
from membrane_ctrl.port_config import AlarmsConfig

NoticeKind = Literal["raised", "escalated", "reminder", "cleared"]


@dataclass(frozen=True, slots=True)
class Notice:
    """Something to tell people.

    Attributes
    ----------
    kind : str
        What has happened to the alarm.
    name, severity, text
        Of the alarm.
    escalated : bool
        Also for those behind `escalation_urls_file`.
    """

    kind: NoticeKind
    name: str
    severity: Severity
    text: str
    escalated: bool = False


@dataclass(slots=True)
class _Alarm:
    sign: Sign  # what people are told
    since_s: float  # of the condition
    standing: dict[str, Sign] = field(default_factory=dict)  # by what it is about, the oldest first
    gone_s: float = math.inf  # since when it has stayed away
    told_s: float = math.inf
    reminded_s: float = math.inf
    escalated: bool = False
    acknowledged: bool = False

    @property
    def told(self) -> bool:
        return math.isfinite(self.told_s)

    def end(self, about: str) -> None:
        """One of its conditions has gone, or all: a reminder names one that still stands."""
        if about:
            self.standing.pop(about, None)
        else:
            self.standing.clear()
        if self.standing and self.sign.about not in self.standing:
            self.sign = next(iter(self.standing.values()))


class AlarmBook:
    """All alarms of a run.

    Parameters
    ----------
    config : AlarmsConfig
        Times.
    """

    def __init__(self, config: AlarmsConfig) -> None:
        self._config = config
        self._alarms: dict[str, _Alarm] = {}

    def standing(self, name: str) -> bool:
        """The condition of this alarm is there."""
        alarm = self._alarms.get(name)
        return alarm is not None and math.isinf(alarm.gone_s)

    def take(self, sign: Sign, now_s: float) -> None:
        """Note what a sign says."""
        alarm = self._alarms.get(sign.name)
        if alarm is None or (sign.bad and sign.anew and math.isfinite(alarm.gone_s)):
            if sign.bad:
                self._alarms[sign.name] = _Alarm(sign, now_s, standing={sign.about: sign})
            return
        if not sign.bad:
            alarm.end(sign.about)
            if alarm.standing:
                return
            if alarm.told:
                alarm.gone_s = min(alarm.gone_s, now_s)
            else:  # gone before anyone was told
                del self._alarms[sign.name]
            return
        alarm.gone_s = math.inf
        alarm.standing[sign.about] = sign
        if not alarm.told or alarm.sign.about not in alarm.standing:
            alarm.sign = sign

    def acknowledge(self) -> None:
        """Somebody has seen all that stands: no more reminders, nobody else is woken."""
        for alarm in self._alarms.values():
            alarm.acknowledged |= alarm.told

    def step(self, now_s: float) -> list[Notice]:
        """What is to be told now."""
        notices: list[Notice] = []
        for name, alarm in list(self._alarms.items()):
            kind = self._due(alarm, now_s)
            if kind is None:
                continue
            if kind == "cleared":
                del self._alarms[name]
            elif kind == "raised":
                alarm.told_s = alarm.reminded_s = now_s
            else:
                alarm.reminded_s = now_s
                alarm.escalated |= kind == "escalated"
            notices.append(Notice(kind, name, alarm.sign.severity, alarm.sign.text, alarm.escalated))
        return notices

    def _due(self, alarm: _Alarm, now_s: float) -> NoticeKind | None:
        config = self._config
        if now_s - alarm.gone_s >= config.clear_after_s:
            return "cleared"
        if not alarm.told:
            return "raised" if now_s - alarm.since_s >= alarm.sign.for_s else None
        if alarm.acknowledged or math.isfinite(alarm.gone_s):
            return None
        if not alarm.escalated and now_s - alarm.told_s >= config.escalate_after_s:
            return "escalated"
        return "reminder" if now_s - alarm.reminded_s >= config.remind_every_s else None
