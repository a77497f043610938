"""The `[devices]` part of the configuration: the pump board, or one table per role with its `driver`."""

import math
from typing import Annotated

from pydantic import Field, model_validator

from firmware_iface import settings

ROLES = ("displacement", "pump", "gauge_pressure", "vent", "barometer", "thermometer")
# required before any gas moves: the loop's two ends, and the limit that protects the film
NEEDED = ("displacement", "pump", "gauge_pressure")


class DevicesConfig(settings.Section):
    """Which device fills which role: a board fills all, or one table per role."""

    board: settings.ModbusUrl | None = None
    """The pump board, tcp://HOST:PORT or rtu:///dev/ttyUSB0?baud=115200. Set it, or one table per role."""
    unit_id: settings.UnitId = 1
    timeout_s: settings.Timeout = 0.2
    watchdog_s: Annotated[float, Field(ge=0.1, le=10)] = 0.5
    """Time without commands after which the board stops the pump. Raise it for tick rates below 4 Hz."""
    displacement: settings.DisplacementDriver | None = None
    pump: settings.PumpDriver | None = None
    gauge_pressure: settings.PressureDriver | None = None
    vent: settings.ValueDriver | None = None
    barometer: settings.BarometerDriver | None = None
    thermometer: settings.ValueDriver | None = None
    camera: settings.CameraConfig | None = None
    screen: settings.PygameScreenConfig | None = None

    @model_validator(mode="after")
    def _board_or_roles(self) -> "DevicesConfig":
        filled = [role for role in ROLES if getattr(self, role) is not None]
        if self.board is not None and filled:
            raise ValueError(f"give either board or one table per role, not board and {filled[0]}")
        if self.board is None and not filled:
            raise ValueError('name the pump board (board = "tcp://HOST:PORT"), or give one table per role')
        missing = [role for role in NEEDED if role not in filled]
        if self.board is None and missing:
            raise ValueError(f"no device for {missing[0]}; required: {', '.join(NEEDED)}")
        for role in ("pump", "vent"):
            section = getattr(self, role)
            if isinstance(section, settings.ModbusMapConfig) and not _is_fraction(section.limits or section.value):
                raise ValueError(f"{role}: value and limits of an actuator are fractions within 0..1")
        return self

    @model_validator(mode="after")
    def _one_owner_a_port(self) -> "DevicesConfig":
        owners: dict[str, tuple[str, str]] = {}
        for role, section in self.roles().items():
            link = ""
            if isinstance(section, settings.ON_MODBUS):
                link, port = section.link, section.link.removeprefix("rtu://").partition("?")[0]
            else:
                port = section.port
            other, other_link = owners.setdefault(port, (role, link))
            if other != role and not (link and link == other_link):
                raise ValueError(
                    f"{other} and {role} name the same port, {port}; only Modbus devices on one link may share it"
                )
        return self

    @model_validator(mode="after")
    def _camera_sees_a_screen(self) -> "DevicesConfig":
        if self.camera is None and self.screen is not None:
            raise ValueError("[devices.screen] needs a [devices.camera]")
        if self.camera is not None and (self.screen is None) != isinstance(self.camera, settings.FolderCameraConfig):
            raise ValueError("a camera needs a [devices.screen]; a folder of frames must not have one")
        return self

    def roles(self) -> dict[str, settings.AnyDriver]:
        """The filled roles; empty with a board."""
        return {role: section for role in ROLES if (section := getattr(self, role)) is not None}

    @property
    def name(self) -> str:
        """For messages: the board's address, or each role's address."""
        return self.board or ", ".join(f"{role} on {address_of(section)}" for role, section in self.roles().items())


def address_of(section: settings.AnyDriver) -> str:
    """Address of the device: its port or its Modbus address."""
    if isinstance(section, settings.ON_MODBUS):
        return f"{section.link} unit {section.unit_id}"
    return section.port


def _is_fraction(pair: tuple[float, float]) -> bool:
    return all(math.isfinite(number) and 0.0 <= number <= 1.0 for number in pair)
