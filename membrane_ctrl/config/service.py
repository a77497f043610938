"""Configuration of the service that follows, starts and ends holds (`membrane-ctrl serve`)."""

import re
from ipaddress import ip_network
from typing import Annotated
from urllib.parse import urlsplit

from pydantic import Field, field_validator, model_validator

from firmware_iface.settings import Section
from membrane_ctrl.config.broker import BrokerConfig
from membrane_ctrl.config.port import LOCAL, LOCAL_HOSTS

DEFAULT_PORT = 7480
_PUBLIC_URL = re.compile(
    # no segment that a browser resolves
    r"https?://(\[[0-9a-f:.]+\]|[a-z0-9.-]+)(:[0-9]{1,5})?(/[A-Za-z0-9_~-]+)*/?"
)


class HeartbeatMqttConfig(BrokerConfig):
    """The broker that gets the heartbeat."""

    topic: Annotated[
        str, Field(pattern=r"^[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*$", max_length=200)
    ] = "membrane/service"
    """Topic whose retained value is `online` or `offline`; the time of the last heartbeat is below
    it in `/time_utc`. Change it where there are several services.
    """


class HeartbeatConfig(Section):
    """A regular message to another machine, which raises an alarm when the messages stop.

    It is sent while the service and its alarm process work.
    """

    every_s: Annotated[float, Field(ge=5, le=86_400)] = 60.0
    """Interval. Set it below the period that the other machine expects."""
    url_file: str | None = None
    """File with the address that gets a POST, such as a check of healthchecks.io; it is a secret.
    Set it to be notified of a dead machine or network.
    """
    mqtt: HeartbeatMqttConfig | None = None
    """The broker that gets the heartbeat. Set it where a broker on another machine is watched."""

    @property
    def is_wanted(self) -> bool:
        """Whether any is configured."""
        return self.url_file is not None or self.mqtt is not None


class ServiceConfig(Section):
    """A service file, such as /etc/membrane-ctrl/service.toml (docs/how-to/service.md)."""

    logs: str = "logs"
    """Folder of the runs, with the hold's control socket. Set it to `recording.logs_dir` of the
    configurations.
    """
    configurations: str = "."
    """Folder of the configurations with which a hold can be started. Set it to where they are."""
    commissioning: str = "commissioning"
    """Folder of the guided sessions. Set it to where `membrane-ctrl commission` has them."""
    units: bool = False
    """Start holds as units of systemd (`membrane-ctrl service install` sets it); else as programs
    in a session of their own.
    """

    host: str = LOCAL
    """Address to listen on. Change it to let other machines connect, with TLS and users."""
    port: Annotated[int, Field(ge=1, le=65535)] = DEFAULT_PORT
    """TCP port. Change it if another program has it."""
    names: tuple[str, ...] = ()
    """Host names by which browsers call it. Set them where it is not the host above."""
    public_url: str = ""
    """Address that browsers open, such as https://lab.example/mirror/. Set it behind a reverse
    proxy.
    """
    trusted_proxies: tuple[str, ...] = ()
    """Addresses of proxies whose X-Forwarded-For counts. Set them to limit logins by the clients'
    addresses.
    """
    users_file: str | None = None
    """Names, roles and passwords of `serve add-user`. Set it for a login instead of a link."""
    certificate_file: str | None = None
    """TLS certificate of the service. Set it for other machines."""
    key_file: str | None = None
    """The key of that certificate. Set it to a file that only the hold's user can read."""
    heartbeat: HeartbeatConfig = HeartbeatConfig()
    """Messages by which another machine notices that this one is dead."""

    @property
    def secure(self) -> bool:
        """Whether it is served over TLS."""
        return self.certificate_file is not None and self.key_file is not None

    @field_validator("trusted_proxies")
    @classmethod
    def _networks(cls, networks: tuple[str, ...]) -> tuple[str, ...]:
        for text in networks:
            ip_network(text)
        return networks

    @field_validator("public_url")
    @classmethod
    def _plain_url(cls, text: str) -> str:
        if text and _PUBLIC_URL.fullmatch(text) is None:
            raise ValueError(
                f"{text}: write it like https://lab.example/mirror/, without user, query or "
                "dots in the path"
            )
        return text

    @model_validator(mode="after")
    def _closed_to_strangers(self) -> "ServiceConfig":
        """Require TLS and a login wherever other machines can reach the service."""
        if (self.certificate_file is None) != (self.key_file is None):
            raise ValueError("certificate and key: give both files, or none")
        if self.host not in LOCAL_HOSTS and not (self.secure and self.users_file):
            raise ValueError(
                f"host {self.host}: other machines need TLS and a login; give a certificate, "
                "its key and users"
            )
        url = urlsplit(self.public_url)
        local = not self.public_url or url.hostname in LOCAL_HOSTS
        if not local and not (url.scheme == "https" and self.users_file):
            raise ValueError(
                f"public_url {self.public_url}: other machines need TLS and a login; use "
                "https and give users"
            )
        return self
