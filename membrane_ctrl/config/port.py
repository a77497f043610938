"""Configuration of the control port, of the bridges for other systems, and of the alarms."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from firmware_iface.settings import Section
from membrane_ctrl.model.telemetry import FIELDS

SOCKET_NAME = "control.sock"
LOCAL = "127.0.0.1"
LOCAL_HOSTS = frozenset({LOCAL, "localhost", "::1"})
Seconds = Annotated[float, Field(ge=0, le=1e6)]
Limit = Annotated[float, Field(ge=-1e12, le=1e12)]


class PortConfig(Section):
    """Where a running hold listens."""

    enabled: bool = True
    """Listen for commands. Set it to false to take none but signals."""
    socket: str | None = None
    """Socket file; control.sock beside the run folders when absent. Set it for a path that others
    expect.
    """
    group: str | None = None
    """Group that owns the socket file, whose members may connect. Set it to let others operate the
    mirror.
    """
    group_role: Literal["read", "operate", "tune"] = "operate"
    """Role of everyone but the owner and root, who have `tune`. Change it to restrict or trust the
    group.
    """
    commander_lapses_s: Annotated[float, Field(ge=1, le=1e6)] = 600.0
    """Silence after which another may command without --take-over. Change it to the pace of your
    shifts.
    """

    def socket_in(self, logs_dir: Path) -> Path:
        """The socket's file of a hold with its runs in `logs_dir`."""
        return Path(self.socket) if self.socket else logs_dir / SOCKET_NAME


class FleetHold(Section):
    """One of several holds, here or on another host."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_. -]{0,40}$")]
    """Name in lists."""
    socket: str | None = None
    """Socket file of a hold on this machine."""
    url: str = ""
    """Address of the service that has the hold, such as https://bench2.lab:7480/."""
    hold: str = ""
    """Name of the hold there. Set it where that service has several."""
    token_file: str | None = None
    """File with a token of that service; without it, the variable MEMBRANE_CTRL_TOKEN."""
    authority_file: str | None = None
    """CA of the service's certificate. Set it if the system does not know it."""

    @model_validator(mode="after")
    def _require_one_place(self) -> "FleetHold":
        if bool(self.socket) == bool(self.url):
            raise ValueError("give either socket or url")
        return self


class FleetConfig(Section):
    """A fleet file: `[[holds]]`, each with a name (docs/reference/control-port.md)."""

    holds: Annotated[tuple[FleetHold, ...], Field(min_length=1, max_length=100)]
    """The holds."""

    @model_validator(mode="after")
    def _require_distinct_mirrors(self) -> "FleetConfig":
        if len({hold.name for hold in self.holds}) < len(self.holds):
            raise ValueError("holds: two have the same name")
        return self


class BrokerConfig(Section):
    """A broker of MQTT."""

    host: str = "127.0.0.1"
    """Host of the broker. Set it to your broker's."""
    port: Annotated[int, Field(ge=1, le=65535)] = 1883
    """TCP port of the broker. Change it to your broker's; with TLS usually 8883."""
    username: str | None = None
    """Name at the broker. Set it if the broker asks for one."""
    password_file: str | None = None
    """File with the password alone, which no run copies. Set it with `username`."""
    ca_file: str | None = None
    """CA of the broker's certificate; with it the connection is TLS. Set it for a broker on another
    machine.
    """


class MqttConfig(BrokerConfig):
    """The broker that gets the published values."""

    discovery_prefix: str = "homeassistant"
    """Prefix of Home Assistant's discovery; empty: none. Leave it, unless Home Assistant's was
    changed.
    """


class OpcuaConfig(Section):
    """The OPC UA server."""

    host: str = LOCAL
    """Address to listen on. Change it to let other machines connect."""
    port: Annotated[int, Field(ge=1, le=65535)] = 4840
    """TCP port. Change it if another program has it."""
    users_file: str | None = None
    """Users and passwords, made with `membrane-ctrl serve add-user`. Set it so that only they may
    read and act.
    """
    certificate_file: str | None = None
    """Certificate of this server (RSA, PEM); with it all sessions are encrypted. Set it with
    `key_file`.
    """
    key_file: str | None = None
    """Private key of the certificate. Set it with `certificate_file`."""

    @property
    def encrypted(self) -> bool:
        """Whether sessions are encrypted."""
        return self.certificate_file is not None and self.key_file is not None

    @model_validator(mode="after")
    def _require_certificate_with_key(self) -> "OpcuaConfig":
        if (self.certificate_file is None) != (self.key_file is None):
            raise ValueError("certificate and key: give both files, or none")
        if self.host not in LOCAL_HOSTS and self.users_file is not None and not self.encrypted:
            raise ValueError(
                f"host {self.host}: passwords would cross the network in plain text; give a "
                "certificate"
            )
        return self


class EpicsConfig(Section):
    """The EPICS server, Channel Access and PV Access."""

    host: str = LOCAL
    """Address to listen on. Change it to let other machines connect."""
    ca_port: Annotated[int, Field(ge=1024, le=65535)] = 5064
    """Port of Channel Access. Change it if another server has it."""
    pva_port: Annotated[int, Field(ge=1024, le=65535)] = 5075
    """Port of PV Access. Change it if another server has it."""


class BridgesConfig(Section):
    """Bridges to the lab's other systems (docs/how-to/bridges.md), started by `membrane-ctrl
    bridges`."""

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,30}$")] = "mirror"
    """First part of every published name. Change it where there are several mirrors."""
    role: Literal["read", "operate", "tune"] = "read"
    """Highest role of a command from a bridge. Change it to let other systems act."""
    period_s: Annotated[float, Field(ge=0.5, le=60)] = 1.0
    """Interval between values. Raise it for a slow network."""
    mqtt: MqttConfig | None = None
    opcua: OpcuaConfig | None = None
    epics: EpicsConfig | None = None

    @model_validator(mode="after")
    def _require_identified_clients(self) -> "BridgesConfig":
        for name, bridge in (("opcua", self.opcua), ("epics", self.epics)):
            known = isinstance(bridge, OpcuaConfig) and bridge.users_file is not None
            if (
                bridge is not None
                and bridge.host not in LOCAL_HOSTS
                and self.role != "read"
                and not known
            ):
                remedy = "give users_file, or keep" if name == "opcua" else "keep"
                raise ValueError(
                    f"{name}.host = {bridge.host!r}: this bridge cannot tell who acts from "
                    "another machine; "
                    f"{remedy} role = 'read', or the host {LOCAL}"
                )
        return self


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
    def _sound(self) -> "AlarmRule":
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
