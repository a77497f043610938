"""Configuration of an MQTT broker, for a bridge or for the service's heartbeat."""

from typing import Annotated

from pydantic import Field

from firmware_iface.settings import Section


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
