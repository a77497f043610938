"""Configuration of the control port and of the alarms."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from firmware_iface.settings import Section
from membrane_ctrl.model.telemetry import FIELDS

Seconds = Annotated[float, Field(ge=0, le=1e6)]


class TlsConfig(Section):
    """The port on TCP, with a certificate on either side (docs/control-port.md)."""

    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535)] = 7470  # 0: any free one, named in the "port" event
    certificate_file: str
    key_file: str
    client_ca_file: str  # accepts certificates it has signed; the role is the OU of the client's certificate


class PortConfig(Section):
    """Where a running hold listens."""

    enabled: bool = True
    socket: str | None = None  # control.sock beside the run folders when absent
    group: str | None = None  # owns the socket file if the process may chown it; its members may connect
    group_role: Literal["read", "operate", "tune"] = "operate"  # for everyone but the owner and root, who have `tune`
    commander_lapses_s: Annotated[float, Field(ge=1, le=1e6)] = 600.0
    tls: TlsConfig | None = None
    metrics_port: Annotated[int, Field(ge=1, le=65535)] | None = None  # Prometheus, on 127.0.0.1 only


class AlarmRule(Section):
    """An alarm on one telemetry field, raised beyond one limit and cleared only on the good side of the other.

    High values are bad if `raise_at` is above `clear_at`, low ones if it is below.
    """

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,40}$")]
    field: str
    raise_at: float
    clear_at: float
    magnitude: bool = False  # use the value's magnitude
    for_s: Seconds = 30.0
    severity: Literal["warning", "critical"] = "warning"

    @model_validator(mode="after")
    def _sound(self) -> AlarmRule:
        if self.field not in FIELDS:
            raise ValueError(f"field: unknown telemetry field {self.field!r}; known: {', '.join(FIELDS)}")
        if self.raise_at == self.clear_at:
            raise ValueError("raise_at and clear_at must differ, or the alarm would flap")
        return self


_RULES = (
    # the film's own motion is below 1 um: ten times that for half a minute is not a gust
    AlarmRule(name="out_of_band", field="error_um", raise_at=10.0, clear_at=3.0, magnitude=True),
    # a leak that takes nearly all of the pump's flow will soon take more
    AlarmRule(name="pump_near_limit", field="pump_fraction", raise_at=0.9, clear_at=0.7, for_s=120.0),
)


class AlarmsConfig(Section):
    """Which alarms go to whom. Without `urls_file` none are sent."""

    urls_file: str | None = None  # one Apprise URL per line; separate, because every run copies the configuration
    escalation_urls_file: str | None = None  # notified when nobody acknowledges
    escalate_after_s: Annotated[float, Field(ge=1, le=1e6)] = 900.0
    remind_every_s: Annotated[float, Field(ge=60, le=1e6)] = 3600.0
    clear_after_s: Seconds = 30.0  # absent this long: cleared; back sooner: the same alarm
    silent_s: Annotated[float, Field(ge=1, le=3600)] = 5.0  # no tick for this long is an alarm of its own
    rules: tuple[AlarmRule, ...] = _RULES

    @model_validator(mode="after")
    def _names_differ(self) -> AlarmsConfig:
        names = [rule.name for rule in self.rules]
        if len(set(names)) < len(names):
            raise ValueError("rules: two rules have the same name")
        if self.escalation_urls_file and not self.urls_file:
            raise ValueError("escalation_urls_file needs urls_file")
        return self
