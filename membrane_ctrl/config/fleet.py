"""A file that lists several holds, for `ctl fleet`."""

from typing import Annotated

from pydantic import Field, model_validator

from firmware_iface.settings import Section


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
    """CA of the service's certificate. Set it if the system has no such CA."""

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
