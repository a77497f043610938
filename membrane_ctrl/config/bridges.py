"""Configuration of the bridges for other systems: MQTT, OPC UA, EPICS."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from firmware_iface.settings import Section
from membrane_ctrl.config.broker import BrokerConfig
from membrane_ctrl.config.port import LOCAL, LOCAL_HOSTS


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
        """Refuse a role beyond `read` for clients elsewhere that do not log in."""
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
                    f"{name}.host = {bridge.host!r}: this bridge does not know who acts from "
                    "another machine; "
                    f"{remedy} role = 'read', or the host {LOCAL}"
                )
        return self
