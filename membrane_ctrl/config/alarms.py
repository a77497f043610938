"""Configuration of the alarms: who is informed of what, and how often."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from firmware_iface.settings import Section
from membrane_ctrl.model.telemetry import FIELDS

Seconds = Annotated[float, Field(ge=0, le=1e6)]
Limit = Annotated[float, Field(ge=-1e12, le=1e12)]


class AlarmRule(Section):
    """An alarm on one telemetry field, raised beyond one limit and cleared only on the good side of
    the other.

    High values are bad if `raise_at` is above `clear_at`, low ones if it is below.
    """

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,40}$")]
    """Name of the alarm in messages. Set it to a word of lower-case letters, digits and `_`."""
    field: str
    """Telemetry field to watch. Set it to a field of docs/reference/recording.md, e.g.
    `error_um`."""
    raise_at: Limit
    """Value at which the alarm is raised, in the field's unit. Set it beyond what weather does."""
    clear_at: Limit
    """Value at which it is cleared. Set it on the good side of `raise_at`, or the alarm flaps."""
    magnitude: bool = False
    """Judge the value without its sign. Set it to true for errors of either sign."""
    for_s: Seconds = 30.0
    """Time beyond the limit before the alarm. Raise it to ignore gusts."""
    severity: Literal["warning", "critical"] = "warning"
    """Severity in the message. Change it to critical for what must wake somebody."""

    @model_validator(mode="after")
    def _check_limits(self) -> "AlarmRule":
        if self.field not in FIELDS:
            raise ValueError(
                f"field: unknown telemetry field {self.field!r}; known: {', '.join(FIELDS)}"
            )
        if self.raise_at == self.clear_at:
            raise ValueError("raise_at and clear_at must differ, or the alarm would flap")
        return self


_RULES = (
    # the film's own motion is below 1 µm: ten times that for half a minute is not a gust
    AlarmRule(name="out_of_band", field="error_um", raise_at=10.0, clear_at=3.0, magnitude=True),
    # a leak that takes nearly all of the pump's flow will soon take more
    AlarmRule(
        name="pump_near_limit", field="pump_fraction", raise_at=0.9, clear_at=0.7, for_s=120.0
    ),
)


class AlarmsConfig(Section):
    """Which alarms go to whom. Without `urls_file` none are sent."""

    urls_file: str | None = None
    """File with one Apprise URL per line, which no run copies. Set it to send alarms; without it
    none are sent.
    """
    escalation_urls_file: str | None = None
    """The same for those who are notified when no one acknowledges. Set it if there is a second
    person to notify.
    """
    escalate_after_s: Annotated[float, Field(ge=1, le=1e6)] = 900.0
    """Time without acknowledgement before that. Lower it where minutes count."""
    remind_every_s: Annotated[float, Field(ge=60, le=1e6)] = 3600.0
    """Interval of the reminders. Change it to what people will not silence."""
    clear_after_s: Seconds = 30.0
    """Absence after which an alarm is cleared; back sooner, it is the same alarm. Raise it for what
    flickers.
    """
    silent_s: Annotated[float, Field(ge=1, le=3600)] = 5.0
    """Time without a tick that raises an alarm. Leave it, except on a machine that pauses.
    """
    rules: tuple[AlarmRule, ...] = _RULES
    """Alarms on telemetry. Change it to add your own; a list replaces the default rules."""

    @model_validator(mode="after")
    def _names_differ(self) -> "AlarmsConfig":
        names = [rule.name for rule in self.rules]
        if len(set(names)) < len(names):
            raise ValueError("rules: two rules have the same name")
        if self.escalation_urls_file and not self.urls_file:
            raise ValueError("escalation_urls_file needs urls_file")
        return self
