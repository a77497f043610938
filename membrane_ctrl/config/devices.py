"""The `[devices]` part of the configuration: the pump board, or one table a role and the `driver` that fills it."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from membrane_ctrl.config.optics import CameraTable, FolderCameraConfig, ScreenTable
from membrane_ctrl.config.section import Section

UnitId = Annotated[int, Field(ge=1, le=247)]
Timeout = Annotated[float, Field(gt=0, le=5)]
Baud = Annotated[int, Field(ge=300, le=1_000_000)]
Direction = Literal[-1, 1]  # -1: the laser is behind the mirror, a deeper bowl comes nearer to it
Word = Annotated[int, Field(ge=0, le=0xFFFF)]
Port = Annotated[str, Field(min_length=1)]  # /dev/ttyUSB0, or usb:VID:PID[:SERIAL]
ModbusUrl = Annotated[str, Field(pattern=r"^(tcp|rtu)://")]  # tcp://HOST:PORT or rtu:///dev/ttyUSB0?baud=115200


class Optoncdt1420Config(Section):
    """Micro-Epsilon optoNCDT 1420 laser."""

    driver: Literal["optoncdt1420"]
    port: Port
    baud: Baud = 921_600
    rate_khz: Annotated[float, Field(gt=0, le=4)] = 4.0
    range_mm: Annotated[float, Field(gt=0, le=500)] | None = None  # refuse a sensor of another range
    zero_mm: float | None = None  # where displacement 0 is; the middle of the range when absent
    direction: Direction = -1
    step_max_um: Annotated[float, Field(gt=0, le=10_000)] = 50.0
    timeout_s: Timeout = 0.2


class KeyenceDlRs1aConfig(Section):
    """Keyence DL-RS1A with an IL, IG or GT2 head."""

    driver: Literal["keyence_dl_rs1a"]
    port: Port
    baud: Baud = 9600
    parity: Literal["N", "E", "O"] = "N"
    amplifier: Annotated[int, Field(ge=0, le=14)] = 0
    zero_mm: float = 0.0
    direction: Direction = -1
    step_max_um: Annotated[float, Field(gt=0, le=10_000)] = 10.0
    timeout_s: Timeout = 0.1


class VaisalaPtb330Config(Section):
    """Vaisala PTB330 barometer."""

    driver: Literal["vaisala_ptb330"]
    port: Port
    baud: Baud = 4800
    period_s: Annotated[float, Field(gt=0, le=60)] = 0.2
    age_max_s: Annotated[float, Field(gt=0, le=600)] = 3.0
    timeout_s: Timeout = 0.3


class VentusConfig(Section):
    """Lee / TTP Ventus disc pump."""

    driver: Literal["ventus"]
    port: Port
    power_max_mw: Annotated[float, Field(gt=0, le=5000)] = 1000.0
    timeout_s: Timeout = 0.1


class BronkhorstModbusConfig(Section):
    """Bronkhorst EL-FLOW (as pump) or EL-PRESS (as gauge pressure) with a Modbus interface."""

    driver: Literal["bronkhorst_modbus"]
    link: ModbusUrl
    unit_id: UnitId
    serial: str = ""  # refuse any other instrument; empty: take whichever answers
    timeout_s: Timeout = 0.2


class BronkhorstProparConfig(Section):
    """Bronkhorst EL-FLOW (as pump) or EL-PRESS (as gauge pressure) on RS-232, ProPar protocol."""

    driver: Literal["bronkhorst_propar"]
    port: Port
    baud: Baud = 38_400
    node: Annotated[int, Field(ge=1, le=128)] = 128  # 128: whatever is at the end of the cable
    serial: str = ""
    timeout_s: Timeout = 0.2


class ModbusMapConfig(Section):
    """Any device with Modbus registers; one register of it is the role's value.

    `raw` and `value` are two points of the straight line between the register and the role's unit.
    """

    driver: Literal["modbus_map"]
    link: ModbusUrl
    unit_id: UnitId = 1
    timeout_s: Timeout = 0.2
    preset: str = ""  # a file of firmware_iface/presets that gives defaults for the keys below
    function: Literal["holding", "input"] | None = None
    type: Literal["u16", "i16", "u32", "i32", "f32"] | None = None
    word_order: Literal["big", "little"] | None = None
    address: Word
    raw: tuple[float, float] | None = None
    value: tuple[float, float]
    limits: tuple[float, float] | None = None  # values outside are refused; the span of `value` when absent
    identity_address: Word | None = None
    identity_equals: Word | None = None

    @model_validator(mode="after")
    def _line(self) -> ModbusMapConfig:
        for name, pair in (("raw", self.raw), ("value", self.value)):
            if pair is not None and pair[0] == pair[1]:
                raise ValueError(f"{name} needs two different numbers")
        if self.limits is not None and self.limits[0] >= self.limits[1]:
            raise ValueError("limits needs two numbers, the lower one first")
        return self


Driver = Field(discriminator="driver")
DisplacementDriver = Annotated[Optoncdt1420Config | KeyenceDlRs1aConfig | ModbusMapConfig, Driver]
PumpDriver = Annotated[BronkhorstModbusConfig | BronkhorstProparConfig | VentusConfig | ModbusMapConfig, Driver]
PressureDriver = Annotated[BronkhorstModbusConfig | BronkhorstProparConfig | ModbusMapConfig, Driver]
BarometerDriver = Annotated[VaisalaPtb330Config | ModbusMapConfig, Driver]
AnyDriver = (
    Optoncdt1420Config
    | KeyenceDlRs1aConfig
    | VaisalaPtb330Config
    | VentusConfig
    | BronkhorstModbusConfig
    | BronkhorstProparConfig
    | ModbusMapConfig
)

ROLES = ("displacement", "pump", "gauge_pressure", "vent", "barometer", "thermometer")
# without these nothing may move gas: the loop's two ends, and the limit that keeps the film whole
NEEDED = ("displacement", "pump", "gauge_pressure")


class DevicesConfig(Section):
    """Which device fills which role: a board fills all, or one table a role."""

    board: str | None = None  # the pump board: tcp://HOST:PORT or rtu:///dev/ttyUSB0?baud=115200
    unit_id: UnitId = 1
    timeout_s: Timeout = 0.2
    watchdog_s: Annotated[float, Field(ge=0.1, le=10)] = 0.5
    displacement: DisplacementDriver | None = None
    pump: PumpDriver | None = None
    gauge_pressure: PressureDriver | None = None
    vent: ModbusMapConfig | None = None
    barometer: BarometerDriver | None = None
    thermometer: ModbusMapConfig | None = None
    camera: CameraTable | None = None
    screen: ScreenTable | None = None

    @model_validator(mode="after")
    def _board_or_roles(self) -> DevicesConfig:
        filled = [role for role in ROLES if getattr(self, role) is not None]
        if self.board is not None and filled:
            raise ValueError(f"give either board, or one table a role; not board and {filled[0]}")
        if self.board is None and not filled:
            raise ValueError('name the pump board, board = "tcp://HOST:PORT", or one table a role')
        missing = [role for role in NEEDED if role not in filled]
        if self.board is None and missing:
            raise ValueError(f"no device fills {missing[0]}; needed are {', '.join(NEEDED)}")
        for role in ("pump", "vent"):
            section = getattr(self, role)
            if isinstance(section, ModbusMapConfig) and not _is_fraction(section.limits or section.value):
                raise ValueError(f"{role}: value and limits of an actuator are fractions within 0..1")
        return self

    @model_validator(mode="after")
    def _one_owner_a_port(self) -> DevicesConfig:
        owners: dict[str, tuple[str, str]] = {}
        for role, section in self.roles().items():
            link = "" if hasattr(section, "port") else section.link
            port = section.port if hasattr(section, "port") else link.removeprefix("rtu://").partition("?")[0]
            other, other_link = owners.setdefault(port, (role, link))
            if other != role and not (link and link == other_link):
                raise ValueError(
                    f"{other} and {role} name one port, {port}; only Modbus devices of the same link share"
                )
        return self

    @model_validator(mode="after")
    def _camera_sees_a_screen(self) -> DevicesConfig:
        if self.camera is None and self.screen is not None:
            raise ValueError("[devices.screen] needs a [devices.camera] that looks at it")
        if self.camera is not None and (self.screen is None) != isinstance(self.camera, FolderCameraConfig):
            raise ValueError("a camera needs a [devices.screen]; a folder of frames needs none")
        return self

    def roles(self) -> dict[str, AnyDriver]:
        """The filled roles; empty with a board."""
        return {role: section for role in ROLES if (section := getattr(self, role)) is not None}

    @property
    def name(self) -> str:
        """For messages: the board's address, or where the roles' devices are."""
        return self.board or ", ".join(f"{role} on {address_of(section)}" for role, section in self.roles().items())


def address_of(section: AnyDriver) -> str:
    """Where the device is: its port or its Modbus address."""
    if isinstance(section, (BronkhorstModbusConfig, ModbusMapConfig)):
        return f"{section.link} unit {section.unit_id}"
    return section.port


def _is_fraction(pair: tuple[float, float]) -> bool:
    return all(math.isfinite(number) and 0.0 <= number <= 1.0 for number in pair)
